"""The element table: shape functions, quadrature and formulation of every element, as data.

An element of a known cell type is a row of `ELEMENTS`; a cell type is a row of `limbfit.mesh.CELLS`, where
its local coordinates are said.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...arrays import Array, Indices
from ...mesh.cells import QUAD_CORNERS, ShapeFunctions, linear_simplex, linear_tensor, quadratic_simplex


@dataclass(frozen=True)
class Element:
    """A volume element.

    ``shape(x (q, 3))`` gives values (q, k) and derivatives (q, k, 3); ``points``/``weights`` are the
    quadrature; ``mean_dilatation`` takes one volume ratio and pressure per element (three-field,
    Simo, Taylor and Pister 1985); ``face_shape`` and ``face_rules`` (by name: points and weights) belong to
    its faces.
    """

    name: str
    cell_type: str
    shape: ShapeFunctions
    points: Array
    weights: Array
    mean_dilatation: bool
    face_shape: ShapeFunctions
    face_rules: Mapping[str, tuple[Array, Array]]


def _build_orbit(*orbits: tuple[float, float], d: int) -> tuple[Array, Array]:
    """Quadrature of points (a, b, b, ..) and permutations; each orbit gives a and its relative weight."""
    points, weights = [], []
    for a, weight in orbits:
        b = (1.0 - a) / d
        for i in range(d + 1):
            L = np.full(d + 1, b)
            L[i] = a
            points.append(L[1:])
            weights.append(weight)
    return np.array(points), np.array(weights) / (2.0 if d == 2 else 6.0)


def _build_gauss(d: int, n: int) -> tuple[Array, Array]:
    x, w = np.polynomial.legendre.leggauss(n)
    grids = np.meshgrid(*[x] * d, indexing="ij")
    weights = np.meshgrid(*[w] * d, indexing="ij")
    return np.column_stack([g.ravel() for g in grids]), np.prod([g.ravel() for g in weights], axis=0)


def _build_triangle_7() -> tuple[Array, Array]:
    """Degree 5, seven points (Radon 1948)."""
    root = np.sqrt(15.0)
    points, weights = _build_orbit(
        (1.0 - 2.0 * (6.0 - root) / 21.0, (155.0 - root) / 1200.0),
        (1.0 - 2.0 * (6.0 + root) / 21.0, (155.0 + root) / 1200.0),
        d=2,
    )
    return np.vstack([[1 / 3, 1 / 3], points]), np.concatenate([[9.0 / 80.0], weights])


_TET_1 = (np.full((1, 3), 0.25), np.array([1.0 / 6.0]))
_TET_4 = _build_orbit(((5.0 + 3.0 * np.sqrt(5.0)) / 20.0, 0.25), d=3)
# Degree 3, eight points: the rule of FEBio's default tet10.
_TET_8 = _build_orbit((0.0158359099, 0.138527967), (0.6791431780, 0.111472033), d=3)
# Degree 3, vertices and middles of the faces: an element cannot fold in a corner unseen, as it can between
# the inner points of the other rules.
_TET_8_VERTICES = _build_orbit((1.0, 1.0 / 40.0), (0.0, 9.0 / 40.0), d=3)
# Contact at points constrains them all.  Seven Gauss points of a quadratic face outnumber the nodes that can
# give way threefold: stiff contact then opens at every other point; three are as many as its nodal rule has.
# The nodal rule of a quadratic triangle has its corners at zero weight (it is exact to degree 2).
_TRI3 = {
    "nodes": (np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.full(3, 1.0 / 6.0)),
    "gauss": _build_triangle_7(),
}
_TRI6 = {
    "nodes": (np.array([[0.5, 0.0], [0.5, 0.5], [0.0, 0.5]]), np.full(3, 1.0 / 6.0)),
    "gauss": _build_orbit((2.0 / 3.0, 1.0 / 3.0), d=2),
    "gauss7": _build_triangle_7(),  # FEBio's
}
_QUAD4 = {"nodes": (QUAD_CORNERS, np.ones(4)), "gauss": _build_gauss(2, 2)}
_HEX = _build_gauss(3, 2)

ELEMENTS: dict[str, Element] = {
    e.name: e
    for e in (
        Element("tet4", "tet4", linear_simplex, *_TET_1, False, linear_simplex, _TRI3),
        Element("tet10", "tet10", quadratic_simplex, *_TET_4, False, quadratic_simplex, _TRI6),
        Element("tet10g8", "tet10", quadratic_simplex, *_TET_8, False, quadratic_simplex, _TRI6),
        Element("tet10v", "tet10", quadratic_simplex, *_TET_8_VERTICES, False, quadratic_simplex, _TRI6),
        Element("tet10p0", "tet10", quadratic_simplex, *_TET_4, True, quadratic_simplex, _TRI6),
        Element("tet10g8p0", "tet10", quadratic_simplex, *_TET_8, True, quadratic_simplex, _TRI6),
        Element("hex8", "hex8", linear_tensor, *_HEX, True, linear_tensor, _QUAD4),
    )
}


def compute_reference_gradients(element: Element, points: Array, cells: Indices) -> tuple[Array, Array]:
    """Gradients (m, q, 3, k) of the shape functions in the reference configuration and weights (m, q), mm^3.

    A weight is not positive where the cell is inverted.
    """
    _, dN = element.shape(element.points)
    X = points[cells]
    jacobian = np.einsum("mki,qkj->mqij", X, dN, optimize=True)
    weights = np.linalg.det(jacobian) * element.weights
    with np.errstate(all="ignore"):
        safe = np.where((np.abs(weights) > 0)[..., None, None], jacobian, np.eye(3))
    gradients = np.einsum("qkj,mqji->mqik", dN, np.linalg.inv(safe), optimize=True)
    # One memory layout for every element, or each layout would have kernels of its own to compile.
    return np.ascontiguousarray(gradients), np.ascontiguousarray(weights)


def build_face_quadrature(element: Element, points: Array, faces: Indices, rule: str) -> tuple[Array, Array]:
    """Shape values (q, k) and areas (f, q), mm^2, at the points of a face rule."""
    N, areas = compute_face_areas(element, points, faces, rule)
    return N, np.linalg.norm(areas, axis=-1)


def compute_face_areas(element: Element, points: Array, faces: Indices, rule: str) -> tuple[Array, Array]:
    """Shape values (q, k) and areas (f, q, 3) as outward vectors, mm^2, at the points of a face rule."""
    at, weights = element.face_rules[rule]
    N, dN = element.face_shape(at)
    tangents = np.einsum("fki,qkj->fqij", points[faces], dN, optimize=True)
    return N, np.cross(tangents[..., 0], tangents[..., 1]) * weights[:, None]
