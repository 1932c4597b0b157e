"""A problem written as an input of FEBio 4.0 (``.feb``) that runs unedited and opens in FEBio Studio.

Numbers are written so that they are read back exactly. Units: mm, N, s, MPa.

In a tissue, a contraction stands beside what relaxes, because an active stress is given as it is. A
pre-strain stands around all of it, and FEBio's pressure does not see it. Each cell has
an axis of its own along its fibres.

Source: FEBio User Manual 4.0, chapter 4, and the section on ``MeshData``; ``FEActiveFiberStressUC`` and
``FEPreStrainUncoupledElastic``.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from ..arrays import Array
from ..errors import ProblemError, RunError
from ..fe import Motion, Problem, StepControl
from ..fe.solution.control import schedule_steps
from ..mesh import Mesh
from .bodies import (
    FIXED_SET,
    FRAME_BODY,
    FRONT,
    INDENTER,
    PATCH,
    QUADRATURE,
    CurveList,
    FebBody,
    RigidMesh,
    build_bodies,
    build_frame_mesh,
    find_step_ends,
    has_round_edges,
    list_conditions,
    list_parts,
    name_surfaces,
)
from .penalty import compute_explicit_penalty, compute_mean_stiffness
from .preparation import PRESTRAIN_S, Preparation, prepare_problem
from .reading.materials import ACTIVE, FIBRE, FIRST_AXIS, GRADIENT, MIXTURE, PRESTRAINED, RELAXED
from .reading.model import Contact

REST = Motion(np.array([0.0, 1.0]), np.zeros((2, 6)))
PRESSURE_MODELS = {0: "default", 1: "NIKE3D", 2: "Abaqus"}
MAX_TERMS = 6  # of Ogden and of Prony in FEBio


@dataclass(frozen=True)
class FebSettings:
    """What FEBio needs and limbfit does not.

    ``penalty``: multiple of FEBio's automatic penalty (above 3, tet10 retry or stall); None: an explicit one
    as stiff as limbfit's contact. ``steps``: limbfit's step control, whose times FEBio must meet and whose
    penalty is the explicit one. ``force_file``: name of the table of the indenter's force and position.
    ``title``: one line in the head of the file.
    """

    penalty: float | None = None
    steps: StepControl = field(default_factory=StepControl)
    force_file: str = "forces.txt"
    title: str = ""


def write_feb(problem: Problem, path: str | Path, settings: FebSettings | None = None) -> RigidMesh | None:
    """Write a problem as FEBio input; return the rigid mesh of its indenter, or of its first body, if any.
    Raises `ProblemError` for a problem that FEBio cannot be given as it is: sticky contact, limbfit's own
    elements, a force along an axis between those of space that is not all that drives a body; and as
    `prepare_problem`, and `RunError` if the file cannot be written.
    """
    settings = settings or FebSettings()
    bodies, prepared = _check_bodies(problem), problem
    forced = any(np.asarray(body.motion.forced)[0].any() for body in problem.rigid_bodies)
    if forced or Preparation.from_problem(problem).seconds or problem.touch_down_s:
        prepared, motions = prepare_problem(problem, settings.steps)
        bodies = build_bodies(prepared, motions)
    write_template(path, "model.feb.j2", **_describe_file(problem, prepared, bodies, settings))
    return bodies[0].tool if bodies else None


def _check_bodies(problem: Problem) -> list[FebBody]:
    """Return the rigid bodies of a problem; raise `ProblemError` if FEBio cannot be given it."""
    check_element(problem, "FEBio")
    _find_prestrains(problem)
    if problem.touch_down_s and any(support.factor for support in problem.supports):
        raise ProblemError("nodes that move with an indenter which touches later are not written for FEBio")
    tenses = problem.activation is not None and any(m.table().active for m in problem.materials.values())
    if not (tenses or problem.rigid_bodies or problem.pressures or any(s.factor for s in problem.supports)):
        raise ProblemError("nothing drives the problem: there is nothing to write for FEBio")
    if any(body.friction == "sticky" for body in problem.rigid_bodies):
        raise ProblemError("FEBio has no sticky contact", remedy='export with friction = "frictionless"')
    bodies = build_bodies(problem)
    mesh = problem.mesh
    own = {name for body in bodies for name in (body.name, body.patch, body.front)} | {FIXED_SET, FRAME_BODY}
    taken = own & {*mesh.node_sets, *mesh.face_sets, *mesh.region_names}
    if taken:
        raise ProblemError(f"a set or tissue has the name {min(taken)!r}, which is a rigid body's")
    return bodies


def build_contact(problem: Problem, settings: FebSettings) -> Contact:
    """Build the contact to write: FEBio's automatic penalty, or an explicit one as stiff as limbfit's."""
    penalty, automatic = settings.penalty, settings.penalty is not None
    if penalty is None:
        penalty = compute_explicit_penalty(problem, settings.steps)
    return Contact("sliding-elastic", (PATCH, FRONT), penalty, automatic, augmented=False, line=0)


def describe_differences(problem: Problem, settings: FebSettings) -> tuple[str, ...]:
    """Describe, a line each, what FEBio still does differently with the input."""
    own, automatic = compute_explicit_penalty(problem, settings.steps), settings.penalty is not None
    if automatic:
        first_step_s = _divide_evenly(float(problem.history.times[-1]), 0.25 * _compute_largest_step(problem))
        mean = compute_mean_stiffness(build_contact(problem, settings), problem, first_step_s)
        contact = (
            f"contact: {settings.penalty:g} times FEBio's automatic penalty, {mean:.3g} MPa/mm in the mean, "
            f"where {own:.3g} were as stiff as limbfit's: the indenter sinks in further and the force is "
            "smaller, most where tissue is thin"
        )
    else:
        contact = (
            f"contact: a penalty of {own:.3g} MPa/mm, as stiff as limbfit's; FEBio's acts along the skin's "
            "normal and over its current area, limbfit's away from the indenter and over the area at rest"
        )
    lines = [contact, "indenter: facets, without the side walls", "time: FEBio's own steps"]
    if not automatic:
        lines.append("force: within 2 % of the peak of limbfit's, as far as these go")
    preparation = Preparation.from_problem(problem)
    if preparation.settling_s:
        lines.append(
            f"pre-strain: grows in {PRESTRAIN_S:g} s and relaxes until {preparation.settling_s:g} s; the "
            f"history begins at {preparation.seconds:g} s"
        )
    if preparation.approach_s or problem.touch_down_s:
        lines.append(
            "touch-down: where limbfit has found it, which holds for these parameters alone; FEBio brings "
            "the indenter there"
        )
    if any(np.asarray(body.motion.forced)[0].any() for body in problem.rigid_bodies):
        lines.append(
            "forces: begin after limbfit's first step, in which FEBio moves the body to where limbfit has "
            "found it then"
        )
    if any(body.rail is not None for body in build_bodies(problem)):
        lines.append("guides: bodies under a force go along a prismatic joint, held by a penalty")
    slides = [body.sticking for body in problem.rigid_bodies if body.friction not in ("frictionless", 0.0)]
    if "anchored" in slides:
        lines.append(
            "sticking: FEBio anchors what sticks anew in every step, so that it slips on in time; "
            'limbfit does so with sticking = "stepwise"'
        )
    if not has_round_edges(problem):
        lines.append(
            "edge: FEBio's contact gets through with edges rounded by 2 mm, or a twentieth of the width; "
            "under one as sharp as this it may stop before the end"
        )
    return tuple(lines)


def check_element(problem: Problem, program: str) -> None:
    """Raise `ProblemError` if another program has no such element."""
    name = problem.formulation.name
    if name not in QUADRATURE:
        known = ", ".join(QUADRATURE)
        raise ProblemError(f"{program} has no element {name!r}", remedy=f"export with one of {known}")


def check_simple_indentation(problem: Problem, program: str) -> None:
    """Raise `ProblemError` if a problem is more than a frictionless indentation along the axis."""
    check_element(problem, program)
    moves_first = problem.prestretch is not None or problem.touch_down_s or problem.activation is not None
    without = "leave them out of the study, or export for FEBio"
    history, slides = problem.history, problem.friction not in ("frictionless", 0.0)
    for is_there, what, remedy in (
        (moves_first, "a limb that clamps, contraction or pre-stretch move first is", without),
        (problem.indenter is None or problem.supports, "other than an indentation with fixed nodes is", None),
        (history.across is not None, "a move across the indenter's axis is", None),
        (history.forced or problem.bodies, "an indenter under force, or further rigid bodies, are", None),
        (problem.pressures, "a pressure is", None),
        (slides, "friction is", 'export with friction = "frictionless"'),
    ):
        if is_there:
            raise ProblemError(f"{what} not written for {program}", remedy=remedy)
    taken = {*problem.mesh.node_sets, *problem.mesh.face_sets} & {PATCH, FRONT, FIXED_SET}
    if taken or INDENTER in problem.mesh.region_names:
        raise ProblemError(f"a set or tissue has the name {(*taken, INDENTER)[0]!r}, which is the indenter's")


def _describe_file(
    problem: Problem, prepared: Problem, bodies: list[FebBody], settings: FebSettings
) -> dict[str, Any]:
    """Return what the template of a file asks for; ``prepared`` is the problem in the file's own time.

    FEBio's own force on a rail's joint is left out, because the body's force stands among its loads.
    """
    curves, settled = CurveList(), Preparation.from_problem(problem).settling_s
    ends = find_step_ends([body.motion for body in bodies], float(prepared.history.times[-1]), settled)
    rigid = [list_conditions(body.name, body.motion, ends, curves) for body in bodies]
    steps: list[dict[str, Any]] = []
    for k, (begin, end) in enumerate(pairwise([0.0, *ends])):
        largest = PRESTRAIN_S / 10.0 if end <= settled else _compute_largest_step(problem)
        size = _divide_evenly(end - begin, 0.25 * largest)  # of the first steps, s, which FEBio enlarges
        own = [one for body in rigid for one in body[k]]
        steps.append({"count": round((end - begin) / size), "size": size, "conditions": own})
    meshes = {body.name: body.tool for body in bodies}
    centres = {body.name: body.centre for body in bodies}
    everywhere = steps[0]["conditions"] if len(steps) == 1 else []
    if any(body.rail is not None for body in bodies):
        meshes[FRAME_BODY] = build_frame_mesh(bodies)
        centres[FRAME_BODY] = meshes[FRAME_BODY].points[0]
        everywhere = [*everywhere, *list_conditions(FRAME_BODY, REST, ends[-1:], curves)[0]]
    remarks = (f"limbfit: {settings.title}; mm, N, s, MPa", *describe_differences(problem, settings))
    history, prestrains = prepared.history, _find_prestrains(problem)
    supports = {f"support_{i}": support.nodes for i, support in enumerate(problem.supports, 1)}
    fibres = {} if problem.fibres is None else _divide_by_region(problem.mesh, problem.fibres, (3,))
    return {
        "problem": problem,
        "bodies": bodies,
        "rigid_meshes": meshes,
        "centres": centres,
        "remarks": [Markup(escape(" ".join(text.replace("--", "-").split()))) for text in remarks],
        "steps": steps,
        "conditions": everywhere,
        "contact": build_contact(problem, settings),
        "is_symmetric": not problem.pressures and not any(body.has_friction for body in bodies),
        "points": np.vstack([problem.mesh.points, *(mesh.points for mesh in meshes.values())]),
        "parts": list(list_parts(problem, meshes)),
        "node_sets": {FIXED_SET: problem.fixed, **problem.mesh.node_sets, **supports},
        "surfaces": name_surfaces(problem, bodies),
        "quadrature": QUADRATURE[problem.formulation.name],
        # FEBio takes axes of a material in some kinds of materials only, those of elements in all.
        "fibre_maps": {
            name: own for name, own in fibres.items() if problem.materials[name].table().has_fibres
        },
        "prestrain_maps": {name: own for name, own in prestrains.items() if len(own) > 1},
        "prestrain_names": {name: re.sub(r"\W", "_", f"prestrain of {name}") for name in prestrains},
        "fixed_set": FIXED_SET,
        "frame_body": FRAME_BODY,
        "force_file": settings.force_file,
        "must_curve": curves.add("must_points", _find_must_points(problem, settings), "STEP"),
        "history_curve": curves.add("history", np.column_stack([history.times, history.driver]))
        if any(support.factor for support in problem.supports)
        else 0,
        "pressure_curves": [
            curves.add(f"pressure_{i}", np.column_stack([one.times, one.values]))
            for i, one in enumerate(prepared.pressures, 1)
        ],
        "materials": list(_describe_materials(prepared, curves, settled)),
        "kinds": {"fibre": FIBRE, "relaxed": RELAXED, "active": ACTIVE, "prestrained": PRESTRAINED},
        "mixture": MIXTURE,
        "first_axis": FIRST_AXIS,
        "gradient": GRADIENT,
        "curves": curves,
    }


def _find_must_points(problem: Problem, settings: FebSettings) -> Array:
    """Return the times (k,) that FEBio must meet and the largest step up to each, s."""
    preparation = Preparation.from_problem(problem)
    largest = _compute_largest_step(problem)
    points = [(0.0, largest)]
    if preparation.settling_s:
        points = [(0.0, PRESTRAIN_S / 10.0), (PRESTRAIN_S, PRESTRAIN_S / 10.0)]
        if rest := preparation.settling_s - PRESTRAIN_S:
            points.append((preparation.settling_s, rest / 10.0))
    own = preparation.seconds + schedule_steps(problem.history, settings.steps, problem.turns)
    return np.array([*points, *((float(time), largest) for time in own)])


def _describe_materials(problem: Problem, curves: CurveList, settled: float) -> Iterator[dict[str, Any]]:
    """Describe the tissues, with the numbers of the curves of their contraction and of their pre-strain.

    Raises `ProblemError` for more terms than FEBio takes.
    """
    strained, course = _find_prestrains(problem), 0
    if problem.activation is not None:
        shares = np.column_stack([problem.activation.times, problem.activation.shares])
        course = curves.add("activation", shares)
    ramp = curves.add("prestrain", np.array([[0.0, 0.0], [PRESTRAIN_S, 1.0]])) if settled else 0
    for name in problem.mesh.region_names:
        table = problem.materials[name].table()
        prony = [(g, tau) for g, tau in table.prony if g != 0.0]
        if max(len(prony), len(table.terms)) > MAX_TERMS:
            raise ProblemError(f"tissue {name!r} has more than {MAX_TERMS} terms, which FEBio does not take")
        elastic = ["Ogden", FIBRE] if table.fibre[0] > 0.0 else ["Ogden"]
        solids = [*([RELAXED] if prony else elastic), *([ACTIVE] if table.active > 0.0 else [])]
        yield {
            "name": name,
            "table": table,
            "prony": prony,
            "elastic": elastic,
            "solids": solids,
            "course": course,
            "ramp": ramp,
            "prestrains": strained.get(name, ()),
            "pressure_model": PRESSURE_MODELS[table.volumetric],
        }


def _compute_largest_step(problem: Problem) -> float:
    """Return the largest step, s: a sixteenth of the first way in, half of that under sharp edges."""
    ways = [] if problem.indenter is None else [problem.history.loading_s - problem.touch_down_s]
    for body in problem.bodies:
        ends = [*body.motion.turns, body.motion.times[-1]]
        ways += [float(ends[0])] if body.motion.values.any() else []
    return min(ways, default=float(problem.history.times[-1])) / (16.0 if has_round_edges(problem) else 32.0)


def _divide_evenly(span: float, size: float) -> float:
    """Return a whole fraction of a span of time, not above ``size``, s."""
    return span / float(np.ceil(span / size))


def _find_prestrains(problem: Problem) -> dict[str, Array]:
    """Return the pre-stretches of each region that has some: (1, 3, 3), or one for each of its cells.

    Raises `ProblemError` if one changes the volume, which FEBio's pressure would not see.
    """
    found = {} if problem.prestretch is None else _divide_by_region(problem.mesh, problem.prestretch, (3, 3))
    found = {name: own[:1] if (own == own[:1]).all() else own for name, own in found.items()}
    for name, own in found.items():
        if np.abs(np.linalg.det(own) - 1.0).max(initial=0.0) > 1e-9:
            raise ProblemError(
                f"the pre-stretch of tissue {name!r} changes its volume, which FEBio's pressure does not see",
                remedy="give one of constant volume (limbfit.fe.isochoric_stretch)",
            )
    return {name: own for name, own in found.items() if np.abs(own - np.eye(3)).max(initial=0.0) > 0.0}


def _divide_by_region(mesh: Mesh, values: Any, shape: tuple[int, ...]) -> dict[str, Array]:
    """Return values of cells (or the one of all), of a ``shape``, by region."""
    given = np.broadcast_to(np.asarray(values, dtype=float), (len(mesh.cells), *shape))
    return {name: given[mesh.regions == r] for r, name in enumerate(mesh.region_names)}


def format_row(values: Iterable[float]) -> str:
    """Write numbers with commas, so that they are read back exactly."""
    return ",".join(repr(float(value)) for value in values)


def wrap_numbers(numbers: Iterable[int]) -> str:
    """Write at most 15 numbers in a line, as Abaqus asks; a line that continues ends with a comma."""
    listed = [str(int(number)) for number in numbers]
    return ",\n".join(", ".join(listed[i : i + 15]) for i in range(0, len(listed), 15))


_FILTERS: dict[str, Callable[[Any], Any]] = {  # of the templates
    "row": format_row,
    # With commas, each in the 20 characters that Abaqus and CalculiX take at most.
    "fields": lambda values: ", ".join(f"{float(value):.12g}" for value in values),
    "ids": lambda nodes: ",".join(str(int(node) + 1) for node in nodes),  # FEBio's count from 1
    "wrap": wrap_numbers,
    "across": lambda direction: np.eye(3)[np.argmin(np.abs(direction))],  # the axis of space most across it
}


def write_template(path: str | Path, template: str, **content: Any) -> None:
    """Write a file from one of the templates; raise `RunError` if it cannot be written."""
    environment = Environment(
        loader=PackageLoader("limbfit.febio", "templates"),
        autoescape=select_autoescape(("feb.j2",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= _FILTERS
    text = environment.get_template(template).render(content)
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error
