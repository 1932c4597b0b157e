"""Tetrahedral meshers behind one interface; each runs in a process of its own under a time limit.

An engine is a function ``(VolumeTask, time_limit_s) -> VolumeMesh`` that raises ``MeshingError``, registered
in ``ENGINES``.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ...arrays import Array, Indices
from ...errors import MeshingError

_WORKER = Path(__file__).with_name("_worker.py")


class MesherError(MeshingError):
    """A mesher was started and gave no mesh."""


@dataclass(frozen=True)
class VolumeMesh:
    """Tetrahedra in regions, and the triangles of their surfaces: what an engine returns.

    Attributes
    ----------
    points, tets : (n, 3) mm and (m, 4).
    regions : (m,) the region of each tetrahedron.
    triangles, triangle_refs : boundary triangles (k, 3), outward, and those between regions, and the surface
        (k,) that each lies on.
    """

    points: Array
    tets: Indices
    regions: Indices
    triangles: Indices
    triangle_refs: Indices


@dataclass(frozen=True)
class VolumeTask(VolumeMesh):
    """A tetrahedral mesh to be adapted to a size; faces between two regions are kept.

    ``size`` (n,) is the requested edge length at the points, mm, ``hausdorff_mm`` how far the new surface may
    stray from the old one.
    """

    size: Array
    hausdorff_mm: float


def run_engine(engine: str, task: VolumeTask, time_limit_s: float) -> VolumeMesh:
    """Adapt with MMG (Dapogny, Dobrzynski, Frey 2014, J Comput Phys 262, 358-378), or remesh the surface with
    it and fill that with Netgen (Schoeberl 1997, Comput Visual Sci 1, 41-52).

    Raises `MesherError` when the engine crashes, gives nothing or exceeds the time limit.
    """
    with tempfile.TemporaryDirectory(prefix="limbfit-mesh-") as folder:
        source, target = Path(folder, "task.npz"), Path(folder, "mesh.npz")
        np.savez(source, **{name: getattr(task, name) for name in task.__dataclass_fields__})
        run_worker([sys.executable, str(_WORKER), engine.lower(), str(source), str(target)], time_limit_s)
        if not target.is_file():
            raise MesherError(f"the mesher {engine} gave no mesh; choose larger edges or thicker layers")
        with np.load(target) as stored:
            return VolumeMesh(**{name: stored[name] for name in VolumeMesh.__dataclass_fields__})


def run_netgen(task: VolumeTask, time_limit_s: float) -> VolumeMesh:
    """See `run_engine`. Raises `MeshingError`, too, when Netgen is not installed, or there are regions inside
    the core, which it would not see.
    """
    if task.regions.any():
        raise MeshingError('Netgen knows no regions inside the core; choose mesh.engine = "mmg"')
    if find_spec("netgen") is None:
        raise MeshingError(
            "the mesher Netgen is not installed; install it with  pip install 'limbfit[netgen]'  "
            'or choose mesh.engine = "mmg"'
        )
    return run_engine("Netgen", task, time_limit_s)


def run_worker(command: list[str], time_limit_s: float) -> None:
    """Run a mesher's process; its output is kept for the error message only."""
    threads = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, timeout=time_limit_s, capture_output=True, check=False, env={**os.environ, **threads}
        )
    except subprocess.TimeoutExpired:
        raise MesherError(
            f"the mesher did not end in {time_limit_s:g} s; raise mesh.time_limit_s or choose larger edges"
        ) from None
    if done.returncode:
        last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
        raise MesherError(
            f"the mesher stopped with code {done.returncode} ({last}); "
            "check the surfaces for self-intersections or choose other edge lengths"
        )


ENGINES: dict[str, Callable[[VolumeTask, float], VolumeMesh]] = {
    "mmg": partial(run_engine, "MMG"),
    "netgen": run_netgen,
}
