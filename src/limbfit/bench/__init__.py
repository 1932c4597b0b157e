"""Benchmarks: the solver against FEBio's results and for time and memory; meshes of many sites."""

from .meshing import bench_meshing
from .parity import bench_febio_parity
from .timing import bench_forward, bench_scaling

__all__ = ["bench_febio_parity", "bench_forward", "bench_meshing", "bench_scaling"]
