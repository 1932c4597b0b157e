"""Simulations in time: steps, equilibrium of each, factors and preconditioners, sensitivities."""
