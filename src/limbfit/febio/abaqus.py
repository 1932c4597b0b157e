"""A problem written as input of Abaqus or CalculiX (``.inp``), as far as they have limbfit's materials.

Both have Ogden's deviatoric law, and ``(J - 1)^2 / D`` where limbfit's tissue has ``kappa/2 (ln J)^2``: the
same at small changes of volume, with ``D = 2 / kappa``. Abaqus relaxes the stress in the current frame,
limbfit and FEBio in that of rest: the same while the volume hardly changes. CalculiX has no relaxation at
finite strain.

Source: Abaqus Theory Guide, "Hyperelastic material behavior", "Finite-strain viscoelasticity".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from ..arrays import Indices
from ..errors import ProblemError
from ..fe import Material, Problem, System
from ..mesh import Mesh
from .conditions import FIXED_SET, format_row, write_lines
from .meshes import FRONT, INDENTER, PATCH, RigidMesh, build_indenter_mesh
from .writing import FebSettings, check_simple_indentation

_ELEMENT = {"tet4": "C3D4", "tet10": "C3D10", "tet10p0": "C3D10H", "tet10g8": "C3D10", "hex8": "C3D8"}
# Faces of Abaqus' elements, S1 to S6, as corners of the element (from 0).
_FACES = {
    "tet": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "hex": ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
_NO_COMPRESSIBILITY = 1e12  # mm^2/N


def write_inp(problem: Problem, path: str | Path, program: str, settings: FebSettings) -> RigidMesh:
    """Write an indentation as ``.inp``; return the indenter's rigid mesh.

    Raises
    ------
    ProblemError
        If the program has no such material, and for what `write_feb` refuses, too.
    RunError
        If the file cannot be written.
    """
    check_simple_indentation(problem, program.capitalize())
    for name in problem.mesh.region_names:
        _check_material(name, problem.materials[name], program)
    system = System(problem)
    assert system.indenter is not None
    tool = build_indenter_mesh(system.indenter)
    if tool.cell_type != "hex8":
        raise ProblemError(f"indenters of shape {system.indenter.shape!r} are written for FEBio only")
    write_lines(path, _format_file(problem, system, tool, program, settings))
    return tool


def _check_material(name: str, material: Material, program: str) -> None:
    table = material.table()
    if table.has_fibres:
        raise ProblemError(f"tissue {name!r} has fibres, which are written for FEBio only")
    if program == "calculix" and any(g != 0.0 for g, _ in table.prony):
        raise ProblemError(
            f"tissue {name!r} relaxes, which CalculiX cannot do at finite strain",
            remedy="export with --parameters whose gamma is 0, for FEBio or for Abaqus",
        )
    if program == "calculix" and len(table.terms) > 3:
        raise ProblemError(f"tissue {name!r} has more than the 3 Ogden terms of CalculiX")
    if table.volumetric not in (0, 2):
        raise ProblemError(f"tissue {name!r} has a volumetric law that {program.capitalize()} has not")


def _format_file(
    problem: Problem, system: System, tool: RigidMesh, program: str, settings: FebSettings
) -> Iterator[str]:
    mesh, count = problem.mesh, len(problem.mesh.points)
    assert system.indenter is not None
    yield f"** limbfit: {' '.join(settings.title.split())}; mm, N, s, MPa; for {program.capitalize()}"
    yield "** volume: (J-1)^2/D in place of kappa/2 (ln J)^2"
    element = _ELEMENT[problem.formulation.name]
    if program == "calculix" and element == "C3D10H":
        element = "C3D10"
        yield "** element: C3D10 in place of one with constant pressure, which CalculiX has not; stiffer"
    yield "*NODE, NSET=all_nodes"
    reference = np.asarray(system.indenter.centre)
    for i, point in enumerate(np.vstack([mesh.points, tool.points, reference]), 1):
        yield f"{i}, {format_row(point, ', ')}"
    handle, numbers = count + len(tool.points) + 1, np.zeros(len(mesh.cells), np.int64)
    first = 1
    for r, name in enumerate(mesh.region_names):
        chosen = np.flatnonzero(mesh.regions == r)
        numbers[chosen] = first + np.arange(len(chosen))
        yield f"*ELEMENT, TYPE={element}, ELSET={name}"
        for number, cell in zip(numbers[chosen], mesh.cells[chosen]):
            yield from _wrap_numbers([int(number), *(cell + 1)])
        first += len(chosen)
    yield f"*ELEMENT, TYPE=C3D8, ELSET={INDENTER}"
    for number, cell in enumerate(tool.cells + count, first):
        yield from _wrap_numbers([number, *(cell + 1)])
    for name, nodes in {FIXED_SET: problem.fixed, **mesh.node_sets}.items():
        if len(nodes):
            yield f"*NSET, NSET={name}"
            yield from _wrap_numbers(np.asarray(nodes) + 1)
    yield f"*NSET, NSET=handle\n{handle}"
    for name in mesh.region_names:
        yield from _format_material(name, problem.materials[name], program)
    yield f"*MATERIAL, NAME=steel\n*ELASTIC\n2e5, 0.3\n*SOLID SECTION, ELSET={INDENTER}, MATERIAL=steel"
    yield f"*RIGID BODY, ELSET={INDENTER}, REF NODE={handle}"
    yield from _format_surface(PATCH, mesh, np.asarray(problem.contact_faces), numbers)
    whole = Mesh(tool.points, tool.cells, "hex8", np.zeros(len(tool.cells), np.int64), (INDENTER,))
    yield from _format_surface(FRONT, whole, tool.front, first + np.arange(len(tool.cells)))
    yield from _format_contact(problem)
    yield from _format_step(problem, system, handle, settings)


def _format_material(name: str, material: Material, program: str) -> Iterator[str]:
    """Write Ogden with long-term moduli ``c/2``, exponents, ``D``; relaxation over instantaneous moduli."""
    table = material.table()
    prony = [(float(g), float(tau)) for g, tau in table.prony if g != 0.0]
    yield f"*SOLID SECTION, ELSET={name}, MATERIAL={name}_law\n*MATERIAL, NAME={name}_law"
    moduli = ", MODULI=LONG TERM" if prony else ""
    yield f"*HYPERELASTIC, OGDEN, N={len(table.terms)}{moduli}"
    # A second D of 0 is none for Abaqus; CalculiX would take a stiff default of its own.
    none = _NO_COMPRESSIBILITY if program == "calculix" else 0.0
    bulk = [2.0 / table.kappa, *[none] * (len(table.terms) - 1)]
    values = [*(v for c, m in table.terms for v in (c / 2.0, m)), *bulk]
    for i in range(0, len(values), 8):
        yield format_row(values[i : i + 8], ", ")
    if prony:
        yield "*VISCOELASTIC, TIME=PRONY"
        total = 1.0 + sum(g for g, _ in prony)
        yield from (f"{g / total!r}, 0., {tau!r}" for g, tau in prony)


def _format_surface(name: str, mesh: Mesh, faces: Indices, numbers: Indices) -> Iterator[str]:
    """Write a surface as element and side; a face of no element is an error of the mesh."""
    local = _FACES[mesh.cell_type[:3]]
    corners = len(local[0])
    wanted = {tuple(sorted(face[:corners].tolist())) for face in faces}
    yield f"*SURFACE, NAME={name}, TYPE=ELEMENT"
    found = 0
    for number, cell in zip(numbers, mesh.cells):
        for side, at in enumerate(local, 1):
            if tuple(sorted(cell[list(at)].tolist())) in wanted:
                found += 1
                yield f"{number}, S{side}"
    if found != len(wanted):
        raise ProblemError(f"{len(wanted)} faces of {name} are sides of {found} elements")


def _format_contact(problem: Problem) -> Iterator[str]:
    """Write limbfit's own contact stiffness, MPa per mm, as pressure over closure."""
    assert problem.indenter is not None
    moduli = [problem.materials[name].instantaneous_modulus for name in problem.mesh.region_names]
    stiffness = 2000.0 / problem.indenter.width * float(np.mean(moduli))
    yield "*SURFACE INTERACTION, NAME=frictionless"
    yield f"*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR\n{stiffness!r}"
    yield f"*CONTACT PAIR, INTERACTION=frictionless, TYPE=SURFACE TO SURFACE\n{PATCH}, {FRONT}"


def _format_step(problem: Problem, system: System, handle: int, settings: FebSettings) -> Iterator[str]:
    assert system.indenter is not None
    history, axis = problem.history, system.indenter.frame[2]
    end = float(history.times[-1])
    yield "*AMPLITUDE, NAME=advance"
    yield from (f"{float(t)!r}, {float(d)!r}" for t, d in zip(history.times, history.driver))
    yield f"*BOUNDARY\n{FIXED_SET}, 1, 3\nhandle, 4, 6"
    relaxing = any(g for m in problem.materials.values() for g, _ in m.table().prony)
    kind = "*VISCO, CETOL=0.1" if relaxing else "*STATIC"
    yield f"*STEP, NLGEOM, INC=10000\n{kind}"
    first, largest = history.loading_s / 64.0, history.loading_s / 16.0
    yield f"{first!r}, {end!r}, {end * 1e-8!r}, {largest!r}"
    yield "*BOUNDARY, AMPLITUDE=advance"
    yield from (f"handle, {i}, {i}, {float(axis[i - 1])!r}" for i in (1, 2, 3))
    yield "*NODE PRINT, NSET=handle\nU, RF\n*NODE FILE\nU\n*EL FILE\nS\n*END STEP"


def _wrap_numbers(numbers: Iterable[int]) -> Iterator[str]:
    """Write at most 15 numbers in a line; a line that continues ends with a comma."""
    listed = [str(int(number)) for number in numbers]
    rows = [", ".join(listed[i : i + 15]) for i in range(0, len(listed), 15)]
    yield from (f"{row}," for row in rows[:-1])
    yield rows[-1]
