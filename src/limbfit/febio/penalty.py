"""The contact stiffness of FEBio and of limbfit, each converted to the other.

limbfit's is one number, 1/mm, times the mean instantaneous shear modulus, over the skin at rest
(`StepControl.penalty`). FEBio's is a pressure over a gap, MPa/mm: one number (``auto_penalty`` 0), or one for
each face (``auto_penalty`` 1).

Source: FEBio, ``FEContactInterface::AutoPenalty``.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Array, Indices
from ..errors import ProblemError
from ..fe import ELEMENTS, Material, Problem, Step, StepControl, System
from ..fe.contact.contact import ContactSurface, find_touching_offset
from ..fe.kernel.elements import build_face_quadrature, compute_reference_gradients
from ..fe.materials import compute_prony_factors
from ..mesh import Mesh
from .reading.model import Contact

# FEBio's penalty acts over the current area of the skin, limbfit's over that at rest: what touches a punch
# has stretched by that much at the peak of the four reference cases with contact (docs/contact.md).
CURRENT_AREA = 1.21


def compute_explicit_penalty(problem: Problem, steps: StepControl) -> float:
    """Return the explicit penalty of ``sliding-elastic`` that is as stiff as limbfit's contact, MPa/mm."""
    width = 1.0 if problem.indenter is None else problem.indenter.width
    penalty = 2000.0 / width if steps.penalty is None else steps.penalty
    return penalty * _compute_mean_modulus(problem) / CURRENT_AREA


def compute_mean_penalty(contact: Contact, problem: Problem, dt: float) -> float:
    """Return FEBio's penalty of ``contact`` as `StepControl.penalty`, 1/mm (see `compute_mean_stiffness`).

    ``sliding-elastic`` acts over the current area, ``sliding-facet-on-facet`` over that at rest.
    """
    area = CURRENT_AREA if contact.rule == "sliding-elastic" else 1.0
    return area * compute_mean_stiffness(contact, problem, dt) / _compute_mean_modulus(problem)


def compute_mean_stiffness(contact: Contact, problem: Problem, dt: float) -> float:
    """Return FEBio's penalty of ``contact``, MPa/mm.

    An automatic one is the mean over the faces that the indenter would pass through at its deepest, after a
    first step of ``dt`` s.
    """
    if not contact.automatic:
        return contact.penalty
    faces = _find_covered_faces(problem)
    area = _compute_areas(problem, faces, problem.mesh.points).sum(axis=1)
    return contact.penalty * float(np.average(compute_automatic_penalties(problem, faces, dt), weights=area))


class FacePenalties:
    """FEBio's contact on a limbfit system: the penalty of every face, over its current area.

    A system weighs its contact points by their area at rest. Here they are weighed so that the uniform
    penalty of `compute_mean_penalty` acts as FEBio's does; `update_after` extrapolates the area of the next
    step from those of the last two. The contact area of the result then has no meaning.

    ``contacts``: that of every rigid body of the problem, in their order; ``times``: (k,) s, the steps that
    will be taken.
    """

    def __init__(self, system: System, contacts: Sequence[Contact], times: Array) -> None:
        self.system, self.times = system, np.asarray(times)
        first = float(self.times[0])
        mean = compute_mean_stiffness(contacts[0], system.problem, first)
        if contacts[0].rule == "sliding-elastic":
            mean *= CURRENT_AREA
        self.faces = [
            _BodyFaces(body, contact, system.problem, first, mean)
            for body, contact in zip(system.bodies.all, contacts, strict=True)
        ]

    def update_after(self, step: Step) -> None:
        """Weigh the contact points for the step that follows an accepted one."""
        later = self.times[self.times > step.time * (1.0 + 1e-9)]
        ahead = float(later[0]) if len(later) else step.time
        for faces, coordinates in zip(self.faces, step.coordinates):
            faces.update_after(step, coordinates, ahead)


class _BodyFaces:
    """The faces that one body touches."""

    def __init__(
        self, body: Any, contact: Contact, problem: Problem, first_step_s: float, mean_stiffness: float
    ) -> None:
        self.body, self.problem, self.all = body, problem, np.asarray(body.stated.faces)
        # On quadratic faces the mean stretch comes nearer to FEBio's forces (0.4 to 0.7 % on exported sites)
        # than the area itself (0.7 to 2 %), on linear ones the area does; why is not known.
        elastic = contact.rule == "sliding-elastic"
        self.current = elastic and self.all.shape[1] != 6
        stiffness = np.full(len(self.all), contact.penalty)
        if contact.automatic:
            stiffness *= compute_automatic_penalties(problem, self.all, first_step_s)
        area = 1.0 if self.current or not elastic else CURRENT_AREA
        self.share = stiffness[:, None] / mean_stiffness * area
        self.areas = _compute_areas(problem, self.all, problem.mesh.points)
        self.coordinates = body.stated.motion.at(0.0)[0]
        self._weigh(self.areas)

    def update_after(self, step: Step, coordinates: Array, ahead: float) -> None:
        """Extrapolate the areas to the time ``ahead``, s, from where the body is and what moves it."""
        if not self.current:
            return
        areas = _compute_areas(self.problem, self.all, self.problem.mesh.points + step.state.u)
        there, forced, _ = self.body.stated.motion.at(ahead)
        gone, way = coordinates - self.coordinates, np.where(forced, 0.0, there - coordinates)
        moved = float(gone[:3] @ gone[:3])
        ratio = float(np.clip(way[:3] @ gone[:3] / moved, -2.0, 2.0)) if moved else 0.0
        self._weigh(np.maximum(areas + ratio * (areas - self.areas), 0.5 * areas))
        self.areas, self.coordinates = areas, coordinates

    def _weigh(self, areas: Array) -> None:
        self.body.surface = replace(self.body.surface, areas=self.share * areas)


def compute_automatic_penalties(problem: Problem, faces: Indices, dt: float) -> Array:
    """Return FEBio's automatic penalty (f,) of faces (f, k), MPa/mm: ``E A / V`` of face and element behind
    it.

    FEBio takes the modulus across the face from the inverse of the tangent as a 6 x 6 matrix, whose shear
    terms are four times those of the tensor: for the unit normal n ``1/E = 1/E_0 + 3 G / mu`` with ``G = n1^2
    n2^2 + n2^2 n3^2 + n3^2 n1^2`` and Young's modulus ``E_0 = 9 k mu / (3 k + mu)``. It is softest where the
    normal lies between the axes. The moduli are those of a step of ``dt`` s.
    """
    mesh = problem.mesh
    behind = find_cells_behind(mesh, faces)
    moduli = np.array([_compute_moduli(problem.materials[name], dt) for name in mesh.region_names])
    mu, kappa = moduli[mesh.regions[behind]].T
    # Normals of faces with three corners, or across the diagonals of four.
    (a, b), (c, d) = ((0, 2), (1, 3)) if faces.shape[1] == 4 else ((0, 1), (0, 2))
    corners = mesh.points[faces]
    normals = np.cross(corners[:, b] - corners[:, a], corners[:, d] - corners[:, c])
    squared = (normals / np.linalg.norm(normals, axis=1, keepdims=True)) ** 2
    between = 0.5 * (1.0 - (squared**2).sum(axis=1))  # n1^2 n2^2 + .., as the squares add up to one
    compliance = (3.0 * kappa + mu) / (9.0 * kappa * mu) + 3.0 * between / mu
    _, weights = compute_reference_gradients(problem.formulation, mesh.points, mesh.cells[behind])
    areas = _compute_areas(problem, faces, mesh.points).sum(axis=1)
    return np.asarray(areas / weights.sum(axis=1) / compliance)


def find_smallest_depth(mesh: Mesh, faces: Indices) -> float:
    """Return the smallest depth of the elements behind contact faces: volume over area of the face, mm."""
    cells = find_cells_behind(mesh, faces)
    element = ELEMENTS[mesh.cell_type]
    _, areas = build_face_quadrature(element, mesh.points, faces, "gauss")
    _, volumes = compute_reference_gradients(element, mesh.points, mesh.cells[cells])
    return float((volumes.sum(axis=1) / areas.sum(axis=1)).min())


def _compute_mean_modulus(problem: Problem) -> float:
    """Return the mean of the tissues' instantaneous shear moduli, MPa."""
    names = problem.mesh.region_names
    return float(np.mean([problem.materials[name].instantaneous_modulus for name in names]))


def _compute_areas(problem: Problem, faces: Indices, points: Array) -> Array:
    """Return the areas (f, q) of the quadrature points of faces (f, k), mm^2."""
    return build_face_quadrature(problem.formulation, points, faces, problem.contact_rule)[1]


def _find_covered_faces(problem: Problem) -> Indices:
    """Return the contact faces that the indenter would pass through at its deepest; all if there are none."""
    faces, indenter = np.asarray(problem.contact_faces), problem.indenter
    if indenter is None:
        return faces
    if problem.start == "touching":
        surface = ContactSurface.build(problem.formulation, problem.mesh.points, faces, problem.contact_rule)
        indenter = indenter.move(find_touching_offset(surface, indenter))
    deepest = indenter.move(float(problem.history.driver.max()))
    middle = problem.mesh.points[faces[:, : 4 if faces.shape[1] == 4 else 3]].mean(axis=1)
    inside = deepest.signed_distance(middle) < 0.0
    return faces[inside] if inside.any() else faces


def find_cells_behind(mesh: Mesh, faces: Indices) -> Indices:
    """Return the cell (f,) that each face belongs to; a face of none, or of several, is an error."""
    corners = np.sort(faces[:, : mesh.kind.face_corners], axis=1)
    touched = np.flatnonzero(np.isin(mesh.cells, corners).sum(axis=1) >= corners.shape[1])
    sides = np.sort(mesh.cells[touched][:, mesh.kind.faces[:, : corners.shape[1]]], axis=2)
    owners: dict[tuple[int, ...], list[int]] = {}
    for cell, own in zip(touched.tolist(), sides.tolist()):
        for side in own:
            owners.setdefault(tuple(side), []).append(cell)
    found = [owners.get(tuple(face), []) for face in corners.tolist()]
    for cells in found:
        if len(cells) != 1:
            raise ProblemError(f"a contact face belongs to {len(cells)} elements, not to one")
    return np.array([cells[0] for cells in found])


def _compute_moduli(material: Material, dt: float) -> tuple[float, float]:
    """Return shear and bulk modulus at rest over a step of ``dt`` s, MPa."""
    table = material.table()
    mu = float(table.terms[:, 0].sum()) / 2.0
    if len(table.prony):
        ramp = compute_prony_factors(dt, table.prony[:, 1])[1]
        mu *= 1.0 + float(table.prony[:, 0] @ ramp)
    return mu, float(table.kappa)
