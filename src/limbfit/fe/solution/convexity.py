"""What makes the tangent of an unstable state positive definite, so that Newton's direction is of descent.

The directions in which nearly incompressible tissue is unstable shear it: folds of a soft skin over a stiff
muscle.  The stiffness added is therefore that of shear alone, a share of each tissue's own modulus; one that
is relative to the diagonal would be ruled by the bulk modulus, a hundred times larger, and stop what is
stable, too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..bodies import GROUNDING
from ..system import System

Array = NDArray[np.float64]
_CELLS = 2000  # at a time


def compute_shear_stiffness(system: System, moduli: Array) -> Array:
    """Entries of the matrix of the integral of ``mu grad u : grad v``, in the pattern of ``system``.

    ``moduli (r,)``: shear modulus of each region, MPa.
    """
    data = np.zeros(len(system.indices))
    k = system.cells.shape[1]
    rows, columns = np.triu_indices(3 * k)
    same = rows // k == columns // k
    a, b = rows[same] % k, columns[same] % k
    weights = system.weights * moduli[system.regions][:, None]
    for start in range(0, len(system.cells), _CELLS):
        cells = slice(start, start + _CELLS)
        gradients = system.gradients[cells]
        nodal = np.einsum("mqia,mqib,mq->mab", gradients, gradients, weights[cells], optimize=True)
        places = system.cell_positions[cells][:, same]
        held = places < 0
        data += np.bincount(places[~held], nodal[:, a, b][~held], minlength=len(data))
    places, stiffness = compute_body_stiffness(system, moduli)
    data[places] += stiffness / GROUNDING
    return data


def compute_body_stiffness(system: System, moduli: Array) -> tuple[NDArray[np.int32], Array]:
    """Diagonal entries of the coordinates that are free to move rigid bodies, and what holds those of bodies
    that touch nothing (k,), N/mm."""
    if system.bodies is None or not system.bodies.free:
        return np.zeros(0, dtype=np.int32), np.zeros(0)
    return system.indptr[-1 - system.bodies.free : -1], system.bodies.grounding(float(np.mean(moduli)))
