"""Tissues written for FEBio: Ogden terms, fibres and their directions, relaxation, contraction, pre-strain.

A contraction stands beside what relaxes, because an active stress is given as it is. A pre-strain stands
around all of it, and FEBio's pressure does not see it. A material has one axis of fibres if all its cells
have the same direction, else each cell has its own.

Source: FEBio User Manual 4.0, chapter 4, and the section on ``MeshData``; ``FEActiveFiberStressUC`` and
``FEPreStrainUncoupledElastic``.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

import numpy as np

from ..arrays import Array
from ..errors import ProblemError
from ..fe import Material, Problem
from ..fe.materials import LawTable
from .conditions import format_row

PRESSURE_MODELS = {0: "default", 1: "NIKE3D", 2: "Abaqus"}
MAX_TERMS = 6  # of Ogden and of Prony in FEBio
MIXTURE, RELAXING, PRESTRAINED = (
    "uncoupled solid mixture", "uncoupled viscoelastic", "uncoupled prestrain elastic",
)  # fmt: skip
FIBRE, ACTIVE = "fiber-exp-pow-uncoupled", "uncoupled active fiber stress"
GRADIENT = "prestrain gradient"


def format_material(
    number: int, name: str, material: Material, axis: str = "", course: int = 0, prestrain: str = ""
) -> Iterator[str]:
    """Write a tissue with its axis of fibres.

    Parameters
    ----------
    course : number of the load curve of its contraction.
    prestrain : its pre-strain (see `format_prestrain`).

    Raises
    ------
    ProblemError
        For more terms than FEBio takes.
    """
    table = material.table()
    prony = [(float(g), float(tau)) for g, tau in table.prony if g != 0.0]
    if max(len(prony), len(table.terms)) > MAX_TERMS:
        raise ProblemError(f"tissue {name!r} has more than {MAX_TERMS} terms, which FEBio does not take")
    solids = _format_passive(table)
    if prony:
        kind, content = _combine_solids(solids)
        solids = [
            (RELAXING, f'{_format_relaxation(prony)}<elastic type="{kind}"><k>0</k>{content}</elastic>')
        ]
    if table.active > 0.0:
        active = f'<smax>{float(table.active)!r}</smax><activation lc="{course}">1</activation>'
        solids.append((ACTIVE, active))
    kind, content = _combine_solids(solids)
    if prestrain:
        kind, content = PRESTRAINED, f'<elastic type="{kind}">{content}</elastic>{prestrain}'
    shared = (
        f"<k>{float(table.kappa)!r}</k><pressure_model>{PRESSURE_MODELS[table.volumetric]}</pressure_model>"
    )
    head = f'<material id="{number}" name={quoteattr(name)} type="{kind}">'
    yield f"{head}{axis}{shared}{content}</material>"


def _format_passive(table: LawTable) -> list[tuple[str, str]]:
    """Return kinds and contents of what the tissue bears at rest."""
    terms = "".join(
        f"<c{i}>{float(c)!r}</c{i}><m{i}>{float(m)!r}</m{i}>" for i, (c, m) in enumerate(table.terms, 1)
    )
    solids = [("Ogden", terms)]
    if table.fibre[0] > 0.0:
        k1, k2 = map(float, table.fibre)
        solids.append((FIBRE, f"<ksi>{k1!r}</ksi><alpha>{k2!r}</alpha><beta>2</beta>"))
    return solids


def _combine_solids(solids: list[tuple[str, str]]) -> tuple[str, str]:
    """Return kind and content of one solid, or of a mixture of several."""
    if len(solids) == 1:
        return solids[0]
    return MIXTURE, "".join(f'<solid type="{kind}">{content}</solid>' for kind, content in solids)


def _format_relaxation(prony: list[tuple[float, float]]) -> str:
    terms = (f"<g{i}>{g!r}</g{i}><t{i}>{tau!r}</t{i}>" for i, (g, tau) in enumerate(prony, 1))
    return f"<g0>1</g0>{''.join(terms)}"


def find_prestrains(problem: Problem) -> dict[str, Array]:
    """Return the pre-stretches of each region that has some: (1, 3, 3), or one for each of its cells.

    Raises
    ------
    ProblemError
        If one changes the volume, which FEBio's pressure would not see.
    """
    if problem.prestretch is None:
        return {}
    mesh, found = problem.mesh, {}
    given = np.broadcast_to(np.asarray(problem.prestretch, dtype=float), (len(mesh.cells), 3, 3))
    for r, name in enumerate(mesh.region_names):
        own = given[mesh.regions == r]
        if np.abs(np.linalg.det(own) - 1.0).max(initial=0.0) > 1e-9:
            raise ProblemError(
                f"the pre-stretch of tissue {name!r} changes its volume, which FEBio's pressure does not see",
                remedy="give one of constant volume (limbfit.fe.isochoric_stretch)",
            )
        if np.abs(own - np.eye(3)).max(initial=0.0) > 0.0:
            found[name] = own[:1] if (own == own[0]).all() else own
    return found


def format_prestrain(name: str, gradients: Array | None, ramp: int) -> str:
    """Write the pre-strain of a tissue, which grows with the load curve ``ramp``."""
    if gradients is None:
        return ""
    value = (
        f"<F0>{format_row(gradients[0].ravel())}</F0>"
        if len(gradients) == 1
        else f'<F0 type="map">{name_prestrain_map(name)}</F0>'
    )
    return f'<prestrain type="{GRADIENT}"><ramp lc="{ramp}">1</ramp>{value}</prestrain>'


def name_prestrain_map(name: str) -> str:
    """Return the name of a tissue's map of pre-strains."""
    return f"prestrain_of_{''.join(c if c.isalnum() else '_' for c in name)}"


def format_cell_prestrains(prestrains: dict[str, Array]) -> Iterator[str]:
    """Write the pre-strains that differ from cell to cell."""
    for name, gradients in prestrains.items():
        if len(gradients) > 1:
            map_name = name_prestrain_map(name)
            yield f'<ElementData name="{map_name}" data_type="mat3" elem_set={quoteattr(name)}>'
            yield from (f'<elem lid="{i}">{format_row(G.ravel())}</elem>' for i, G in enumerate(gradients, 1))
            yield "</ElementData>"


def find_fibre_directions(problem: Problem) -> dict[str, Array]:
    """Return the fibre directions of each region that has some: (1, 3), or one for each of its cells."""
    mesh, found = problem.mesh, {}
    for r, name in enumerate(mesh.region_names):
        if problem.materials[name].table().has_fibres and problem.fibres is not None:
            given = np.broadcast_to(np.asarray(problem.fibres, dtype=float), (len(mesh.cells), 3))
            own = given[mesh.regions == r]
            found[name] = own[:1] if (own == own[0]).all() else own
    return found


def format_axis(directions: Array | None) -> str:
    """Write the axis of a material whose cells have one direction."""
    return (
        ""
        if directions is None or len(directions) != 1
        else f'<mat_axis type="vector">{_format_axes(directions[0])}</mat_axis>'
    )


def format_cell_axes(problem: Problem) -> Iterator[str]:
    """Write the axes that differ from cell to cell."""
    for name, directions in find_fibre_directions(problem).items():
        if len(directions) == 1:
            continue
        yield f'<ElementData type="mat_axis" elem_set={quoteattr(name)}>'
        for i, direction in enumerate(directions, 1):
            yield f'<elem lid="{i}">{_format_axes(direction)}</elem>'
        yield "</ElementData>"


def _format_axes(direction: Array) -> str:
    """Write the first axis, and a vector that spans a plane with it."""
    other = np.eye(3)[np.argmin(np.abs(direction))]
    return f"<a>{format_row(direction)}</a><d>{format_row(other)}</d>"
