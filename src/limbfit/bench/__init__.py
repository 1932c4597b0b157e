"""Benchmarks: the solver against FEBio's results and for time and memory; meshes of many sites."""
