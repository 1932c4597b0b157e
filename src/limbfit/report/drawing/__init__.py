"""Figures and pictures of stored results."""
