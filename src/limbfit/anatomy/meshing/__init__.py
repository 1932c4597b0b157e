"""Surfaces to one graded mesh for each site."""
