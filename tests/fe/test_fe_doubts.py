"""What a simulation doubts about itself: counted, told, and by kind."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import punch

from limbfit import OgdenQLV
from limbfit.bench.timing import build_punched_block
from limbfit.fe import History, Problem, Result, StepControl, solve
from limbfit.fe.observables import compute_contact_pressure
from limbfit.fe.result import find_inverted_elements
from limbfit.fe.system import Increment
from limbfit.mesh import node_jacobians

STEPS = StepControl(load_steps=5, unload_steps=3)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return punch("hex8", 2, 1)


@pytest.fixture(scope="module")
def stiffening(problem: Problem) -> Problem:
    """Tissue that stiffens so much that the first penalty lets the indenter sink in too far."""
    return problem.with_materials({name: replace(law, m=18.0) for name, law in problem.materials.items()})


def kinds(result: Result) -> list[str]:
    return [doubt.kind for doubt in result.doubts]


def reactions(result: Result) -> np.ndarray:
    """Force along the axis (n,) of the states' own penalties, N."""
    laws, nothing, found = result.problem.build_laws(), np.zeros(0), []
    for state in result.states:
        penalty = state.penalty * laws.modulus
        increment = Increment(state.time, state.displacement, nothing, nothing, penalty, state.drives)
        found.append(result.system.contact_force(state.u, increment).sum(axis=0)[2])
    return np.array(found)


@pytest.mark.parametrize(
    "history",
    [
        History(np.array([0.0, 0.3, 8.3]), np.array([0.0, 3.0, 4.0])),
        History(np.array([0.0, 0.2, 2.2]), force=np.array([0.0, 2.0, 1.5])),
    ],
)
def test_what_a_quick_ramp_left_relaxes_while_the_indenter_goes_on_slowly_and_no_tissue_slips(history):
    """A slower second ramp, and a force that is let off while the tissue still creeps."""
    law = OgdenQLV(0.005, 4.0, 9.0, 3.0)
    block = replace(build_punched_block("hex8", 4), history=history, materials={"skin": law, "muscle": law})
    times = (0.5, 1.0, 2.2) if history.forced else (1.3, 3.3, 8.3)
    found = solve(block, StepControl(times=(history.times[1], *times)), store="none")
    assert found.completed
    assert (np.diff(found.displacement) > 0.01 * found.displacement.max()).all()
    assert (found.force[2:] < 0.9 * found.force[1:-1]).any()
    assert not kinds(found)


def test_a_state_s_penalty_is_the_one_that_holds_it(problem):
    """Also where raising it did not help enough: reactions and pressure were three times the force's."""
    result = solve(problem, StepControl(penetration=1e-6, load_steps=1, unload_steps=1), store="all")
    np.testing.assert_allclose(reactions(result), result.force[1:], rtol=1e-3, atol=1e-6)
    laws = problem.build_laws()
    deepest = max(result.states, key=lambda state: state.displacement)
    usual = solve(problem, StepControl(load_steps=1, unload_steps=1))
    pressures = [
        compute_contact_pressure(r.system, laws, s) for r, s in ((result, deepest), (usual, usual.states[0]))
    ]
    assert pressures[0].max() == pytest.approx(pressures[1].max(), rel=0.1)


def test_penetration_left_after_the_last_raise_is_counted_and_told(problem):
    result = solve(problem, replace(STEPS, penetration=1e-6))
    beyond = result.penetration > 6e-6
    assert result.statistics["sunk_steps"] == beyond.sum() > 0
    (doubt,) = result.doubts
    assert (doubt.kind, doubt.count) == ("sunk", beyond.sum())
    assert doubt.depth_mm == pytest.approx(result.displacement[beyond][0])
    assert doubt.share == pytest.approx(doubt.depth_mm / 6.0)
    assert result.warnings == (doubt.text,)


def test_a_held_penalty_is_not_raised_and_what_sinks_in_is_told(stiffening):
    free = solve(stiffening, STEPS)
    assert free.statistics["penalty_per_mm"] > 100.0
    assert not free.doubts
    assert free.statistics["sunk_steps"] == free.statistics["unbalanced_steps"] == 0
    held = solve(stiffening, replace(STEPS, hold_penalty=True))
    assert held.statistics["penalty_per_mm"] == 100.0
    assert held.penetration.max() > 0.06
    assert kinds(held) == ["sunk"]
    stated = float(held.warnings[0].split("such as ")[1])
    remedied = solve(stiffening, replace(STEPS, penalty=stated, hold_penalty=True))
    assert not remedied.doubts


def test_an_equilibrium_beyond_the_tolerance_is_counted_and_told(problem):
    """Digits that the energy does not have: the search ends at a residual above what was asked for."""
    tolerance = 1e-14
    result = solve(problem, replace(STEPS, tolerance=tolerance))
    assert result.completed, result.reason
    count = result.statistics["unbalanced_steps"]
    assert count > 0
    (doubt,) = result.doubts
    assert (doubt.kind, doubt.count) == ("unbalanced", count)
    assert f"not to {tolerance:.2g}" in doubt.text
    assert 0.0 < doubt.depth_mm <= 6.0


def test_folded_elements_are_told_whatever_states_are_kept(problem):
    """On this block the skin folds under the punch when it is soft and the muscle is stiff."""
    skin, muscle = problem.materials["skin"], problem.materials["muscle"]
    soft = problem.with_materials({"skin": replace(skin, c=2e-4), "muscle": replace(muscle, c=0.02)})
    soft = replace(soft, history=History(np.array([0.0, 6.0]), np.array([0.0, 6.0])))
    kept, dropped = solve(soft), solve(soft, store="none")
    assert "folded" in kinds(kept)
    assert dropped.doubts == kept.doubts


@pytest.mark.parametrize(("share", "told"), [(0.005, False), (0.02, True)])
def test_folded_elements_are_told_where_they_matter(share, told):
    mesh = punch("tet10", 2, 1).mesh
    u = np.zeros_like(mesh.points)
    u[mesh.corners[0][0], 2] = -40.0
    inverted = (node_jacobians(mesh.with_points(mesh.points + u)) <= 0.0).any(axis=1)
    energy = np.where(inverted, share / inverted.sum(), (1.0 - share) / (~inverted).sum())
    doubts = find_inverted_elements(mesh, u, lambda: energy, 3.0, np.array([0.0, 3.0]))
    assert ["2 % of the strain energy" in doubt.text for doubt in doubts] == [True] * told
