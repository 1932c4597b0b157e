"""Benchmarks: the solver against FEBio's results and for time and memory; meshes of many sites."""

UNKNOWNS, LARGE_UNKNOWNS = (20_000, 45_000, 80_000), (125_000, 200_000, 300_000)  # here they load no solver
