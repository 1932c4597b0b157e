"""A problem as an input of FEBio 4.0 (``.feb``) that runs unedited and opens in FEBio Studio.

Numbers are written so that they are read back as they are.  Units: mm, N, s, MPa.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError, RunError
from ..fe import Indenter, Material, Problem, StepControl
from ..fe.solution.control import schedule
from .faceting import FRONT, INDENTER, PATCH, Body, ToolMesh, blunt, written_bodies
from .fibres import axes_of_cells, axis_of, directions
from .moving import HELD, Curves, boundary_lines, conditions, pressure_lines, row, step_ends
from .penalty import explicit_penalty, mean_stiffness
from .reading.model import Contact

Array = NDArray[np.float64]

# FEBio's names of limbfit's elements; hex8 with an uncoupled material is three-field by itself.
_QUADRATURE = {"tet4": "", "tet10": "TET10G4", "tet10p0": "TET10G4", "tet10g8": "TET10G8", "hex8": ""}
_FACE = {3: "tri3", 4: "quad4", 6: "tri6"}
_PRESSURE_MODELS = {0: "default", 1: "NIKE3D", 2: "Abaqus"}
MOST_TERMS = 6  # of Ogden and of Prony in FEBio


@dataclass(frozen=True)
class FebSettings:
    """What FEBio needs and limbfit does not.

    Parameters
    ----------
    penalty : times FEBio's automatic one (above 3, tet10 retry or stall); None: an explicit one as stiff as
        limbfit's contact.
    steps : limbfit's step control: its times FEBio must meet, its penalty is the explicit one.
    force_file : name of the table of the indenter's force and position.
    title : one line in the head of the file.
    """

    penalty: float | None = None
    steps: StepControl = field(default_factory=StepControl)
    force_file: str = "forces.txt"
    title: str = ""


def write_feb(problem: Problem, path: str | Path, settings: FebSettings | None = None) -> ToolMesh | None:
    """Write a problem as FEBio input; returns the rigid mesh of its indenter, or of its first body, if any.

    Raises
    ------
    ProblemError
        For a problem that FEBio cannot be given as it is: sticky contact, limbfit's own elements, a force
        along an axis askew.
    RunError
        Where the file cannot be written.
    """
    settings = settings or FebSettings()
    bodies = _checked_bodies(problem)
    try:
        with Path(path).open("w", encoding="utf-8") as stream:
            stream.writelines(f"{line}\n" for line in _lines(problem, bodies, settings))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error
    return bodies[0].tool if bodies else None


def _checked_bodies(problem: Problem) -> list[Body]:
    """The rigid bodies of a problem that FEBio can be given.

    Raises
    ------
    ProblemError
        Where it cannot.
    """
    check_element(problem, "FEBio")
    if not (problem.rigid_bodies or problem.pressures or any(s.factor for s in problem.supports)):
        raise ProblemError("nothing drives the problem: there is nothing to write for FEBio")
    if any(body.friction == "sticky" for body in problem.rigid_bodies):
        raise ProblemError("FEBio has no sticky contact", remedy='export with friction = "frictionless"')
    bodies = written_bodies(problem)
    mesh = problem.mesh
    own = {name for body in bodies for name in (body.name, body.patch, body.front)} | {HELD}
    taken = own & {*mesh.node_sets, *mesh.face_sets, *mesh.region_names}
    if taken:
        raise ProblemError(f"a set or tissue has the name {min(taken)!r}, which is a rigid body's")
    return bodies


def contact_of(problem: Problem, settings: FebSettings) -> Contact:
    """The contact that is written: FEBio's automatic penalty, or an explicit one as stiff as limbfit's."""
    penalty, automatic = settings.penalty, settings.penalty is not None
    if penalty is None:
        penalty = explicit_penalty(problem, settings.steps)
    return Contact("sliding-elastic", (PATCH, FRONT), penalty, automatic, False, 0)


def differences(problem: Problem, settings: FebSettings) -> tuple[str, ...]:
    """What FEBio still does otherwise with the input than limbfit does, a line each."""
    own, automatic = explicit_penalty(problem, settings.steps), settings.penalty is not None
    if automatic:
        mean = mean_stiffness(contact_of(problem, settings), problem, first_step(problem))
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
    if any(_slides(body.friction) and body.sticking == "anchored" for body in problem.rigid_bodies):
        lines.append(
            "sticking: FEBio anchors what sticks anew in every step, so that it slips on in time; "
            'limbfit does so with sticking = "stepwise"'
        )
    shapes = [body.shape for body in problem.rigid_bodies]
    if not all(blunt(shape) for shape in shapes if isinstance(shape, Indenter)):
        lines.append(
            "edge: FEBio's contact gets through with edges rounded by 2 mm, or a twentieth of the width; "
            "under one as sharp as this it may stop before the end"
        )
    return tuple(lines)


def check_element(problem: Problem, program: str) -> None:
    """Raise `ProblemError` where another program has no such element, or no such beginning."""
    if problem.prestretch is not None or problem.touch_down_s:
        what = f"a limb that clamps, contraction or pre-stretch move first is not written for {program}"
        raise ProblemError(what, remedy="leave them out of the study")
    name = problem.formulation.name
    if name not in _QUADRATURE:
        known = ", ".join(_QUADRATURE)
        raise ProblemError(f"{program} has no element {name!r}", remedy=f"export with one of {known}")


def check_plain(problem: Problem, program: str) -> None:
    """Raise `ProblemError` where a problem is more than a frictionless indentation along the axis."""
    check_element(problem, program)
    if problem.indenter is None or problem.supports:
        raise ProblemError(f"only indentations with fixed nodes are written for {program}")
    if problem.history.across is not None:
        raise ProblemError(f"a move across the indenter's axis is not written for {program}")
    if problem.history.forced or problem.bodies:
        raise ProblemError(f"an indenter under force, or further rigid bodies, are not written for {program}")
    if problem.pressures:
        raise ProblemError(f"a pressure is not written for {program}")
    if problem.friction != "frictionless":
        raise ProblemError(
            f"friction is not written for {program}", remedy='export with friction = "frictionless"'
        )
    taken = {*problem.mesh.node_sets, *problem.mesh.face_sets} & {PATCH, FRONT, HELD}
    if taken or INDENTER in problem.mesh.region_names:
        raise ProblemError(f"a set or tissue has the name {(*taken, INDENTER)[0]!r}, which is the indenter's")


def _lines(problem: Problem, bodies: list[Body], settings: FebSettings) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    for words in (f"limbfit: {settings.title}; mm, N, s, MPa", *differences(problem, settings)):
        yield f"<!-- {escape(' '.join(words.replace('--', '-').split()))} -->"
    curves, regions = Curves(), problem.mesh.region_names
    end = float(problem.history.times[-1])
    ends = step_ends([body.motion for body in bodies], end)
    rigid = [conditions(body.name, body.motion, ends, curves) for body in bodies]
    by_step = [[line for body in rigid for line in body[k]] for k in range(len(ends))]
    musts = np.concatenate([[0.0], schedule(problem.history, settings.steps, problem.turns)])
    largest = np.full(len(musts), largest_step(problem))
    must = curves.add("must_points", np.column_stack([musts, largest]), "STEP")
    boundary = list(boundary_lines(problem, curves))
    loads = list(pressure_lines(problem, curves))
    controls = [list(_control(problem, settings, must, *span)) for span in pairwise([0.0, *ends])]
    yield '<febio_spec version="4.0">'
    yield '<Module type="solid"/>'
    if len(ends) == 1:
        yield from controls[0]
    yield "<Globals><Constants><T>0</T><R>0</R><Fc>0</Fc></Constants></Globals>"
    yield "<Material>"
    axes = directions(problem)
    for i, name in enumerate(regions, 1):
        yield from material_lines(i, name, problem.materials[name], axis_of(axes.get(name)))
    for i, body in enumerate(bodies, len(regions) + 1):
        yield (
            f'<material id="{i}" name={quoteattr(body.name)} type="rigid body"><density>1</density>'
            f"<center_of_mass>{row(body.centre)}</center_of_mass></material>"
        )
    yield "</Material>"
    yield from _mesh(problem, bodies)
    yield from _domains(problem, bodies)
    yield from axes_of_cells(problem)
    yield from ("<Boundary>", *boundary, "</Boundary>")
    if bodies and len(ends) == 1:
        yield from ("<Rigid>", *by_step[0], "</Rigid>")
    if bodies:
        contacts = (line for body in bodies for line in _contact(problem, body, settings))
        yield from ("<Contact>", *contacts, "</Contact>")
    if loads:
        yield from ("<Loads>", *loads, "</Loads>")
    yield from curves.lines()
    if len(ends) > 1:
        yield "<Step>"
        for k, (control, lines) in enumerate(zip(controls, by_step), 1):
            yield from (f'<step id="{k}">', *control, "<Rigid>", *lines, "</Rigid>", "</step>")
        yield "</Step>"
    yield from _output(range(len(regions) + 1, len(regions) + len(bodies) + 1), settings)
    yield "</febio_spec>"


def _control(problem: Problem, settings: FebSettings, must: int, begin: float, end: float) -> Iterator[str]:
    """Steps that FEBio grows and halves; stiff contact needs a tangent in every iteration.

    With an explicit penalty quasi-Newton updates stall.
    """
    size = _dividing(end - begin, 0.25 * largest_step(problem))
    updates, reformations = (0, 60) if settings.penalty is None else (10, 25)
    yield f"<Control><analysis>STATIC</analysis><time_steps>{round((end - begin) / size)}</time_steps>"
    yield f"<step_size>{size!r}</step_size>"
    yield "<plot_level>PLOT_MUST_POINTS</plot_level><output_level>OUTPUT_MAJOR_ITRS</output_level>"
    yield '<time_stepper type="default"><max_retries>8</max_retries><opt_iter>15</opt_iter>'
    yield f'<dtmin>{size / 100.0!r}</dtmin><dtmax lc="{must}">1</dtmax><aggressiveness>1</aggressiveness>'
    yield "</time_stepper>"
    smooth = not problem.pressures and not any(_slides(body.friction) for body in problem.rigid_bodies)
    matrix = "symmetric" if smooth else "non-symmetric"
    yield f'<solver type="solid"><symmetric_stiffness>{matrix}</symmetric_stiffness>'
    yield f"<max_refs>{reformations}</max_refs>"
    yield "<dtol>0.001</dtol><etol>0.01</etol><rtol>1e-05</rtol><lstol>0.9</lstol>"
    yield f'<qn_method type="BFGS"><max_ups>{updates}</max_ups></qn_method></solver></Control>'


def _slides(friction: str | float) -> bool:
    """Whether a body slides with friction."""
    return friction not in ("frictionless", 0.0)


def largest_step(problem: Problem) -> float:
    """The largest step, s: a sixteenth of the first way in, half of that under sharp edges."""
    ways = [] if problem.indenter is None else [problem.history.loading_s]
    for body in problem.bodies:
        ends = [*body.motion.turns, body.motion.times[-1]]
        ways += [float(ends[0])] if body.motion.values.any() else []
    shapes = [body.shape for body in problem.rigid_bodies]
    round_enough = all(blunt(shape) for shape in shapes if isinstance(shape, Indenter))
    return min(ways, default=float(problem.history.times[-1])) / (16.0 if round_enough else 32.0)


def first_step(problem: Problem) -> float:
    """The first step, s: a quarter of the largest at most, and a whole part of the time."""
    return _dividing(float(problem.history.times[-1]), 0.25 * largest_step(problem))


def _dividing(span: float, size: float) -> float:
    """A whole part of a span of time, not above ``size``, s."""
    return span / float(np.ceil(span / size))


def material_lines(number: int, name: str, material: Material, axis: str = "") -> Iterator[str]:
    """A tissue: Ogden terms, fibres beside them along ``axis``, and relaxation around them.

    Raises
    ------
    ProblemError
        For more terms than FEBio takes, and for tissue that contracts.
    """
    table = material.table()
    if table.active > 0.0:
        raise ProblemError(f"tissue {name!r} contracts, which is not written for other programs")
    prony = [(g, tau) for g, tau in table.prony if g != 0.0]
    if max(len(prony), len(table.terms)) > MOST_TERMS:
        raise ProblemError(f"tissue {name!r} has more than {MOST_TERMS} terms, which FEBio does not take")
    terms = "".join(
        f"<c{i}>{float(c)!r}</c{i}><m{i}>{float(m)!r}</m{i}>" for i, (c, m) in enumerate(table.terms, 1)
    )
    shared = (
        f"<k>{float(table.kappa)!r}</k><pressure_model>{_PRESSURE_MODELS[table.volumetric]}</pressure_model>"
    )
    head = f'<material id="{number}" name={quoteattr(name)} type='
    kind, content = "Ogden", terms
    if table.fibre[0] > 0.0:
        k1, k2 = map(float, table.fibre)
        kind = "uncoupled solid mixture"
        content = f'<solid type="Ogden">{terms}</solid><solid type="fiber-exp-pow-uncoupled">'
        content += f"<ksi>{k1!r}</ksi><alpha>{k2!r}</alpha><beta>2</beta></solid>"
    if not prony:
        yield f'{head}"{kind}">{axis}{shared}{content}</material>'
        return
    relaxation = "".join(
        f"<g{i}>{float(g)!r}</g{i}><t{i}>{float(tau)!r}</t{i}>" for i, (g, tau) in enumerate(prony, 1)
    )
    yield f'{head}"uncoupled viscoelastic">{axis}{shared}<g0>1</g0>{relaxation}'
    yield f'<elastic type="{kind}"><k>0</k>{content}</elastic></material>'


def _mesh(problem: Problem, bodies: list[Body]) -> Iterator[str]:
    mesh = problem.mesh
    firsts = np.cumsum([len(mesh.points), *(len(body.tool.points) for body in bodies)])
    yield '<Mesh><Nodes name="all">'
    for i, point in enumerate(np.vstack([mesh.points, *(body.tool.points for body in bodies)]), 1):
        yield f'<node id="{i}">{row(point)}</node>'
    yield "</Nodes>"
    number = 1
    for r, name in enumerate(mesh.region_names):
        cells = mesh.cells[mesh.regions == r]
        yield from _elements(name, mesh.cell_type, cells, number)
        number += len(cells)
    for body, first in zip(bodies, firsts):
        yield from _elements(body.name, body.tool.cell_type, body.tool.cells + first, number)
        number += len(body.tool.cells)
    sets = {HELD: problem.fixed, **mesh.node_sets}
    sets |= {f"support_{i}": support.nodes for i, support in enumerate(problem.supports, 1)}
    for name, nodes in sets.items():
        if len(nodes):
            yield f"<NodeSet name={quoteattr(name)}>{_ids(nodes)}</NodeSet>"
    named = {  # FEBio makes an element set of every part
        f"{name}_surface" if name in mesh.region_names else name: faces
        for name, faces in mesh.face_sets.items()
    }
    surfaces = {body.patch: body.faces for body in bodies}
    surfaces |= {body.front: body.tool.front + first for body, first in zip(bodies, firsts)}
    surfaces |= {f"pressed_{i}": np.asarray(one.faces) for i, one in enumerate(problem.pressures, 1)}
    for name, faces in {**surfaces, **named}.items():
        yield from _surface(name, faces)
    for body in bodies:
        yield f"<SurfacePair name={quoteattr(body.pair)}><primary>{body.patch}</primary>"
        yield f"<secondary>{body.front}</secondary></SurfacePair>"
    yield "</Mesh>"


def _elements(name: str, cell_type: str, cells: NDArray[np.int64], first: int) -> Iterator[str]:
    yield f"<Elements type={quoteattr(cell_type)} name={quoteattr(name)}>"
    for i, cell in enumerate(cells, first):
        yield f'<elem id="{i}">{_ids(cell)}</elem>'
    yield "</Elements>"


def _surface(name: str, faces: NDArray[np.int64]) -> Iterator[str]:
    kind = _FACE[faces.shape[1]]
    yield f"<Surface name={quoteattr(name)}>"
    for i, face in enumerate(faces, 1):
        yield f'<{kind} id="{i}">{_ids(face)}</{kind}>'
    yield "</Surface>"


def _domains(problem: Problem, bodies: list[Body]) -> Iterator[str]:
    rule = _QUADRATURE[problem.formulation.name]
    given = f' elem_type="{rule}"' if rule else ""
    if problem.formulation.name == "tet10p0":  # one volume ratio and pressure per element
        given += ' type="three-field-solid"'
    yield "<MeshDomains>"
    for name in problem.mesh.region_names:
        yield f"<SolidDomain name={quoteattr(name)} mat={quoteattr(name)}{given}/>"
    for body in bodies:
        names = f"name={quoteattr(body.name)} mat={quoteattr(body.name)}"
        if body.tool.cell_type == "hex8":
            yield f"<SolidDomain {names}/>"
        else:
            yield f"<ShellDomain {names}><shell_thickness>0.01</shell_thickness></ShellDomain>"
    yield "</MeshDomains>"


def _contact(problem: Problem, body: Body, settings: FebSettings) -> Iterator[str]:
    """The way of the reference cases; the search reaches as far as a body goes in, and half again."""
    ways = np.where(body.motion.free, 0.0, np.abs(body.motion.values))[:, :3]
    reach = max(1.5 * float(ways.max()), 10.0 if body.motion.free.any() else 2.0)
    pair = quoteattr(body.pair)
    yield f'<contact name={pair} type="sliding-elastic" surface_pair={pair}>'
    contact = contact_of(problem, settings)
    yield f"<laugon>PENALTY</laugon><penalty>{contact.penalty!r}</penalty>"
    yield f"<auto_penalty>{contact.automatic:d}</auto_penalty>"
    smooth = not _slides(body.friction)
    yield f"<two_pass>0</two_pass><symmetric_stiffness>{smooth:d}</symmetric_stiffness>"
    yield "<search_tol>0.01</search_tol>"
    if not smooth:
        yield f"<fric_coeff>{float(body.friction)!r}</fric_coeff>"
    yield f"<search_radius>{reach!r}</search_radius></contact>"


def _output(numbers: Iterable[int], settings: FebSettings) -> Iterator[str]:
    variables = ("displacement", "stress", "relative volume", "contact pressure", "contact gap")
    yield '<Output><plotfile type="febio">' + "".join(f'<var type="{name}"/>' for name in variables)
    items = ",".join(str(number) for number in numbers)
    table = f'data="Fx;Fy;Fz;x;y;z" file={quoteattr(settings.force_file)} delim=","'
    rigid = f"<logfile><rigid_body_data {table}>{items}</rigid_body_data></logfile>"
    yield f"</plotfile>{rigid if items else ''}</Output>"


def _ids(nodes: Iterable[int]) -> str:
    return ",".join(str(int(node) + 1) for node in nodes)
