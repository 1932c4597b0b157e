"""Pre-stretches of a limb's tissues: along their fibres, or in the plane of a layer."""

from __future__ import annotations

from collections.abc import Container, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..arrays import Array
from ..fe import isochoric_stretch
from ..mesh import Mesh


def build_prestretch_field(
    stretches: Iterable[tuple[str, float]], mesh: Mesh, fibres: Array | None, fibred: Container[str]
) -> Array | None:
    """The pre-stretch of each cell (m, 3, 3) at constant volume; None where no tissue has one.

    Parameters
    ----------
    stretches : of tissues by name: along their fibres in those that are ``fibred``, in every direction of the
        plane of the skin in others.
    fibres : (m, 3) direction in each cell, where tissues have some.
    """
    found = None
    for tissue, stretch in stretches:
        if tissue not in mesh.region_names:
            continue
        found = np.tile(np.eye(3), (len(mesh.cells), 1, 1)) if found is None else found
        own = np.flatnonzero(mesh.regions == mesh.region_names.index(tissue))
        if fibres is not None and tissue in fibred:
            found[own] = isochoric_stretch(fibres[own], stretch)
        else:
            found[own] = isochoric_stretch(_find_normals(mesh, own), stretch**-2.0)
    return found


def _find_normals(mesh: Mesh, cells: NDArray[np.intp]) -> Array:
    """Normals (k, 3) of the skin where it is nearest to the middle of the cells."""
    corners = mesh.points[mesh.face_sets["skin"][:, :3]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middles = mesh.points[mesh.corners[cells]].mean(axis=1)
    nearest = cKDTree(corners.mean(axis=1)).query(middles)[1]
    return np.asarray(normals[nearest])
