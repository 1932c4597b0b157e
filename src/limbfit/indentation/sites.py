"""A study's site as a mechanical problem: everything about one indentation but the parameters.

`SiteModel` travels to worker processes as paths and numbers.

Pins that hold the limb are rigid bodies under force. The device of the source paper (section 2.1) has 14 pins
in a ring. The one at the site indents, the two beside it stay clear of the skin so that tissue can bulge, and
the other eleven press the limb with 14 to 16 N before the test. There they then stay where they are; here
each keeps its force.

Fibres run in a stated direction, or along a flow from the proximal cut to bone: between a muscle's
attachments and along its boundaries, as the gradient of a potential that Laplace's equation gives does. It is
one at one attachment, zero at the other, with no flow through what is between (Choi and Blemker 2013, PLoS
ONE 8, e77576).
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.spatial import cKDTree
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkCommand
from vtkmodules.vtkIOGeometry import vtkSTLReader

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError, SurfaceError, add_location
from ..extensions import load_extensions
from ..fe import (
    ELEMENTS,
    Activation,
    ContractileMaterial,
    FibredMaterial,
    FungQLV,
    History,
    Indenter,
    Material,
    Motion,
    OgdenPower,
    OgdenQLV,
    Problem,
    RigidBody,
    RigidSurface,
    StepControl,
    isochoric_stretch,
)
from ..fe.contact.contact import ContactSurface, find_touching_offset
from ..fe.kernel.elements import compute_reference_gradients
from ..laws import FUNG, LAWS, OGDEN, POWER, Parameters
from ..mesh import Mesh
from ..phases import spread
from ..relaxation import DEFAULT_SPAN_S, choose_relaxation_times
from ..study import ClampsTable, IndenterTable, SolverTable, Vector
from .neighbourhood import cut_neighbourhood, find_fixed_cut_nodes

Direction = Vector | Literal["flow"]  # of fibres

DISTAL_MM = 10.0  # of the bone's far end, along the limb, that fibres run to
_POTENTIAL_TOLERANCE = 1e-8  # residual of the potential of their flow
RISE_S, REST_S = 2.0, 5.0  # muscle tenses, and rests tensed, before the indenter touches
# Of the solver's tolerance: it is one of the reactions of all pins, of which the test pin's is a small part.
CLAMPED_TOLERANCE_SHARE = 0.1
PENETRATION_FACTOR = 3.0  # a percent of penetration costs half a percent of force (docs/contact.md)


@dataclass(frozen=True)
class WavePlace:
    """Where a shear wave's speed is wanted: a material point of ``tissue``, its place at rest, LPS mm.

    ``motion`` and ``way``: unit vectors along which the tissue moves and the wave runs, across each other.
    """

    tissue: str
    point: Vector
    motion: Vector
    way: Vector


def to_vector3(values: Array) -> Vector:
    """Three numbers as a model or a study holds them."""
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True)
class SiteModel:
    """One indentation but for the material: mesh file, indenter and displacement history.

    ``name`` is that of the record, or of the site where it plans an indentation; ``site`` that of the site,
    whose records share a mesh. ``position``, ``axis`` and ``edge`` in LPS mm; ``knots_s`` and ``knots_mm``
    are the piecewise linear displacement since touch-down, or ``knots_N`` the force that drives it instead
    (``knots_mm``: as deep as it then was); ``indenter_digest`` is that of the indenter's file, where it has
    one.
    """

    name: str
    mesh: Path
    mesh_digest: str
    position: tuple[float, float, float]
    axis: tuple[float, float, float]
    knots_s: tuple[float, ...]
    knots_mm: tuple[float, ...]
    edge: tuple[float, float, float] | None = None
    indenter: IndenterTable = field(default_factory=IndenterTable)
    indenter_digest: str = ""
    kappa_ratio: float = 100.0
    steps: SolverTable = field(default_factory=SolverTable)
    element: str = ""  # row of the element table; by default that of the mesh's cell type
    within_mm: float | None = None  # no more of the mesh than this far from the site
    law: str = OGDEN  # of all tissues
    relaxation_span_s: tuple[float, float] = DEFAULT_SPAN_S  # of relaxation as a power of time
    fibres: tuple[tuple[str, Direction], ...] = ()  # direction in each tissue that has some
    extensions: tuple[Path, ...] = ()  # files that register what the study has of its own
    site: str = ""
    knots_N: tuple[float, ...] = ()
    layers: tuple[str, ...] = ()  # tissues whose compression under the indenter is observed
    skin_points: tuple[Vector, ...] = ()  # points of the skin at rest, LPS mm, whose moves are observed
    skin_axes: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # of moves
    waves: tuple[WavePlace, ...] = ()  # where the speeds of shear waves are observed
    clamps: ClampsTable | None = None  # pins that hold the limb, in a ring across ``along``
    along: Vector = (0.0, 0.0, 1.0)  # the limb's axis, proximally, across which the clamps are
    course: tuple[tuple[float, float], ...] = ()  # s from touch-down, and share of the active stress
    prestretch: tuple[tuple[str, float], ...] = ()  # of tissues at rest

    @property
    def forced(self) -> bool:
        """True if a force drives the indenter."""
        return bool(self.knots_N)

    @property
    def gauges(self) -> int:
        """The number of values that are observed at every time beside the force."""
        return len(self.layers) + len(self.skin_axes) * len(self.skin_points) + len(self.waves)

    @property
    def waits_s(self) -> float:
        """How long the limb is held before the indenter touches it, s; a result's times are later by it."""
        return sum(self._rise_and_rest_s)

    @property
    def _rise_and_rest_s(self) -> tuple[float, float]:
        """How long what holds and tenses the limb takes to rise, and how long it acts before the touch, s."""
        if self.clamps is not None:
            return self.clamps.clamping_s, self.clamps.settling_s
        return (RISE_S, REST_S) if self.course else (0.0, 0.0)

    @property
    def activation(self) -> Activation | None:
        """The share of the active stress over time; it first rises to its value at touch-down, and rests."""
        if not self.course:
            return None
        times, shares = zip(*self.course, strict=True)
        late = [self.waits_s + t for t in times]
        return Activation([0.0, self._rise_and_rest_s[0], *late], [0.0, shares[0], *shares])

    @property
    def history(self) -> History:
        """The advance of the indenter from touch-down, or the force that presses it."""
        if self.forced:
            return History(np.array(self.knots_s), force=np.array(self.knots_N))
        return History(np.array(self.knots_s), np.array(self.knots_mm))

    def curve_times(self, points: int) -> Array:
        """About ``points`` times (k,) s that show the force, all phases and corners among them."""
        return spread(self.history.phases, points, self.history.times)


def build_materials(
    parameters: Parameters,
    kappa_ratio: float,
    law: str = OGDEN,
    fibred: Container[str] = (),
    relaxation_span_s: tuple[float, float] = DEFAULT_SPAN_S,
) -> dict[str, Material]:
    """The tissues for the solver, in MPa; those in ``fibred`` have fibres, where their law knows some.

    ``relaxation_span_s``: first and last time of relaxation as a power of time.
    """
    stated = LAWS[law]
    found: dict[str, Material] = {}
    for tissue, values in parameters.items():
        own = stated.in_solver_units(values)
        build = FungQLV if law == FUNG else stated.material
        if build is not None:
            found[tissue] = build(**own, kappa_ratio=kappa_ratio)
            continue
        if law == POWER:
            times = tuple(choose_relaxation_times(*relaxation_span_s).tolist())
            found[tissue] = OgdenPower(**own, times_s=times, kappa_ratio=kappa_ratio)
            continue
        fibre = {name: own.pop(name) for name in ("k1", "k2") if name in own}
        active = own.pop("active", None)
        c, m, *relaxation = own.values()
        ground = OgdenQLV(c, m, relaxation[::2], relaxation[1::2], kappa_ratio)
        found[tissue] = ground
        if fibre and tissue in fibred:
            passive = FibredMaterial(ground, **fibre)
            found[tissue] = passive if active is None else ContractileMaterial(passive, active)
    return found


def build_site_materials(model: SiteModel, parameters: Parameters) -> dict[str, Material]:
    """The tissues of a site for the solver, whose law may be the study's own."""
    load_extensions(model.extensions)
    return build_materials(
        parameters, model.kappa_ratio, model.law, dict(model.fibres), model.relaxation_span_s
    )


def build_problem(model: SiteModel, mesh: Mesh, parameters: Parameters) -> Problem:
    """The site's boundary-value problem: node sets ``fixed_*`` held, skin in contact with the indenter.

    Only skin near the indenter enters the contact; the rest would cost time for nothing. Where the model ends
    at ``within_mm``, the cut below the indenter is held, too. What holds the limb acts first, for
    `SiteModel.waits_s`.
    """
    load_extensions(model.extensions)
    if model.prestretch and model.gauges:  # the equilibrium that they would count from is no state
        raise ProblemError(
            f"site {model.site or model.name}: lengths, moves, waves of pre-stretched tissue are not known",
            remedy="leave layers, skin_points, waves or the pre-stretch out",
        )
    cut, fibres = np.empty(0, dtype=np.int64), build_fibre_field(model.fibres, mesh)
    strained = build_prestretch_field(model.prestretch, mesh, fibres, dict(model.fibres))
    if model.within_mm is not None:
        centre, axis = np.array(model.position), np.array(model.axis)
        part = cut_neighbourhood(mesh, centre, model.within_mm)
        mesh, cut = part.mesh, find_fixed_cut_nodes(part, centre, axis)
        fibres = None if fibres is None else fibres[part.cells]
        strained = None if strained is None else strained[part.cells]
        if not len(cut) and not len(mesh.held):  # nothing else carries it
            cut = part.cut
    indenter = read_indenter(model.indenter, model.position, model.axis, model.edge)
    faces = mesh.face_sets["skin"]
    reach = indenter.width * 0.71 + max(model.knots_mm) + 8.0
    near = np.linalg.norm(mesh.points[faces[:, :3]].mean(axis=1) - model.position, axis=1) < reach
    problem = Problem(
        mesh=mesh,
        materials=build_site_materials(model, parameters),
        fixed=np.union1d(mesh.held, cut),
        contact_faces=faces[near],
        indenter=indenter,
        history=model.history.delay(model.waits_s),
        friction=model.indenter.friction,
        element=model.element,
        fibres=fibres,
        activation=model.activation,
        prestretch=strained,
        touch_down_s=model.waits_s,
    )
    return problem if model.clamps is None else clamp_problem(problem, np.array(model.along), model.clamps)


def read_indenter(table: IndenterTable, position: Vector, axis: Vector, edge: Vector | None) -> Indenter:
    """The indenter at a site; reads the surface of shape ``stl``, whose path must be one of this machine.
    Raises `InputError` for a surface that cannot be read, or that is no indenter.
    """
    file, surface = table.file, None
    if file is not None:
        with add_location(file=file):
            surface = RigidSurface(*_read_stl(file))
    return Indenter(
        shape=table.shape,
        width=table.width_mm,
        edge_radius=table.edge_radius_mm,
        centre=np.array(position),
        axis=np.array(axis),
        edge=None if edge is None else np.array(edge),
        surface=surface,
        measures=table.measures,
    )


def compute_contact_radius(indenter: IndenterTable) -> float:
    """Of a circle with the indenter's section, mm; a sphere touches with less."""
    tool = read_indenter(indenter, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), None)
    return float(np.sqrt(tool.body.section / np.pi))


def _read_stl(file: Path) -> tuple[Array, Indices]:
    """Points (n, 3) and faces (m, 3) of an STL file, coincident points merged.

    The reader of `anatomy` would load images and graphics into every worker that only solves.
    """
    reader = vtkSTLReader()
    reader.SetFileName(str(file))
    reader.AddObserver(vtkCommand.ErrorEvent, lambda *_: None)  # the error below says it
    reader.Update()
    found = reader.GetOutput()
    if not found.GetNumberOfPolys():
        raise SurfaceError("holds no triangles", remedy="export the surface as STL again")
    faces = vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    a, b, c = faces.T
    return vtk_to_numpy(found.GetPoints().GetData()), faces[(a != b) & (b != c) & (c != a)]


def build_steps(model: SiteModel) -> StepControl:
    """How the solver steps through a site's history, before it adapts.

    On a part of its mesh the indenter may sink in `PENETRATION_FACTOR` times as far: its forces are corrected
    by those of the whole.
    """
    table = model.steps
    control = StepControl(load_steps=table.load_steps, unload_steps=table.unload_steps)
    if model.within_mm is not None:
        control = replace(control, penetration=PENETRATION_FACTOR * control.penetration)
    if model.clamps is not None:
        control = replace(control, tolerance=CLAMPED_TOLERANCE_SHARE * control.tolerance)
    if table.penalty_per_mm is None:
        return control
    return replace(control, penalty=table.penalty_per_mm, hold_penalty=True)


def build_clamping_pins(
    points: Array, faces: Indices, indenter: Indenter, along: Array, clamps: ClampsTable
) -> dict[str, Indenter]:
    """The clamping pins by name, each off the skin at its angle; of the usual ones those that meet it.

    Raises `ProblemError` where the test pin points along the limb, where a stated pin, or every pin, misses
    the skin, and where one would lie on the test pin.

    Parameters
    ----------
    points, faces : (n, 3) mm, and (f, 3 or more) the skin, corners first.
    indenter : the test pin, at its site.
    along : (3,) the limb's axis, proximally; the ring lies across it, in the plane of the test pin.
    """
    inwards = indenter.frame[2]
    normal = np.asarray(along, dtype=float) - (along @ inwards) * inwards
    if np.linalg.norm(normal) < 0.3 * np.linalg.norm(along):
        raise _build_refusal("the indenter points along the limb, where no ring of pins holds it")
    normal /= np.linalg.norm(normal)
    middles = points[faces[:, :3]].mean(axis=1) - np.asarray(indenter.centre)
    found: dict[str, Indenter] = {}
    for degrees, level in zip(clamps.angles, np.broadcast_to(clamps.levels_mm, len(clamps.angles))):
        name = f"clamp at {degrees:.4g} degrees"
        section = middles[np.abs(middles @ normal - level) < clamps.width_mm / 2.0]
        radius = 0.5 * float(np.ptp(section @ inwards)) if len(section) else 0.0
        centre = radius * inwards + level * normal
        turn = np.radians(degrees)
        axis = np.cos(turn) * inwards + np.sin(turn) * np.cross(normal, inwards)
        across, ahead = (section - centre) @ np.cross(normal, axis), (section - centre) @ axis
        ahead = ahead[(np.abs(across) < clamps.width_mm / 2.0) & (ahead < 0.0)]
        if not len(ahead):
            if clamps.angles_degrees:
                raise _build_refusal(f"the {name}, {level:g} mm along the limb, misses the skin")
            continue
        apart = float(np.linalg.norm(centre + ahead.min() * axis))
        if apart < 0.5 * (clamps.width_mm + indenter.width):
            raise _build_refusal(f"the {name} would lie on the test pin, {apart:.3g} mm off it")
        at = indenter.centre + centre - 3.0 * radius * axis
        found[name] = Indenter("square", clamps.width_mm, centre=at, axis=axis, edge=normal)
    if not found:
        raise _build_refusal("no clamping pin meets the skin")
    return found


def clamp_problem(problem: Problem, along: Array, clamps: ClampsTable) -> Problem:
    """A site's problem with the clamping pins as further bodies, which press from its beginning to its end.

    Raises `ProblemError` as `build_clamping_pins`.

    ``problem``: its indenter touches when they have pressed for `ClampsTable.lead_s`. ``along``: (3,) the
    limb's axis, proximally.
    """
    mesh, indenter = problem.mesh, problem.indenter
    assert indenter is not None
    pins = build_clamping_pins(mesh.points, mesh.face_sets["skin"], indenter, along, clamps)
    bodies = tuple(_build_pin_body(problem, pin, clamps, name) for name, pin in pins.items())
    return replace(problem, bodies=(*problem.bodies, *bodies))


def _build_pin_body(problem: Problem, pin: Indenter, clamps: ClampsTable, name: str) -> RigidBody:
    """A pin that just touches the skin, pressed by its force until the end."""
    mesh, skin = problem.mesh, problem.mesh.face_sets["skin"]
    local = (mesh.points[skin[:, :3]].mean(axis=1) - pin.centre) @ pin.frame.T
    reach = 0.5 * clamps.width_mm + 8.0
    near = (np.abs(local[:, :2]) < reach).all(axis=1) & (local[:, 2] > 0.0)
    near &= local[:, 2] < local[near, 2].min() + clamps.width_mm
    surface = ContactSurface.build(problem.formulation, mesh.points, skin[near], problem.contact_rule)
    times = [0.0, clamps.clamping_s, float(problem.history.times[-1])]
    motion = Motion.of(times, force={"z": [0.0, clamps.force_N, clamps.force_N]})
    return RigidBody(pin.move(find_touching_offset(surface, pin)), skin[near], motion, name=name)


def _build_refusal(what: str) -> ProblemError:
    remedy = "give clamps.angles_degrees or clamps.levels_mm, or leave [clamps] out"
    return ProblemError(what, place="clamps", remedy=remedy)


def build_fibre_field(fibres: Iterable[tuple[str, Direction]], mesh: Mesh) -> Array | None:
    """The fibres' direction in each cell (m, 3); any where a tissue has none, None where all have none.
    Raises `ProblemError` where a flow has no way: see `compute_flow_directions`.
    """
    found = None
    for tissue, direction in fibres:
        if tissue in mesh.region_names:
            found = np.tile([1.0, 0.0, 0.0], (len(mesh.cells), 1)) if found is None else found
            own = mesh.regions == mesh.region_names.index(tissue)
            found[own] = compute_flow_directions(mesh, tissue) if direction == "flow" else direction
    return found


def compute_flow_directions(mesh: Mesh, tissue: str) -> Array:
    """Unit directions (k, 3) in the cells of a tissue, in their order, towards the far end of the bone.

    The potential is 0 on the proximal cut and 1 on the bone within `DISTAL_MM` of its far end. Raises
    `ProblemError` for a mesh of other than tetrahedra, and where the tissue meets no cut or no end of the
    bone.
    """
    if not mesh.kind.is_tetrahedron:
        raise ProblemError("fibres along a flow need a mesh of tetrahedra", remedy="state a direction")
    corners = mesh.corners[mesh.regions == mesh.region_names.index(tissue)]
    nodes, cells = np.unique(corners, return_inverse=True)
    cells = cells.reshape(corners.shape)
    start, end = _find_ends(mesh, nodes)
    for met, what in ((start, "the proximal cut"), (end, "the far end of the bone")):
        if not met.any():
            raise ProblemError(
                f"the fibres of {tissue!r} have no flow: it does not meet {what}",
                remedy='state a direction, or "axis", in material.fibres',
            )
    points = mesh.points[nodes]
    gradients, weights = compute_reference_gradients(ELEMENTS["tet4"], points, cells)
    potential = _solve_potential(len(nodes), cells, gradients[:, 0], weights[:, 0], start, end)
    flow = np.einsum("mik,mk->mi", gradients[:, 0], potential[cells])
    size = np.linalg.norm(flow, axis=1, keepdims=True)
    if not (size > 0.0).all():
        raise ProblemError(f"the fibres of {tissue!r} have no flow in a part of it that hangs on nothing")
    return np.asarray(flow / size)


def _find_ends(mesh: Mesh, nodes: Indices) -> tuple[Mask, Mask]:
    """Which of the ``nodes`` are on the proximal cut, and which at the far end of the bone."""
    none = np.zeros(0, dtype=np.int64)
    cut, bone = (mesh.node_sets.get(name, none) for name in ("fixed_proximal", "fixed_bone"))
    if not len(cut) or not len(bone):
        return np.isin(nodes, cut), np.isin(nodes, bone)
    middle = mesh.points[cut].mean(axis=0)
    normal = np.linalg.svd(mesh.points[cut] - middle, full_matrices=False)[2][2]
    away = np.abs((mesh.points[bone] - middle) @ normal)
    end = bone[away > away.max() - DISTAL_MM]
    return np.isin(nodes, cut), np.isin(nodes, end) & ~np.isin(nodes, cut)


def _solve_potential(
    count: int, cells: Indices, gradients: Array, weights: Array, start: Mask, end: Mask
) -> Array:
    """The solution (n,) of Laplace's equation by linear tetrahedra: 0 at ``start``, 1 at ``end``."""
    blocks = np.einsum("mia,mib,m->mab", gradients, gradients, weights)
    rows, columns = np.broadcast_arrays(cells[:, :, None], cells[:, None])
    K = sp.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(count, count))
    free, out = ~(start | end), end.astype(float)
    inner, right = K[free][:, free], -(K[free] @ out)
    M = sp.diags(1.0 / inner.diagonal())
    out[free], failed = spla.cg(inner, right, rtol=_POTENTIAL_TOLERANCE, maxiter=20 * count, M=M)
    if failed:
        raise ProblemError("the potential of the fibres' flow was not found", remedy="state a direction")
    return out


def build_prestretch_field(
    stretches: Iterable[tuple[str, float]], mesh: Mesh, fibres: Array | None, fibred: Container[str]
) -> Array | None:
    """The pre-stretch of each cell (m, 3, 3) at constant volume; None where no tissue has one.

    ``stretches``: of tissues by name: along their fibres in those that are ``fibred``, in every direction of
    the plane of the skin in others. ``fibres``: (m, 3) direction in each cell, where tissues have some.
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
            corners = mesh.points[mesh.face_sets["skin"][:, :3]]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            middles = mesh.points[mesh.corners[own]].mean(axis=1)
            nearest = cKDTree(corners.mean(axis=1)).query(middles)[1]  # of the skin
            found[own] = isochoric_stretch(normals[nearest], stretch**-2.0)
    return found
