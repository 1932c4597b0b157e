"""Simulations with one thing changed: parameters, contact, indenter, mesh, grouping, the material cube."""
