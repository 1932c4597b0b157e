"""Structured blocks of every element, for tests: six tetrahedra or one hexahedron per box."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from limbfit.fe import (
    ELEMENTS,
    History,
    Indenter,
    Material,
    NeoHookean,
    OgdenQLV,
    Problem,
    Result,
    RigidBody,
    StepControl,
    Support,
    System,
    solve,
)
from limbfit.fe.contact.rigid import RigidShape
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.motion import Drives, Motion
from limbfit.fe.solution.linear import multiply_symmetric
from limbfit.fe.system import Evaluation, Increment
from limbfit.mesh import TET10_EDGES, TET_FACES, Mesh
from limbfit.mesh.cells import HEX, SIX_TETS, build_boxes
from tetrahedra import turn_upright

HEX_FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])


def quadratic(points: NDArray, cells: NDArray) -> tuple[NDArray, NDArray]:
    """Mid-edge nodes for tetrahedra."""
    edges = np.sort(cells[:, TET10_EDGES].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = points[unique].mean(axis=1)
    return np.vstack([points, middle]), np.hstack([cells, len(points) + inverse.reshape(-1, 6)])


def block(
    cell_type: str, x: NDArray, y: NDArray, z: NDArray, layer: float = 0.0, jitter: float = 0.0
) -> Mesh:
    """A block over the grid lines ``x, y, z``; region ``skin`` above ``z.max() - layer``, else ``muscle``.

    Node sets ``bottom``; face set ``top``.  ``jitter`` moves inner nodes at random (fixed seed), mm.
    """
    points, corners = build_boxes(*(np.asarray(lines, dtype=float) for lines in (x, y, z)))
    low, high = points.min(axis=0), points.max(axis=0)
    inner = ((points > low) & (points < high)).all(axis=1)
    points[inner] += jitter * np.random.default_rng(1).uniform(-1, 1, (inner.sum(), 3))
    if cell_type == "hex8":
        cells = corners[:, HEX]
    else:
        cells = turn_upright(points, corners[:, SIX_TETS].reshape(-1, 4))
    centres = points[cells].mean(axis=1)
    regions = (centres[:, 2] < high[2] - layer).astype(int)
    if cell_type == "tet10":
        points, cells = quadratic(points, cells)
    tolerance = 1e-9
    faces = boundary(cells, cell_type)
    top = faces[(points[faces][:, :, 2] > high[2] - tolerance).all(axis=1)]
    bottom = np.flatnonzero(points[:, 2] < low[2] + tolerance)
    return Mesh(points, cells, cell_type, regions, ("skin", "muscle"), {"bottom": bottom}, {"top": top})


def boundary(cells: NDArray, cell_type: str) -> NDArray:
    """Outward boundary faces in VTK order."""
    local = HEX_FACES if cell_type == "hex8" else TET_FACES
    if cell_type == "tet10":
        edge = {tuple(sorted(pair)): 4 + i for i, pair in enumerate(TET10_EDGES.tolist())}
        local = np.array(
            [[*f, *(edge[tuple(sorted((f[i], f[(i + 1) % 3])))] for i in range(3))] for f in local]
        )
    faces = cells[:, local].reshape(-1, local.shape[1])
    corners = 4 if cell_type == "hex8" else 3
    _, first, count = np.unique(
        np.sort(faces[:, :corners], axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[first[count == 1]]


SKIN, MUSCLE = OgdenQLV(0.009, 6.0, 2.0, 0.5), OgdenQLV(0.004, 4.0, 3.0, 0.3)


def graded(half: float, inner: float, n_inner: int, n_outer: int) -> NDArray:
    """Grid lines from -half to half, even within +-inner, growing outside."""
    out = inner + (half - inner) * (np.arange(1, n_outer + 1) / n_outer) ** 1.5
    return np.concatenate([-out[::-1], np.linspace(-inner, inner, n_inner + 1), out])


RAMP = History(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
COARSE_Z, FINE_Z = (-30.0, -11.0, -3.0, 0.0), (-30.0, -19.5, -9.0, -6.0, -3.0, 0.0)


def punch(
    cell_type: str = "tet10", n: int = 6, outer: int = 2, depth: float = 6.0, speed: float = 0.96,
    z: tuple[float, ...] = COARSE_Z, **changes,
) -> Problem:  # fmt: skip
    """A two-layer block of 60 x 60 x 30 mm under a square punch of 20 mm; elements between heights ``z``."""
    lines = graded(30.0, 11.0, n, outer)
    mesh = block(cell_type, lines, lines, np.array(z), layer=3.0)
    history = History(np.array([0.0, depth / speed, 2 * depth / speed]), np.array([0.0, depth, 0.0]))
    values = {
        "mesh": mesh,
        "materials": {"skin": SKIN, "muscle": MUSCLE},
        "fixed": mesh.node_sets["bottom"],
        "contact_faces": mesh.face_sets["top"],
        "indenter": Indenter(axis=(0, 0, -1), centre=(0.0, 0.0, 1.0)),
        "history": history,
    }
    return Problem(**{**values, **changes})


def untouched(
    mesh: Mesh,
    laws: Material | dict[str, Material],
    history: History = RAMP,
    fixed: Sequence[int] = (),
    **how: Any,
) -> Problem:
    """A body without an indenter, of one law or of one for each region, some of its nodes ``fixed``."""
    laws = laws if isinstance(laws, dict) else dict.fromkeys(mesh.region_names, laws)
    return Problem(mesh, laws, np.array(fixed, dtype=int), np.zeros((0, 3), int), None, history, **how)


def refined(lines: NDArray | list[float], n: int) -> NDArray:
    """Grid lines with every interval cut into ``n`` equal parts."""
    lines = np.asarray(lines, dtype=float)
    return np.interp(np.arange(n * (len(lines) - 1) + 1) / n, np.arange(len(lines)), lines)


def symmetry(mesh: Mesh) -> tuple[Support, Support]:
    """The planes x = 0 and y = 0 of a quarter model."""
    return tuple(Support(np.flatnonzero(np.abs(mesh.points[:, i]) < 1e-9), i) for i in (0, 1))


def quarter_punch(element: str, refinement: int, depth: float = 6.0, speed: float = 0.96) -> Problem:
    """A quarter of the block of `punch`, loaded only, by a punch of 2 mm edge radius; forces times 4."""
    lines = refined([0.0, 6.0, 9.5, 13.0, 30.0], refinement)
    z = refined([-30.0, -16.0, -7.5, -3.0, 0.0], refinement)
    mesh = block(ELEMENTS[element].cell_type, lines, lines, z, layer=3.0)
    history = History(np.array([0.0, depth / speed]), np.array([0.0, depth]))
    tool = Indenter("square", 20.0, 2.0, axis=(0, 0, -1), centre=(0.0, 0.0, 1.0))
    return Problem(
        mesh, {"skin": SKIN, "muscle": MUSCLE}, mesh.node_sets["bottom"], mesh.face_sets["top"], tool,
        history, supports=symmetry(mesh), element=element,
    )  # fmt: skip


def sector(radii: NDArray, n: int, cell_type: str = "hex8") -> Mesh:
    """A quarter of a tube about z, one element high; node sets of its planes, face sets of its walls."""
    z = np.array([0.0, float(radii[-1] - radii[0]) / 4])
    mesh = block(cell_type, radii, np.linspace(0.0, np.pi / 2, n + 1), z)
    r, angle, height = mesh.points.T
    points = np.column_stack([r * np.cos(angle), r * np.sin(angle), height])
    faces = boundary(mesh.cells, cell_type)
    at = r[faces].mean(axis=1)
    sets = {"y0": np.flatnonzero(angle < 1e-9), "x0": np.flatnonzero(angle > np.pi / 2 - 1e-9)}
    sets |= {"ends": np.flatnonzero((height < 1e-9) | (height > z[-1] - 1e-9))}
    inside, outside = (faces[np.abs(at - value) < 1e-6] for value in (radii[0], radii[-1]))
    return Mesh(
        points, mesh.cells, cell_type, mesh.regions, mesh.region_names, sets,
        {"inside": inside, "outside": outside},
    )  # fmt: skip


def quarter_tube(mesh: Mesh, law: Material, body: RigidBody, **how: Any) -> Problem:
    """A `sector` in plane strain that a rigid body meets from outside."""
    sets, still = mesh.node_sets, History(np.array([0.0, 2.0]), np.zeros(2))
    planes = (Support(sets["y0"], 1), Support(sets["x0"], 0), Support(sets["ends"], 2))
    return untouched(mesh, law, still, supports=planes, bodies=(body,), **how)


TUBE, OVERLAP = sector(np.linspace(10.0, 20.0, 13), 24), 0.04


def check_press_fit(shape: RigidShape, motion: Motion, times: tuple[float, ...], **how: object) -> None:
    """A rigid ring that ends up `OVERLAP` mm too narrow on the `TUBE`, and is pulled along it.

    The pressure is Lame's, of plane strain and small strain; the pull is mu p A.
    """
    a, b, mu, law = 10.0, 20.0, 0.2, NeoHookean(0.01, kappa_ratio=20.0)
    problem = quarter_tube(TUBE, law, RigidBody(shape, TUBE.face_sets["outside"], motion, mu), **how)
    found = solve(problem, StepControl(times=times, penalty=2000.0, hold_penalty=True, penetration=1.0))
    assert found.completed, found.reason
    G, K = law.shear_modulus, law.kappa_ratio * law.shear_modulus
    E, nu = 9 * K * G / (3 * K + G), (3 * K - 2 * G) / (2 * (3 * K + G))
    pressure = OVERLAP * E * (b**2 - a**2) / (b * (1 + nu) * ((1 - 2 * nu) * b**2 + a**2))
    radial, axial = -found.reactions[-1, 0, 0], found.reactions[-1, 0, 2]
    assert radial == pytest.approx(pressure * b * float(TUBE.points[:, 2].max()), rel=0.01)
    assert axial == pytest.approx(mu * np.pi / 2 * radial, rel=0.01)


def check_tangent(
    system: System, laws: Laws, u: NDArray, rest: Increment, d: NDArray, h: float = 1e-6, rel: float = 1e-7
) -> Evaluation:
    """Residual and tangent at ``u`` (n, 3) are differences of energy and residual along ``d`` (n, 3)."""
    here = system.evaluate(u, laws, rest)
    ahead, back = (system.evaluate(u + s * h * d, laws, rest) for s in (1, -1))
    K = np.zeros((system.unknowns, system.unknowns))
    K[np.repeat(np.arange(system.unknowns), np.diff(system.indptr)), system.indices] = here.tangent
    K += np.triu(K, 1).T
    off = rel * np.abs(K).max()
    assert (ahead.energy - back.energy) / (2 * h) == pytest.approx((here.residual * d).sum(), abs=off)
    change = ((ahead.residual - back.residual) / (2 * h)).ravel()[system.free]
    np.testing.assert_allclose(K @ d.ravel()[system.free], change, atol=off)
    return here


def drive(advance: float, x: float = 0.0, y: float = 0.0) -> Drives:
    """What drives an indenter that has gone ``advance`` mm, and ``x, y`` mm across."""
    return Drives(np.array([[x, y, advance, 0.0, 0.0, 0.0]]), np.zeros((1, 6), dtype=bool), np.ones(1))


def check_derivatives(
    system: System, at: Callable[[NDArray], Evaluation], u: NDArray, d: NDArray, rel: float = 1e-4
) -> tuple[Evaluation, tuple[NDArray, NDArray]]:
    """Energy, force on the indenter and residual at ``u`` (n, 3) change along ``d`` (n, 3) as residual,
    advance and tangent say; also returns the tangent times ``d`` and the change of the residual."""
    h = 1e-6
    here, ahead, back = at(u), at(u + h * d), at(u - h * d)
    assert (ahead.energy - back.energy) / (2 * h) == pytest.approx((here.residual * d).sum(), rel=1e-5)
    assert (ahead.force - back.force) / (2 * h) == pytest.approx(-(here.advance * d).sum(), rel=1e-4)
    K_d = multiply_symmetric(system.indptr, system.indices, here.data, d.reshape(-1, 1)[system.free])
    change = ((ahead.residual - back.residual) / (2 * h)).reshape(-1, 1)[system.free]
    np.testing.assert_allclose(K_d, change, atol=rel * np.abs(change).max())
    return here, (K_d, change)


def check_sensitivities(
    problem: Problem, control: StepControl, rel: float, *named: tuple[str, str], response: str = "force"
) -> Result:
    """Derivatives of a punch's force, or displacement, by each of the ``named`` parameters of regions, or
    along one direction of all parameters, are central differences about the result, which is returned."""
    centre = solve(problem, control, sensitivities=True, store="all")
    assert centre.completed, centre.reason
    slopes, values = getattr(centre, f"{response}_sensitivity"), problem.parameters
    directions = {"all": values * np.random.default_rng(3).uniform(-1, 1, len(values))}
    if named:
        places = {one: problem.parameter_names.index(one) for one in named}
        directions = {one: values * np.eye(len(values))[place] for one, place in places.items()}
    for name, direction in directions.items():
        ends = []
        for sign in (1, -1):
            moved = dict(zip(problem.parameter_names, values + 1e-4 * sign * direction))
            laws = {
                region: law.with_parameters({key: moved[region, key] for key in law.parameter_names})
                for region, law in problem.materials.items()
            }
            changed = solve(problem.with_materials(laws), control, warm_start=centre)
            ends.append(getattr(changed, response))
        difference = (ends[0] - ends[1]) / 2e-4
        largest = np.abs(difference).max()
        np.testing.assert_allclose(slopes @ direction, difference, 0, rel * largest, err_msg=str(name))
    return centre
