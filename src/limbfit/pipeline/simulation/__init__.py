"""Simulations of a study's records, stored as they finish, and what they do to the tissue in figures."""
