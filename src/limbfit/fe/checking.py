"""What a problem must be before anything is solved."""

import numpy as np

from ..arrays import Array
from ..errors import ProblemError
from ..mesh import check as check_mesh
from .contact.friction import LAWS_OF_STICKING
from .kernel.elements import ELEMENTS, compute_reference_gradients
from .problem import Problem


def check(problem: Problem) -> None:
    """Raise `ProblemError` where the problem is impossible as stated."""
    _check_choices(problem)
    mesh, n = problem.mesh, len(problem.mesh.points)
    check_mesh(mesh, lambda _: _measure_cells(problem))
    indices = [("fixed nodes", problem.fixed)]
    indices += [("contact faces", np.asarray(body.faces)) for body in problem.rigid_bodies]
    indices += [("pressed faces", np.asarray(one.faces)) for one in problem.pressures]
    indices += [("support nodes", support.nodes) for support in problem.supports]
    for name, value in indices:
        value = np.asarray(value)
        if value.dtype == bool:
            raise ProblemError(f"the {name} are a mask", remedy="give node numbers: numpy.flatnonzero(mask)")
        if value.size and (value.min() < 0 or value.max() >= n):
            raise ProblemError(f"the {name} refer to nodes that the mesh does not have")
    for support in problem.supports:
        if support.component not in (0, 1, 2):
            raise ProblemError(f"a support has no component {support.component!r}", remedy="use 0, 1 or 2")
    _check_fibres(problem)
    _check_prestretch(problem)
    _check_bodies(problem)
    _check_touch_down(problem)
    if not len(problem.fixed) and not problem.supports:
        raise ProblemError("nothing is held in place", remedy="fix the bone and proximal nodes")


def _check_choices(problem: Problem) -> None:
    mesh = problem.mesh
    name = problem.element or mesh.cell_type
    if name not in ELEMENTS or ELEMENTS[name].cell_type != mesh.cell_type:
        fitting = ", ".join(e.name for e in ELEMENTS.values() if e.cell_type == mesh.cell_type)
        raise ProblemError(f"no element {name!r} for {mesh.cell_type} cells", remedy=f"use one of {fitting}")
    missing = [region for region in mesh.region_names if region not in problem.materials]
    if missing:
        given = ", ".join(problem.materials) or "none"
        what = f"region {missing[0]!r} has no material"
        raise ProblemError(what, remedy=f"name it in materials; there are: {given}")
    if mesh.regions.size and (mesh.regions.min() < 0 or mesh.regions.max() >= len(mesh.region_names)):
        raise ProblemError("the mesh has region indices without a name")
    if problem.contact_rule not in ELEMENTS[name].face_rules:
        rules = ", ".join(ELEMENTS[name].face_rules)
        raise ProblemError(f"unknown contact rule {problem.contact_rule!r}", remedy=f"use one of {rules}")
    if problem.start not in ("touching", "as-given"):
        raise ProblemError(f"unknown start {problem.start!r}", remedy="use 'touching' or 'as-given'")


def _check_friction(friction: str | float, sticking: str) -> None:
    if isinstance(friction, str):
        known = friction in ("frictionless", "sticky")
    else:
        known = not isinstance(friction, bool) and 0.0 <= friction < np.inf
    if not known:
        what = f"unknown friction {friction!r}"
        raise ProblemError(what, remedy="use 'frictionless', 'sticky' or a coefficient from 0 on")
    if sticking not in LAWS_OF_STICKING:
        what = f"unknown law of sticking {sticking!r}"
        raise ProblemError(what, remedy=f"use {' or '.join(map(repr, LAWS_OF_STICKING))}")


def _measure_cells(problem: Problem) -> Array:
    """What is positive in upright cells (m, k), at their quadrature points and of their corners."""
    mesh = problem.mesh
    _, weights = compute_reference_gradients(problem.formulation, mesh.points, mesh.cells)
    if not mesh.kind.is_tetrahedron:
        return weights
    # A quadratic map may be upright at its points and its corners not.
    corners = mesh.points[mesh.corners]
    return np.column_stack([weights, np.linalg.det(corners[:, 1:] - corners[:, :1])])


def _check_fibres(problem: Problem) -> None:
    for region in problem.mesh.region_names:
        table = problem.materials[region].table()
        if problem.activation is None and table.active > 0.0:
            what = f"the active stress of {region!r} acts at no stated time"
            raise ProblemError(what, remedy="state Problem.activation")
        if problem.fibres is None and table.has_fibres:
            what = f"the fibres of {region!r} have no direction"
            raise ProblemError(what, remedy="state fibres, (3,) or (cells, 3)")
    if problem.fibres is None:
        return
    given = np.asarray(problem.fibres, dtype=float)
    if given.shape not in ((3,), (len(problem.mesh.cells), 3)):
        what = f"fibres have shape {given.shape}"
        raise ProblemError(what, remedy=f"give (3,), or ({len(problem.mesh.cells)}, 3)")
    if not (np.isfinite(given).all() and (np.linalg.norm(np.atleast_2d(given), axis=1) > 0.0).all()):
        raise ProblemError("a direction of the fibres is zero or not finite")


def _check_prestretch(problem: Problem) -> None:
    if problem.prestretch is None:
        return
    given, cells = np.asarray(problem.prestretch, dtype=float), len(problem.mesh.cells)
    if given.shape not in ((3, 3), (1, 3, 3), (cells, 3, 3)):
        what = f"a pre-stretch has shape {given.shape}"
        raise ProblemError(what, remedy=f"give (3, 3), or ({cells}, 3, 3)")
    if not (np.isfinite(given).all() and (np.linalg.det(given) > 0.0).all()):
        raise ProblemError("a pre-stretch is not finite, or its determinant is not positive")
    if problem.indenter is not None and problem.start == "touching" and problem.history.forced:
        what = "an indenter that touches pre-strained tissue is driven by displacement"
        raise ProblemError(what, remedy='state where it starts, start="as-given"')


def _check_bodies(problem: Problem) -> None:
    width, bodies = problem.mesh.kind.faces.shape[1], problem.rigid_bodies
    for i, body in enumerate(bodies):
        faces, of = np.asarray(body.faces), f" of {body.name or f'body {i}'}" if len(bodies) > 1 else ""
        if faces.ndim != 2 or faces.shape[1] != width or not len(faces):
            raise ProblemError(f"contact faces{of} have shape {faces.shape}, not (f, {width}) with f > 0")
        _check_friction(body.friction, body.sticking)
        if body.motion.grows and not body.shape.grows:
            what = f"the shape{of or ' of the body'} does not grow"
            raise ProblemError(what, remedy="give a SmoothSurface with a clear shape, or a growth of 1")
    for one in problem.pressures:
        if np.asarray(one.faces).ndim != 2 or np.asarray(one.faces).shape[1] != width:
            raise ProblemError(f"pressed faces have shape {np.asarray(one.faces).shape}, not (f, {width})")
    end = problem.history.times[-1]
    for i, body in enumerate(problem.bodies):
        if np.isnan(body.motion.values[0]).any():
            what = f"the motion of {body.name or f'body {i}'} leaves open with which force it begins"
            remedy = "state it; only a coordinate that was held before may take over its force"
            raise ProblemError(what, remedy=remedy)
        if body.motion.times[-1] < end * (1.0 - 1e-9):
            raise ProblemError(
                f"the motion of {body.name or f'body {i}'} ends at {body.motion.times[-1]:g} s, before the "
                f"history does, at {end:g} s",
                remedy="state it to the end",
            )
    moved = problem.indenter is None or any(support.factor for support in problem.supports)
    if problem.history.forced and moved:
        raise ProblemError("a history of force drives an indenter, not supports")


def _check_touch_down(problem: Problem) -> None:
    at, history = problem.touch_down_s, problem.history
    if not at:
        return
    if not 0.0 < at < history.times[-1]:
        raise ProblemError(f"a touch-down at {at:g} s is not within the history, to {history.times[-1]:g} s")
    if problem.indenter is None or problem.start != "touching" or history.forced:
        what = "a later touch-down is that of an indenter driven by displacement that starts touching"
        raise ProblemError(what, remedy="leave touch_down_s out")
    if np.ptp(np.append(history.driver[history.times < at], history.at(at))) > 0.0:
        raise ProblemError(f"the indenter advances before its touch-down at {at:g} s")
