"""Browsers for the tests of pages."""

from browsing import launch, open_page, playwright

__all__ = ["launch", "open_page", "playwright"]
