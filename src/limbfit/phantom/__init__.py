"""A synthetic patient with known truth: anatomy, image, markers, traces, study file."""
