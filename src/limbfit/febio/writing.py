"""A problem as an input of FEBio 4.0 (``.feb``) that runs unedited and opens in FEBio Studio.

Numbers are written so that they are read back as they are.  Units: mm, N, s, MPa.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError, RunError
from ..fe import Material, Problem, StepControl, System
from ..fe.solution.control import schedule
from .faceting import Tool, blunt, tool_mesh
from .model import Contact
from .penalty import explicit_penalty, mean_stiffness

Array = NDArray[np.float64]

INDENTER = "indenter"
PATCH, FRONT, HELD = "contact_patch", "indenter_front", "held"
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


def write_feb(problem: Problem, path: str | Path, settings: FebSettings | None = None) -> Tool:
    """Write an indentation as FEBio input; returns the indenter's rigid mesh.

    Raises
    ------
    ProblemError
        For a problem that FEBio cannot be given as it is: sticky contact, limbfit's own elements, no
        indenter, supports that move.
    RunError
        Where the file cannot be written.
    """
    check_exportable(problem, "FEBio")
    settings = settings or FebSettings()
    system = System(problem)
    assert system.indenter is not None
    tool = tool_mesh(system.indenter)
    try:
        with Path(path).open("w", encoding="utf-8") as stream:
            stream.writelines(f"{line}\n" for line in _lines(problem, system, tool, settings))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error
    return tool


def contact_of(problem: Problem, settings: FebSettings) -> Contact:
    """The contact that is written: FEBio's automatic penalty, or an explicit one as stiff as limbfit's."""
    penalty, automatic = settings.penalty, settings.penalty is not None
    if penalty is None:
        penalty = explicit_penalty(problem, settings.steps)
    return Contact("sliding-elastic", (PATCH, FRONT), penalty, automatic, False, 0)


def differences(problem: Problem, settings: FebSettings) -> tuple[str, ...]:
    """What FEBio still does otherwise with the input than limbfit does, a line each."""
    assert problem.indenter is not None
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
    if not blunt(problem.indenter):
        lines.append(
            "edge: FEBio's contact gets through with edges rounded by 2 mm, or a twentieth of the width; "
            "under one as sharp as this it may stop before the end"
        )
    return tuple(lines)


def check_exportable(problem: Problem, program: str) -> None:
    """Raise `ProblemError` where another program cannot be given the problem as it is."""
    name = problem.formulation.name
    if name not in _QUADRATURE:
        known = ", ".join(_QUADRATURE)
        raise ProblemError(f"{program} has no element {name!r}", remedy=f"export with one of {known}")
    if problem.indenter is None or problem.supports:
        raise ProblemError(f"only indentations with fixed nodes are written for {program}")
    if problem.history.across is not None:
        raise ProblemError(f"a move across the indenter's axis is not written for {program}")
    if problem.history.forced or problem.bodies:
        raise ProblemError(f"an indenter under force, or further rigid bodies, are not written for {program}")
    if problem.pressures:
        raise ProblemError(f"a pressure is not written for {program}")
    if problem.friction == "sticky" or (problem.friction != "frictionless" and program != "FEBio"):
        raise ProblemError(
            f"friction is not written for {program}" if program != "FEBio" else "FEBio has no sticky contact",
            remedy='export with friction = "frictionless"',
        )
    taken = {*problem.mesh.node_sets, *problem.mesh.face_sets} & {PATCH, FRONT, HELD}
    if taken or INDENTER in problem.mesh.region_names:
        raise ProblemError(f"a set or tissue has the name {(*taken, INDENTER)[0]!r}, which is the indenter's")


def _lines(problem: Problem, system: System, tool: Tool, settings: FebSettings) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    for words in (f"limbfit: {settings.title}; mm, N, s, MPa", *differences(problem, settings)):
        yield f"<!-- {escape(' '.join(words.replace('--', '-').split()))} -->"
    yield '<febio_spec version="4.0">'
    yield '<Module type="solid"/>'
    yield from _control(problem, settings)
    yield "<Globals><Constants><T>0</T><R>0</R><Fc>0</Fc></Constants></Globals>"
    yield "<Material>"
    regions = problem.mesh.region_names
    for i, name in enumerate(regions, 1):
        yield from material_lines(i, name, problem.materials[name])
    assert system.indenter is not None
    yield (
        f'<material id="{len(regions) + 1}" name="{INDENTER}" type="rigid body"><density>1</density>'
        f"<center_of_mass>{_row(np.asarray(system.indenter.centre))}</center_of_mass></material>"
    )
    yield "</Material>"
    yield from _mesh(problem, tool)
    yield from _domains(problem, tool)
    yield f'<Boundary><bc name="held" node_set="{HELD}" type="zero displacement">'
    yield "<x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof></bc></Boundary>"
    yield from _rigid(system.indenter.frame[2])
    yield from _contact(problem, settings)
    yield from _load_curves(problem, settings)
    yield from _output(len(regions) + 1, settings)
    yield "</febio_spec>"


def _control(problem: Problem, settings: FebSettings) -> Iterator[str]:
    """Steps that FEBio grows and halves; stiff contact needs a tangent in every iteration.

    With an explicit penalty quasi-Newton updates stall.
    """
    end, size = float(problem.history.times[-1]), first_step(problem)
    updates, reformations = (0, 60) if settings.penalty is None else (10, 25)
    yield f"<Control><analysis>STATIC</analysis><time_steps>{round(end / size)}</time_steps>"
    yield f"<step_size>{size!r}</step_size>"
    yield "<plot_level>PLOT_MUST_POINTS</plot_level><output_level>OUTPUT_MAJOR_ITRS</output_level>"
    yield '<time_stepper type="default"><max_retries>8</max_retries><opt_iter>15</opt_iter>'
    yield f'<dtmin>{size / 100.0!r}</dtmin><dtmax lc="2">1</dtmax><aggressiveness>1</aggressiveness>'
    yield "</time_stepper>"
    matrix = "symmetric" if problem.friction == "frictionless" else "non-symmetric"
    yield f'<solver type="solid"><symmetric_stiffness>{matrix}</symmetric_stiffness>'
    yield f"<max_refs>{reformations}</max_refs>"
    yield "<dtol>0.001</dtol><etol>0.01</etol><rtol>1e-05</rtol><lstol>0.9</lstol>"
    yield f'<qn_method type="BFGS"><max_ups>{updates}</max_ups></qn_method></solver></Control>'


def largest_step(problem: Problem) -> float:
    """The largest step, s: a sixteenth of the loading, half of that under sharp edges."""
    assert problem.indenter is not None
    history = problem.history
    return history.loading_s / (16.0 if blunt(problem.indenter) else 32.0)


def first_step(problem: Problem) -> float:
    """The first step, s: a quarter of the largest at most, and a whole part of the time."""
    end = float(problem.history.times[-1])
    return end / float(np.ceil(4.0 * end / largest_step(problem)))


def material_lines(number: int, name: str, material: Material) -> Iterator[str]:
    """A tissue: Ogden terms, and relaxation around them.

    Raises
    ------
    ProblemError
        For more terms than FEBio takes.
    """
    table = material.table()
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
    if not prony:
        yield f'{head}"Ogden">{shared}{terms}</material>'
        return
    relaxation = "".join(
        f"<g{i}>{float(g)!r}</g{i}><t{i}>{float(tau)!r}</t{i}>" for i, (g, tau) in enumerate(prony, 1)
    )
    yield f'{head}"uncoupled viscoelastic">{shared}<g0>1</g0>{relaxation}'
    yield f'<elastic type="Ogden"><k>0</k>{terms}</elastic></material>'


def _mesh(problem: Problem, tool: Tool) -> Iterator[str]:
    mesh, count = problem.mesh, len(problem.mesh.points)
    yield '<Mesh><Nodes name="all">'
    for i, point in enumerate(np.vstack([mesh.points, tool.points]), 1):
        yield f'<node id="{i}">{_row(point)}</node>'
    yield "</Nodes>"
    number = 1
    for r, name in enumerate(mesh.region_names):
        cells = mesh.cells[mesh.regions == r]
        yield from _elements(name, mesh.cell_type, cells, number)
        number += len(cells)
    yield from _elements(INDENTER, tool.cell_type, tool.cells + count, number)
    for name, nodes in {HELD: problem.fixed, **mesh.node_sets}.items():
        if len(nodes):
            yield f"<NodeSet name={quoteattr(name)}>{_ids(nodes)}</NodeSet>"
    named = {  # FEBio makes an element set of every part
        f"{name}_surface" if name in mesh.region_names else name: faces
        for name, faces in mesh.face_sets.items()
    }
    surfaces = {PATCH: np.asarray(problem.contact_faces), FRONT: tool.front + count, **named}
    for name, faces in surfaces.items():
        yield from _surface(name, faces)
    yield f'<SurfacePair name="indentation"><primary>{PATCH}</primary><secondary>{FRONT}</secondary>'
    yield "</SurfacePair></Mesh>"


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


def _domains(problem: Problem, tool: Tool) -> Iterator[str]:
    rule = _QUADRATURE[problem.formulation.name]
    given = f' elem_type="{rule}"' if rule else ""
    if problem.formulation.name == "tet10p0":  # one volume ratio and pressure per element
        given += ' type="three-field-solid"'
    yield "<MeshDomains>"
    for name in problem.mesh.region_names:
        yield f"<SolidDomain name={quoteattr(name)} mat={quoteattr(name)}{given}/>"
    if tool.cell_type == "hex8":
        yield f'<SolidDomain name="{INDENTER}" mat="{INDENTER}"/>'
    else:
        yield f'<ShellDomain name="{INDENTER}" mat="{INDENTER}">'
        yield "<shell_thickness>0.01</shell_thickness></ShellDomain>"
    yield "</MeshDomains>"


def _rigid(axis: Array) -> Iterator[str]:
    held = "".join(f"<R{x}_dof>{int(axis[i] == 0.0)}</R{x}_dof>" for i, x in enumerate("xyz"))
    turns = "".join(f"<R{x}_dof>1</R{x}_dof>" for x in "uvw")
    yield f'<Rigid><rigid_bc name="guide" type="rigid_fixed"><rb>{INDENTER}</rb>{held}{turns}</rigid_bc>'
    for i, x in enumerate("xyz"):
        if axis[i] != 0.0:
            yield f'<rigid_bc name="advance_{x}" type="rigid_displacement"><rb>{INDENTER}</rb><dof>{x}</dof>'
            yield f'<value lc="1">{float(axis[i])!r}</value><relative>0</relative></rigid_bc>'
    yield "</Rigid>"


def _contact(problem: Problem, settings: FebSettings) -> Iterator[str]:
    """The way of the reference cases; the search reaches as far as the punch goes in, and half again."""
    reach = max(1.5 * float(problem.history.driver.max()), 2.0)
    yield '<Contact><contact name="indentation" type="sliding-elastic" surface_pair="indentation">'
    contact = contact_of(problem, settings)
    yield f"<laugon>PENALTY</laugon><penalty>{contact.penalty!r}</penalty>"
    yield f"<auto_penalty>{contact.automatic:d}</auto_penalty>"
    smooth = problem.friction == "frictionless"
    yield f"<two_pass>0</two_pass><symmetric_stiffness>{smooth:d}</symmetric_stiffness>"
    yield "<search_tol>0.01</search_tol>"
    if not smooth:
        yield f"<fric_coeff>{float(problem.friction)!r}</fric_coeff>"
    yield f"<search_radius>{reach!r}</search_radius></contact></Contact>"


def _load_curves(problem: Problem, settings: FebSettings) -> Iterator[str]:
    """1: the advance of the indenter, mm; 2: the largest step, s, at the times that must be met."""
    history = problem.history
    musts = np.concatenate([[0.0], schedule(history, settings.steps)])
    curves = [
        ("advance", "LINEAR", np.column_stack([history.times, history.driver])),
        ("must_points", "STEP", np.column_stack([musts, np.full(len(musts), largest_step(problem))])),
    ]
    yield "<LoadData>"
    for i, (name, interpolate, points) in enumerate(curves, 1):
        yield f'<load_controller id="{i}" name="{name}" type="loadcurve">'
        yield f"<interpolate>{interpolate}</interpolate><extend>CONSTANT</extend><points>"
        yield from (f"<pt>{_row(point)}</pt>" for point in points)
        yield "</points></load_controller>"
    yield "</LoadData>"


def _output(number: int, settings: FebSettings) -> Iterator[str]:
    variables = ("displacement", "stress", "relative volume", "contact pressure", "contact gap")
    yield '<Output><plotfile type="febio">' + "".join(f'<var type="{name}"/>' for name in variables)
    yield "</plotfile><logfile>"
    file = quoteattr(settings.force_file)
    data = f'<rigid_body_data data="Fx;Fy;Fz;x;y;z" file={file} delim=",">'
    yield f"{data}{number}</rigid_body_data></logfile></Output>"


def _row(values: Iterable[float]) -> str:
    return ",".join(repr(float(value)) for value in values)


def _ids(nodes: Iterable[int]) -> str:
    return ",".join(str(int(node) + 1) for node in nodes)
