"""Tissues in FEBio's words: Ogden terms, fibres beside, relaxation around, contraction and pre-strain.

A contraction stands beside what relaxes, for an active stress is what is stated; a pre-strain stands around
all of it, and FEBio's pressure does not see it.

Source: FEBio User Manual 4.0, chapter 4; ``FEActiveFiberStressUC`` and ``FEPreStrainUncoupledElastic``.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Material, Problem
from ..fe.materials import LawTable
from .moving import row

Array = NDArray[np.float64]

PRESSURE_MODELS = {0: "default", 1: "NIKE3D", 2: "Abaqus"}
MOST_TERMS = 6  # of Ogden and of Prony in FEBio
MIXTURE, RELAXING, PRESTRAINED = (
    "uncoupled solid mixture", "uncoupled viscoelastic", "uncoupled prestrain elastic",
)  # fmt: skip
FIBRE, ACTIVE = "fiber-exp-pow-uncoupled", "uncoupled active fiber stress"
GRADIENT = "prestrain gradient"


def material_lines(
    number: int, name: str, material: Material, axis: str = "", course: int = 0, prestrain: str = ""
) -> Iterator[str]:
    """A tissue with its axis of fibres.

    Parameters
    ----------
    course : the load curve of its contraction.
    prestrain : its pre-strain (see `prestrain_of`).

    Raises
    ------
    ProblemError
        For more terms than FEBio takes.
    """
    table = material.table()
    prony = [(float(g), float(tau)) for g, tau in table.prony if g != 0.0]
    if max(len(prony), len(table.terms)) > MOST_TERMS:
        raise ProblemError(f"tissue {name!r} has more than {MOST_TERMS} terms, which FEBio does not take")
    solids = _passive(table)
    if prony:
        kind, content = _kind_of(solids)
        solids = [(RELAXING, f'{_relaxation(prony)}<elastic type="{kind}"><k>0</k>{content}</elastic>')]
    if table.active > 0.0:
        active = f'<smax>{float(table.active)!r}</smax><activation lc="{course}">1</activation>'
        solids.append((ACTIVE, active))
    kind, content = _kind_of(solids)
    if prestrain:
        kind, content = PRESTRAINED, f'<elastic type="{kind}">{content}</elastic>{prestrain}'
    shared = (
        f"<k>{float(table.kappa)!r}</k><pressure_model>{PRESSURE_MODELS[table.volumetric]}</pressure_model>"
    )
    head = f'<material id="{number}" name={quoteattr(name)} type="{kind}">'
    yield f"{head}{axis}{shared}{content}</material>"


def _passive(table: LawTable) -> list[tuple[str, str]]:
    """What the tissue bears at rest: kinds and contents."""
    terms = "".join(
        f"<c{i}>{float(c)!r}</c{i}><m{i}>{float(m)!r}</m{i}>" for i, (c, m) in enumerate(table.terms, 1)
    )
    solids = [("Ogden", terms)]
    if table.fibre[0] > 0.0:
        k1, k2 = map(float, table.fibre)
        solids.append((FIBRE, f"<ksi>{k1!r}</ksi><alpha>{k2!r}</alpha><beta>2</beta>"))
    return solids


def _kind_of(solids: list[tuple[str, str]]) -> tuple[str, str]:
    """Kind and content of one solid, or of a mixture of several."""
    if len(solids) == 1:
        return solids[0]
    return MIXTURE, "".join(f'<solid type="{kind}">{content}</solid>' for kind, content in solids)


def _relaxation(prony: list[tuple[float, float]]) -> str:
    terms = (f"<g{i}>{g!r}</g{i}><t{i}>{tau!r}</t{i}>" for i, (g, tau) in enumerate(prony, 1))
    return f"<g0>1</g0>{''.join(terms)}"


def prestrains(problem: Problem) -> dict[str, Array]:
    """The pre-stretches of each region that has some: (1, 3, 3), or one for each of its cells.

    Raises
    ------
    ProblemError
        Where one changes the volume: FEBio's pressure would not see it.
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


def prestrain_of(name: str, own: Array | None, ramp: int) -> str:
    """The pre-strain of a tissue, which grows with the load curve ``ramp``."""
    if own is None:
        return ""
    value = f"<F0>{row(own[0].ravel())}</F0>" if len(own) == 1 else f'<F0 type="map">{map_of(name)}</F0>'
    return f'<prestrain type="{GRADIENT}"><ramp lc="{ramp}">1</ramp>{value}</prestrain>'


def map_of(name: str) -> str:
    """The name of a tissue's map of pre-strains."""
    return f"prestrain_of_{''.join(c if c.isalnum() else '_' for c in name)}"


def prestrains_of_cells(found: dict[str, Array]) -> Iterator[str]:
    """The pre-strains that differ from cell to cell."""
    for name, own in found.items():
        if len(own) > 1:
            yield f'<ElementData name="{map_of(name)}" data_type="mat3" elem_set={quoteattr(name)}>'
            yield from (f'<elem lid="{i}">{row(G.ravel())}</elem>' for i, G in enumerate(own, 1))
            yield "</ElementData>"
