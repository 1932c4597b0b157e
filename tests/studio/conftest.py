"""Browsers for the tests of pages."""

from browsing import launch, open_page, playwright, serve

__all__ = ["launch", "open_page", "playwright", "serve"]
