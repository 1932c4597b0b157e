"""A study's site as a mechanical problem: everything about one indentation but the parameters.

`SiteModel` travels to worker processes as paths and numbers.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkCommand
from vtkmodules.vtkIOGeometry import vtkSTLReader

from ..arrays import Array, Indices
from ..errors import ProblemError, SurfaceError, add_location
from ..extensions import load_extensions
from ..fe import (
    Activation,
    Contractile,
    Fibred,
    FungQLV,
    History,
    Indenter,
    Material,
    OgdenPower,
    OgdenQLV,
    Problem,
    RigidSurface,
    StepControl,
)
from ..laws import FUNG, LAWS, OGDEN, POWER, Parameters
from ..mesh import Mesh
from ..phases import spread
from ..relaxation import DEFAULT_SPAN_S, choose_relaxation_times
from ..study import ClampsTable, IndenterTable, SolverTable, Vector
from .cell_fields import Direction, build_fibre_field, build_prestretch_field
from .clamps import clamp_problem
from .neighbourhood import cut_neighbourhood, find_fixed_cut_nodes
from .waves import WavePlace

RISE_S, REST_S = 2.0, 5.0  # muscle tenses, and rests tensed, before the indenter touches
# Of the solver's tolerance: it is one of the reactions of all pins, of which the test pin's is a small part.
CLAMPED_TOLERANCE_SHARE = 0.1
PENETRATION_FACTOR = 3.0  # a percent of penetration costs half a percent of force (docs/contact.md)


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
    def bare(self) -> SiteModel:
        """The model of the site without clamps, activation and pre-stretch."""
        return replace(self, clamps=None, course=(), prestretch=())

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
            passive = Fibred(ground, **fibre)
            found[tissue] = passive if active is None else Contractile(passive, active)
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
