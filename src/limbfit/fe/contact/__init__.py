"""Rigid bodies as signed distances, and the energy of touching them."""
