"""Benchmarks of the solver: against FEBio's results, and for time and memory."""

from .forward import bench_forward
from .parity import bench_febio_parity
from .scaling import bench_scaling

__all__ = ["bench_febio_parity", "bench_forward", "bench_scaling"]
