"""A problem written as input of Abaqus or CalculiX (``.inp``), as far as they have limbfit's materials.

Both have Ogden's deviatoric law, and ``(J - 1)^2 / D`` where limbfit's tissue has ``kappa/2 (ln J)^2``: the
same at small changes of volume, with ``D = 2 / kappa``. Abaqus relaxes the stress in the current frame,
limbfit and FEBio in that of rest: the same while the volume hardly changes. CalculiX has no relaxation at
finite strain.

Source: Abaqus Theory Guide, "Hyperelastic material behavior", "Finite-strain viscoelasticity".
"""

from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Indices
from ..errors import ProblemError
from ..fe import Indenter, Material, Problem, System
from ..mesh import Mesh
from .bodies import FIXED_SET, FRONT, INDENTER, PATCH, RigidMesh, build_indenter_mesh
from .penalty import compute_explicit_penalty, find_cells_behind
from .writing import FebSettings, check_simple_indentation, write_template

_ELEMENT = {"tet4": "C3D4", "tet10": "C3D10", "tet10p0": "C3D10H", "tet10g8": "C3D10", "hex8": "C3D8"}
# Faces of Abaqus' elements, S1 to S6, as corners of the element (from 0).
_FACES = {
    "tet": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "hex": ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
_NO_COMPRESSIBILITY = 1e12  # mm^2/N


def write_inp(problem: Problem, path: str | Path, program: str, settings: FebSettings) -> RigidMesh:
    """Write an indentation as ``.inp``; return the indenter's rigid mesh. Raises `ProblemError` if the
    program has no such material, and for what `write_feb` refuses, too, and `RunError` if the file cannot be
    written.
    """
    check_simple_indentation(problem, program.capitalize())
    for name in problem.mesh.region_names:
        _check_material(name, problem.materials[name], program)
    if program == "calculix" and problem.mesh.cell_type == "hex8":
        what = "CalculiX's hexahedra lock in nearly incompressible tissue: twice the force"
        raise ProblemError(what, remedy="give a mesh of quadratic tetrahedra")
    system = System(problem)
    assert system.indenter is not None
    tool = build_indenter_mesh(system.indenter)
    if tool.cell_type != "hex8":
        raise ProblemError(f"indenters of shape {system.indenter.shape!r} are written for FEBio only")
    write_template(path, "model.inp.j2", **_describe_file(problem, system.indenter, tool, program, settings))
    return tool


def _check_material(name: str, material: Material, program: str) -> None:
    table = material.table()
    if table.has_fibres:
        raise ProblemError(f"tissue {name!r} has fibres, which are written for FEBio only")
    if program == "calculix" and any(g != 0.0 for g, _ in table.prony):
        what = f"tissue {name!r} relaxes, which CalculiX cannot do at finite strain"
        raise ProblemError(what, remedy="export with --parameters whose gamma is 0, for FEBio or for Abaqus")
    if program == "calculix" and len(table.terms) > 3:
        raise ProblemError(f"tissue {name!r} has more than the 3 Ogden terms of CalculiX")
    if table.volumetric not in (0, 2):
        raise ProblemError(f"tissue {name!r} has a volumetric law that {program.capitalize()} has not")


def _describe_file(
    problem: Problem, indenter: Indenter, tool: RigidMesh, program: str, settings: FebSettings
) -> dict[str, Any]:
    """Return what the template of a file asks for."""
    mesh, count, history = problem.mesh, len(problem.mesh.points), problem.history
    element = _ELEMENT[problem.formulation.name]
    is_stiffer = program == "calculix" and element == "C3D10H"
    numbers, parts, first = np.zeros(len(mesh.cells), np.int64), [], 1
    for r, name in enumerate(mesh.region_names):
        chosen = np.flatnonzero(mesh.regions == r)
        numbers[chosen] = first + np.arange(len(chosen))
        rows = np.column_stack([numbers[chosen], mesh.cells[chosen] + 1])
        parts.append({"name": name, "element": "C3D10" if is_stiffer else element, "rows": rows})
        first += len(chosen)
    own = first + np.arange(len(tool.cells))
    rows = np.column_stack([own, tool.cells + count + 1])
    parts.append({"name": INDENTER, "element": "C3D8", "rows": rows})
    whole = Mesh(tool.points, tool.cells, "hex8", np.zeros(len(tool.cells), np.int64), (INDENTER,))
    laws = [problem.materials[name] for name in mesh.region_names]
    seconds = [phase.duration_s for phase in history.phases]
    shortest = min(seconds) / (16.0 if program == "calculix" else 64.0)
    return {
        "title": " ".join(settings.title.split()),
        "program": program,
        "is_stiffer": is_stiffer,
        # The other kind of CalculiX does not converge under a block's first contact.
        "contact": "NODE TO SURFACE" if program == "calculix" else "SURFACE TO SURFACE",
        "points": np.vstack([mesh.points, tool.points, np.asarray(indenter.centre)]),
        "parts": parts,
        "node_sets": {
            name: np.asarray(own) for name, own in {FIXED_SET: problem.fixed, **mesh.node_sets}.items()
        },
        "handle": count + len(tool.points) + 1,
        "materials": [
            _describe_material(name, problem.materials[name], program) for name in mesh.region_names
        ],
        "tool": INDENTER,
        "surfaces": {
            PATCH: _find_sides(mesh, np.asarray(problem.contact_faces), numbers),
            FRONT: _find_sides(whole, tool.front, own),
        },
        "stiffness": compute_explicit_penalty(problem, settings.steps),
        "advance": np.column_stack([history.times, history.driver]),
        "fixed_set": FIXED_SET,
        "is_relaxing": any(g for law in laws for g, _ in law.table().prony),
        # One for each phase, whose end is met: first increment, whole, smallest and largest one, s.
        "steps": [(shortest, t, t * 1e-8, t / 16.0) for t in seconds],
        "axis": indenter.frame[2].tolist(),
    }


def _describe_material(name: str, material: Material, program: str) -> dict[str, Any]:
    """Return Ogden's long-term moduli ``c/2``, exponents and ``D``; relaxation over instantaneous moduli."""
    table = material.table()
    prony = [(float(g), float(tau)) for g, tau in table.prony if g != 0.0]
    # A second D of 0 is none for Abaqus; CalculiX would take a stiff default of its own.
    none = _NO_COMPRESSIBILITY if program == "calculix" else 0.0
    bulk = [2.0 / table.kappa, *[none] * (len(table.terms) - 1)]
    total = 1.0 + sum(g for g, _ in prony)
    return {
        "name": name,
        "terms": len(table.terms),
        "constants": [*(v for c, m in table.terms for v in (c / 2.0, m)), *bulk],
        "prony": [(g / total, tau) for g, tau in prony],
    }


def _find_sides(mesh: Mesh, faces: Indices, numbers: Indices) -> list[tuple[int, int]]:
    """Find a surface as number of the element and its side, from 1."""
    sides = [set(corners) for corners in _FACES[mesh.cell_type[:3]]]
    found = []
    for face, cell in zip(faces[:, : mesh.kind.face_corners], find_cells_behind(mesh, faces).tolist()):
        at = set(np.flatnonzero(np.isin(mesh.cells[cell], face)).tolist())
        found.append((cell, sides.index(at) + 1))
    return [(int(numbers[cell]), side) for cell, side in sorted(found)]
