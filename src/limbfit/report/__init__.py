"""Stored results to figures, tables and one self-contained HTML file; nothing here solves."""

from .build import build_report

__all__ = ["build_report"]
