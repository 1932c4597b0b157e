"""What the report and the studio show in a browser alike: arrays for scripts, shapes of limbs, scripts.

``static`` holds the scripts and style sheets, and below ``vendor`` the libraries they use (VENDOR.md).
Nothing here knows a study or a page.

What `pack` makes is read by a script without copying: 8 bytes ``LFARRAY1``; the length of the head, uint32;
the head, JSON padded with spaces so that what follows stands at a multiple of 8; the arrays, each at a
multiple of 8 from there on. All numbers are little-endian. The head has ``arrays``: name to ``type`` (``f4``,
``u4``, ``u2``, ``u1``, ``i4``), ``shape`` and ``at`` (bytes from the end of the head), and ``facts``: any
JSON. ``static/arrays.js`` reads it.

Lengths are in mm, LPS. A mesh is drawn with straight edges: mid-edge nodes of quadratic cells are left out.
"""

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray

from ..errors import ProblemError
from ..mesh import TET_FACES, Mesh, cell_volumes, compute_dihedral_angles, node_jacobians

STATIC = Path(__file__).parent / "static"
_MODULE_LINES = re.compile(r"^import .*;\n|^export (?=(?:const|function|class|async) )", re.MULTILINE)
MAGIC, _STEP, _TYPES = b"LFARRAY1", 8, {"f4", "u4", "u2", "u1", "i4"}
Floats = NDArray[np.float32]
Indices = NDArray[np.uint32]
_NO_CELL = -1


def read_asset(name: str) -> str:
    """The text of a file of ``static``, for example ``vendor/uPlot.min.css``."""
    return (STATIC / name).read_text(encoding="utf-8")


def build_inline_script(*names: str) -> str:
    """Scripts one after the other as one classic script, which needs no server.

    Modules lose their one-line imports and the word ``export``: what they name must be in an earlier file.
    Whatever would end a ``<script>`` element is refused.
    """
    text = "\n".join(_MODULE_LINES.sub("", read_asset(name)) for name in names)
    if re.search(r"</script|<!--", text, re.IGNORECASE):
        raise ValueError("a script must not hold what ends a script element")
    return text


def compute_integrity(script: str) -> str:
    """The source of a script in a content security policy: only this very text may run."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def pack(arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any] | None = None) -> bytes:
    """The arrays and facts as one block; `ValueError` for other types, and for facts that are no JSON."""
    table, parts, at = {}, [], 0
    for name, values in arrays.items():
        kind = values.dtype.str[1:]
        if kind not in _TYPES:
            raise ValueError(f"array {name!r} has type {values.dtype}, not one of {sorted(_TYPES)}")
        data = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()
        table[name] = {"type": kind, "shape": list(values.shape), "at": at}
        parts.append(data + b"\0" * (-len(data) % _STEP))
        at += len(parts[-1])
    head = json.dumps({"arrays": table, "facts": dict(facts or {})}, allow_nan=False).encode()
    head += b" " * (-(len(MAGIC) + 4 + len(head)) % _STEP)
    return b"".join([MAGIC, len(head).to_bytes(4, "little"), head, *parts])


@dataclass(frozen=True)
class Shell:
    """Triangles: points (n, 3) float32, faces (m, 3) uint32."""

    points: Floats
    faces: Indices


@dataclass(frozen=True)
class VolumeShape:
    """Tetrahedra, and the faces between them, each once.

    points (n, 3) float32; cells (m, 4) uint32; regions (m,) uint8; ``nodes`` (n,): numbers of the points in
    the mesh; faces (k, 3) uint32, outward from their owner; owners, neighbours (k,): cells on both sides,
    the neighbour -1 (int32) outside.
    """

    points: Floats
    cells: Indices
    regions: NDArray[np.uint8]
    nodes: NDArray[np.int64]
    faces: Indices
    owners: Indices
    neighbours: NDArray[np.int32]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a script needs, by the names that ``static/volume.js`` expects."""
        names = ("points", "cells", "regions", "faces", "owners", "neighbours")
        return {name: getattr(self, name) for name in names}


def build_patient_frame(cut_normal: ArrayLike | None) -> NDArray[np.float64]:
    """Rows: the patient's left, posterior and proximal direction, the last one along the limb (LPS)."""
    up = np.asarray((0.0, 0.0, 1.0) if cut_normal is None else cut_normal, dtype=float)
    up = up / np.linalg.norm(up)
    back = np.array([0.0, 1.0, 0.0])
    back = back - (back @ up) * up if abs(up[1]) < 0.95 else np.array([0.0, 0.0, 1.0])
    back /= np.linalg.norm(back)
    return np.array([np.cross(back, up), back, up])


def read_shell(file: Path, max_faces: int) -> Shell:
    """A stored surface, of ``max_faces`` triangles at most; `ProblemError` where the file holds none."""
    surface: Any = pv.read(file)
    surface = surface.triangulate().clean()
    if surface.n_cells == 0:
        raise ProblemError("holds no triangles", file=file, remedy="make the surfaces again")
    if surface.n_cells > max_faces:
        surface = surface.decimate(1.0 - max_faces / surface.n_cells)
    return to_shell(surface)


def to_shell(surface: Any) -> Shell:
    """The triangles of a pyvista surface that holds nothing else."""
    faces = np.asarray(surface.faces).reshape(-1, 4)[:, 1:]
    return Shell(np.asarray(surface.points, dtype=np.float32), faces.astype(np.uint32))


def to_volume_shape(mesh: Mesh) -> VolumeShape:
    """A mesh of tetrahedra to draw; `ProblemError` for hexahedra, or a face of more than two cells."""
    if not mesh.kind.is_tetrahedron:
        raise ProblemError("only meshes of tetrahedra are drawn, not of hexahedra")
    nodes, cells = np.unique(mesh.cells[:, :4], return_inverse=True)
    cells = cells.reshape(-1, 4)
    faces = cells[:, TET_FACES].reshape(-1, 3)
    low, middle, high = np.sort(faces, axis=1).T
    keys = (low * len(nodes) + middle) * len(nodes) + high
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(keys[order]) != 0])
    sizes = np.diff(np.r_[starts, len(order)])
    if sizes.max() > 2:
        raise ProblemError("a face of the mesh belongs to more than two cells")
    second = order[np.minimum(starts + 1, len(order) - 1)] // 4
    return VolumeShape(
        points=mesh.points[nodes].astype(np.float32),
        cells=cells.astype(np.uint32),
        regions=mesh.regions.astype(np.uint8),
        nodes=nodes,
        faces=faces[order[starts]].astype(np.uint32),
        owners=(order[starts] // 4).astype(np.uint32),
        neighbours=np.where(sizes == 2, second, _NO_CELL).astype(np.int32),
    )


def extract_interface(volume: VolumeShape, region: int) -> Shell:
    """The faces between the regions up to ``region`` (layers, outermost first) and those beyond."""
    inside = volume.neighbours != _NO_CELL
    near = volume.regions[volume.owners] <= region
    far = np.where(inside, volume.regions[volume.neighbours], 0) <= region
    chosen = inside & (near != far)
    points, faces = np.unique(volume.faces[chosen], return_inverse=True)
    return Shell(volume.points[points], faces.reshape(-1, 3).astype(np.uint32))


def compute_cell_quality(mesh: Mesh) -> dict[str, Floats]:
    """Of each cell: its smallest dihedral angle (degrees), scaled Jacobian (-) and volume (mm3)."""
    jacobians = node_jacobians(mesh)
    scaled = jacobians.min(axis=1) / np.abs(jacobians.mean(axis=1))
    measures = {
        "min_dihedral_deg": compute_dihedral_angles(mesh.points, mesh.cells[:, :4]).min(axis=1),
        "scaled_jacobian": scaled,
        "volume_mm3": cell_volumes(mesh),
    }
    return {name: values.astype(np.float32) for name, values in measures.items()}
