"""Parity with FEBio 4.11 on its own meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from feb_reader import Feb, read_feb, read_log

from limbfit.fe import History, Indenter, Problem, StepControl, Support, System, iterate, solve
from limbfit.fe.laws import Laws
from limbfit.fe.observables import element_fields
from limbfit.mesh import Mesh

REFERENCE = Path(__file__).parents[2] / ".." / "shared" / "reference"
pytestmark = pytest.mark.skipif(
    not REFERENCE.is_dir(), reason="the FEBio reference results are not beside the repository"
)


def body(feb: Feb) -> tuple[Mesh, np.ndarray]:
    """The deformable parts as a mesh with regions skin and muscle, and the new number of each node."""
    parts = [e for name, e in feb.elements.items() if name.startswith("part")]
    cells = np.vstack([cells for _, cells, _ in parts])
    regions = np.concatenate([np.full(len(cells), i) for i, (_, cells, _) in enumerate(parts)])
    used = np.unique(cells)
    number = np.full(len(feb.points), -1)
    number[used] = np.arange(len(used))
    names = ("skin", "muscle")[: len(parts)]
    return Mesh(feb.points[used], number[cells], parts[0][0], regions, names), number


def materials(feb: Feb) -> dict:
    return dict(zip(("skin", "muscle"), (feb.materials[name] for name in sorted(feb.materials))))


@pytest.mark.parametrize("tissue", ["skin", "muscle", "bosboom", "lim", "lim_par"])
def test_cube(tissue):
    feb = read_feb(REFERENCE / "cube" / f"cube_{tissue}.feb")
    times, rows = read_log(REFERENCE / "cube" / f"cube_{tissue}.txt")
    mesh, _ = body(feb)
    sides = tuple(Support(feb.node_sets[name], i) for i, name in enumerate(("x0", "y0", "z0")))
    top = Support(feb.node_sets["top"], 2, -1.0)
    history = History(*feb.load.T)
    none = np.zeros(0, dtype=int)
    problem = Problem(
        mesh, materials(feb), none, np.zeros((0, 4), int), None, history, supports=(*sides, top)
    )
    system, laws = System(problem), Laws.build([problem.materials["skin"]])
    control = StepControl(times=tuple(times[1:]), tolerance=1e-9)
    found = [element_fields(system, laws, step.state) for step in iterate(problem, control)]
    stress, J = np.array([f.cauchy[0, 2] for f in found]), np.array([f.J[0] for f in found])
    assert np.abs(stress - rows[1:, 2]).max() < 1e-6 * np.abs(rows[:, 2]).max()
    np.testing.assert_allclose(J, rows[1:, 3], rtol=1e-6)


def residuum(kind: str, **changes) -> tuple[Problem, np.ndarray, np.ndarray]:
    """The posterior site, FEBio's times and its forces along the axis."""
    feb = read_feb(REFERENCE / "residuum" / f"posterior_{kind}.feb")
    times, rows = read_log(REFERENCE / "residuum" / f"posterior_{kind}.txt")
    mesh, number = body(feb)
    path = rows[:, 3:] - rows[0, 3:]
    axis = path[np.linalg.norm(path, axis=1).argmax()]
    axis /= np.linalg.norm(axis)
    punch = feb.points[np.unique(feb.elements["punch"][1])]
    tip = rows[0, 3:] + axis * ((punch - rows[0, 3:]) @ axis).max()
    indenter = Indenter("square", 20.0, 2.0, tip, axis)
    fixed, faces = number[feb.node_sets["fixed"]], number[feb.surfaces["skin"]]
    problem = Problem(
        mesh, materials(feb), fixed, faces, indenter, History(*feb.load.T), start="as-given", **changes
    )
    return problem, times, np.abs(rows[:, :3] @ axis)


def block(kind: str, **changes) -> tuple[Problem, np.ndarray, np.ndarray]:
    feb = read_feb(REFERENCE / "block" / f"block_{kind}.feb")
    times, rows = read_log(REFERENCE / "block" / f"block_{kind}.txt")
    mesh, number = body(feb)
    sides = tuple(Support(number[feb.node_sets[name]], i) for i, name in enumerate(("x0", "y0")))
    start = feb.points[np.unique(feb.elements["box"][1])][:, 2].min()
    indenter = Indenter("square", 20.0, 2.0, (0.0, 0.0, start), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))
    fixed, faces = number[feb.node_sets["bottom"]], number[feb.surfaces["skin"]]
    problem = Problem(
        mesh,
        materials(feb),
        fixed,
        faces,
        indenter,
        History(*feb.load.T),
        supports=sides,
        start="as-given",
        **changes,
    )
    return problem, times, np.abs(rows[:, 0])


def difference(problem: Problem, times: np.ndarray, force: np.ndarray, **control) -> float:
    """Largest difference from FEBio over the whole curve, in percent of its peak."""
    result = solve(problem, StepControl(times=tuple(times[1:]), **control))
    assert result.completed, result.reason
    return 100 * np.abs(result.force - force).max() / force.max()


# FEBio's penalty is three times 3 mu A/V of each element: softer than ours, and softer for hexahedra than
# for the smaller tetrahedra.  ``penalty`` (1/mm) matches it; without that our curves are stiffer.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "kind", "rule", "penalty", "percent"),
    [
        (residuum, "tet10", "nodes", None, 1.0),
        (residuum, "tet4", "gauss", 10.0, 2.5),
        (block, "hex8", "gauss", 10.0, 0.5),
        (block, "tet4", "gauss", 30.0, 1.0),
        (block, "tet4", "nodes", None, 1.0),
    ],
)
def test_indentation(case, kind, rule, penalty, percent):
    problem, times, force = case(kind, contact_rule=rule)
    deep = 0.01 if penalty is None else 1.0
    assert difference(problem, times, force, penalty=penalty, penetration=deep) < percent
