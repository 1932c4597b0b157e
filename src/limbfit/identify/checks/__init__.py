"""Checks of records, cross-validation, and the choice of sites and records."""
