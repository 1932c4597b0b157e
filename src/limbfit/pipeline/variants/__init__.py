"""Simulations with one thing changed: parameters, contact, indenter, mesh; the material cube."""
