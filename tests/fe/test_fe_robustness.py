"""Hard indentations, results of what cannot be solved, and the benchmark that counts them."""

import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blocks import FINE_Z, SKIN, block, punch

from limbfit.errors import ProblemError
from limbfit.fe import History, OgdenQLV, Problem, Result, StepControl, Support, solve
from limbfit.fe.result import find_slip
from limbfit.fe.solution.control import StepController
from limbfit.mesh import Mesh
from limbfit.study import MaterialTable

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SOFT, STIFF = OgdenQLV(47e-6, 2.0, 0.01, 10.0), OgdenQLV(0.047, 20.0, 10.0, 0.01)


@pytest.fixture(scope="module")
def robustness():
    """The benchmark as a module, on the path for the worker processes that it starts."""
    sys.path.insert(0, str(BENCHMARKS))
    yield importlib.import_module("robustness")
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def cases(robustness):
    """What the benchmark draws its cases with."""
    return importlib.import_module("robustness_cases")


@pytest.fixture(scope="module")
def result() -> Result:
    return solve(punch("tet10", 2, 1, depth=3.0, z=FINE_Z), store="all")


def test_a_linear_solver_of_no_such_name_is_refused():
    with pytest.raises(ProblemError, match="unknown linear solver 'mumps'"):
        solve(punch("hex8", 2), StepControl(linear_solver="mumps"))


def test_cases_follow_from_seed_and_number_alone(cases):
    assert cases.draw(0, 17) == cases.draw(0, 17)
    assert cases.draw(0, 17) != cases.draw(1, 17)
    assert cases.problem_of(cases.draw(0, 4), 0).history.displacement.max() > 0


def test_cases_span_the_bounds_of_the_calibration(cases):
    bounds = MaterialTable()
    drawn = [cases.draw(0, number) for number in range(400)]
    for name in bounds.keys:
        low, high = bounds.lower[name], bounds.upper[name]
        share = [np.log(case.parameters["skin"][name] / low) / np.log(high / low) for case in drawn]
        assert -1e-9 < min(share) < 0.03
        assert 0.97 < max(share) < 1 + 1e-9
    assert {case.site for case in drawn} == set(cases.SITES)
    assert {case.tool for case in drawn} == set(cases.TOOLS)
    assert max(case.depth_share for case in drawn) <= 0.6


@pytest.mark.parametrize("site", ["slab-mid", "ridge-edge", "limb-thin", "twin-between"])
def test_travel_ends_at_the_bone(cases, site):
    """Driven by the whole of the drawn way the indenter just touches a bone node."""
    number = cases.SITES.index(site)
    case = replace(cases.draw(0, number), depth_share=1.0, tool="sphere")
    body, problem = cases.body_of(case), cases.problem_of(case, 0)
    skin = np.unique(body.mesh.face_sets["skin"])
    depth = float(problem.history.displacement.max())
    bottom = problem.indenter.move(cases.advance(problem.indenter, body.mesh.points[skin]) + depth)
    gap = bottom.signed_distance(body.mesh.points[body.bone]).min()
    assert gap >= -1e-4
    assert gap < 1e-4 or depth == pytest.approx(cases.FARTHEST_MM)


@pytest.mark.parametrize(
    ("skin", "muscle", "depth"), [pytest.param(SOFT, STIFF, 1.5, marks=pytest.mark.slow), (STIFF, SOFT, 4.0)]
)
def test_opposite_corners_of_the_bounds(skin, muscle, depth):
    """A thousandfold contrast of the moduli; soft skin gives way by half of its thickness.

    Plain tet10 folds here, and which of several equilibria it takes hangs on the last digits.
    """
    result = solve(
        punch("tet10", 2, 1, depth, materials={"skin": skin, "muscle": muscle}, element="tet10v"),
        StepControl(load_steps=4, unload_steps=2),
    )
    assert result.completed, result.reason
    assert not result.doubts
    assert result.penetration.max() <= 0.01 * depth
    assert (result.force >= 0).all()
    assert result.force[-1] < 1e-3 * result.peak_force


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 4])
def test_drawn_cases_complete_and_keep_to_the_laws(robustness, number):
    outcome = robustness.run_case(0, number)
    assert (outcome.outcome, outcome.broken) == ("completed", []), outcome.reason


@pytest.mark.slow
def test_folds_of_a_soft_skin_on_a_stiff_muscle_are_gone_through(robustness):
    """Directions that only a small part of can be used: undamped it was not done after 120 s."""
    outcome = robustness.run_case(0, 6)
    assert outcome.outcome == "completed", outcome.reason


@pytest.mark.slow
def test_a_soft_skin_does_not_slip_past_a_penalty_that_is_too_small(cases):
    """The penalty is raised as soon as it is seen to be too small: 103 iterations, where it was not."""
    problem = cases.problem_of(cases.draw(0, 32), 0)
    depth, peak = problem.history.displacement.max(), problem.history.times[1]
    times = tuple(peak * np.arange(1, 5) / 10)
    result = solve(problem, StepControl(times=times))
    assert result.displacement[-1] == pytest.approx(0.4 * depth)
    assert result.peak_force == pytest.approx(21.1, rel=0.01)
    assert result.statistics["newton_iterations"] < 60
    assert "slipped" not in {doubt.kind for doubt in result.doubts}


def paced(hard: Callable[[float, float], int]) -> list[tuple[float, int, str]]:
    """Times tried on the way to 0.5 and 1 s, the patience and what came of it, where iterations are made up.

    ``hard``: how many iterations a step from one time to another takes.
    """
    pace, now, tried = StepController(60), 0.0, []
    while now < 1.0 and pace.cuts <= 5:
        t = pace.next_time(now, 0.5 if now < 0.5 else 1.0)
        needed, patience = hard(now, t), pace.patience
        tried.append((t, patience, "cut" if needed > patience else "done"))
        if needed > patience:
            pace.cut(now, t)
        else:
            pace.accept(now, t, needed)
            now = t
    return tried


def test_short_steps_where_long_ones_fail_and_long_ones_again_after():
    tried = paced(lambda now, t: 99 if t - now > 0.1 and now < 0.4 else 8)
    assert [what for *_, what in tried[:3]] == ["cut", "cut", "done"]
    ends = [t for t, _, what in tried if what == "done"]
    assert ends[0] == pytest.approx(0.045)
    assert np.diff(ends).min() > 0.04
    assert np.diff(ends)[-1] > 0.15
    assert {0.5, 1.0} <= set(ends)


def test_an_equilibrium_that_ends_is_left_with_patience():
    """Every step across 0.7 s takes 200 iterations, however short it is."""
    tried = paced(lambda now, t: 200 if now < 0.7 <= t else 8)
    cuts = [(t, patience) for t, patience, what in tried if what == "cut"]
    assert [patience for _, patience in cuts] == [60, 60]
    across = next((t, patience) for t, patience, what in tried if what == "done" and t >= 0.7)
    assert across[1] == 300
    assert tried[-1][0] == 1.0


def test_a_step_that_never_converges_is_given_up():
    tried = paced(lambda *_: 10**6)
    assert [what for *_, what in tried] == ["cut"] * 6
    assert tried[-1][0] == pytest.approx(0.5 * 0.3**5)


def test_a_force_that_falls_while_the_indenter_advances_is_told():
    """A fifth of it lost between two steps of loading; less than a tenth, and what relaxes, are none."""
    times, displacement = np.arange(5.0), np.array([1.0, 2.0, 3.0, 3.0, 2.0])
    force = np.array([2.0, 5.0, 4.0, 2.0, 0.5])
    (doubt,) = find_slip(times, displacement, force)
    assert doubt.text.startswith("the force falls from 5 N to 4 N while the indenter advances from 2 to 3 mm")
    assert (doubt.kind, doubt.count, doubt.depth_mm) == ("slipped", 1, 2.0)
    assert doubt.share == pytest.approx(2 / 3)
    assert not find_slip(times, displacement, np.where(force == 4.0, 4.8, force))
    assert not find_slip(np.zeros(1), np.zeros(1), np.zeros(1))


def test_what_is_not_reached_is_said(robustness):
    """One iteration and no cut: rest alone is a result, with its reason and no peak."""
    result = solve(punch("tet10", 2, 1), StepControl(max_iterations=1, max_cuts=0), store="all")
    assert not result.completed
    assert result.reason.startswith("stopped at 0 s of 12.5 s: ")
    assert len(result.times) == 1 + len(result.states) < 3
    assert np.isfinite(result.force_at(np.linspace(0.0, 12.5, 5))).all()


def test_iterations_in_all_are_bounded_though_every_step_converges():
    result = solve(punch("tet10", 2, 1), StepControl(most_iterations=10), store="all")
    assert not result.completed
    assert result.reason.endswith("s of 12.5 s: no more than 10 Newton iterations were allowed")
    assert len(result.times) > 1
    assert 10 <= result.statistics["newton_iterations"] < 10 + StepControl().max_iterations


@pytest.mark.parametrize(("element", "folded"), [("tet10", True), ("tet10v", False)])
def test_elements_that_fold_in_their_corners_are_told(element, folded):
    """One node of a cube's top pushed in by 6 of 10 mm: points inside the elements do not see them fold."""
    lines = np.linspace(0.0, 10.0, 5)
    mesh = block("tet10", lines, lines, lines, layer=4.0)
    middle = np.flatnonzero(np.linalg.norm(mesh.points - [5.0, 5.0, 10.0], axis=1) < 1e-9)
    problem = Problem(
        mesh, {"skin": SKIN, "muscle": SKIN}, mesh.node_sets["bottom"], mesh.face_sets["top"], None,
        History(np.array([0.0, 1.0]), np.array([0.0, 6.0])), (Support(middle, 2, -1.0),), element,
    )  # fmt: skip
    result = solve(problem)
    assert result.completed, result.reason
    assert [doubt.kind for doubt in result.doubts] == ["folded"] * folded


def changed(result: Result, **arrays: Callable) -> Result:
    return replace(result, **{name: change(getattr(result, name)) for name, change in arrays.items()})


def moved(result: Result, where: tuple[float, float, float], by: tuple[float, float, float]) -> Result:
    """The result with the node nearest to ``where`` displaced further in all states."""
    mesh = result.problem.mesh
    corners = np.unique(mesh.corners)
    node = corners[np.linalg.norm(mesh.points[corners] - where, axis=1).argmin()]
    push = np.zeros_like(mesh.points)
    push[node] = by
    return replace(result, states=tuple(replace(s, u=s.u + push) for s in result.states))


@pytest.mark.parametrize(
    ("tamper", "law"),
    [
        (lambda r: changed(r, force=lambda f: np.where(np.arange(len(f)) == 3, np.nan, f)), "not finite"),
        (lambda r: changed(r, force=lambda f: np.where(np.arange(len(f)) == 3, -0.1, f)), "negative"),
        (lambda r: changed(r, force=lambda f: f + 0.1), "after unloading"),
        (lambda r: changed(r, penetration=lambda p: p + 0.031), "penetration"),
        (lambda r: moved(r, (0, 0, 0), (0, 0, -40.0)), "folded"),
        (lambda r: moved(r, (30, 30, -30), (-24.0, -22.0, 18.0)), "tissue inside"),
    ],
)
def test_no_law_is_broken_silently(robustness, result, tamper, law):
    assert result.completed
    assert robustness.broken_laws(result) == []
    assert any(law in broken for broken in robustness.broken_laws(tamper(result)))


def test_a_simulation_that_raises_is_a_crash_with_its_reason(robustness, cases, monkeypatch):
    monkeypatch.setitem(cases.TOOLS, "sphere", lambda width, rng: {"shape": "sphere", "width": -width})
    numbers = [n for n in range(30) if cases.draw(0, n).tool == "sphere"]
    outcome = robustness.run_case(0, numbers[0])
    assert outcome.outcome == "crash"
    assert "is not positive" in outcome.reason


@pytest.mark.slow
def test_worker_outlives_cases_that_hang_or_kill_it(robustness):
    worker = robustness.Worker(0, limit_s=0.3)
    worker.limit_s = 600.0  # from the next process on
    try:
        late = worker.run(4)
        assert (late.outcome, late.number) == ("hang", 4)
        os.kill(worker.process.pid, 9)
        dead = worker.run(13)
        assert dead.outcome == "crash"
        assert "exit -9" in dead.reason
        assert worker.run(13).outcome == "completed"
    finally:
        worker.stop()


def test_summary_counts_what_happened(robustness):
    made = [
        robustness.Outcome(0, "completed", seconds_cpu=1.0, facts={"cuts": 0.0}),
        robustness.Outcome(1, "completed", broken=["folded element"], seconds_cpu=2.0, facts={"cuts": 4.0}),
        robustness.Outcome(2, "partial", "stopped at 1 s", seconds_cpu=3.0, facts={"cuts": 8.0}),
        robustness.Outcome(3, "hang", "not done after 300 s"),
    ]
    found = robustness.summary(made)
    assert found["outcomes"] == {"completed": 2, "partial": 1, "hang": 1}
    assert found["completed_percent"] == 50.0
    assert found["completed_and_lawful_percent"] == 25.0
    assert found["broken"] == {"folded element": 1}
    assert found["costs"]["cuts"]["max"] == 8.0


def doubled_cell(mesh: Mesh) -> Mesh:
    return replace(mesh, cells=np.vstack([mesh.cells, mesh.cells[:1]]), regions=np.append(mesh.regions, 0))


BAD: list[tuple[Callable[[Problem], dict], str]] = [
    (lambda p: {"fixed": np.array([len(p.mesh.points)])}, "fixed nodes refer to nodes"),
    (lambda p: {"contact_faces": p.contact_faces + len(p.mesh.points)}, "contact faces refer to nodes"),
    (lambda p: {"supports": (Support(np.array([-1]), 0),)}, "support nodes refer to nodes"),
    (lambda p: {"contact_faces": p.contact_faces[:, :3]}, "contact faces have shape"),
    (lambda p: {"fixed": np.arange(len(p.mesh.points))}, "nothing is left to solve"),
    (lambda p: {"start": "anywhere"}, "unknown start"),
    (lambda p: {"contact_rule": "faces"}, "unknown contact rule"),
    (lambda p: {"mesh": replace(p.mesh, regions=p.mesh.regions + 1)}, "region indices without a name"),
    (lambda p: {"mesh": p.mesh.with_points(np.vstack([p.mesh.points, [[0, 0, 9]]]))}, "belong to no cell"),
    (lambda p: {"mesh": p.mesh.with_points(np.where(p.mesh.points > 29, np.nan, p.mesh.points))}, "finite"),
    (lambda p: {"mesh": p.mesh.with_points(p.mesh.points * [1, 1, 0])}, "inverted or flat"),
    (lambda p: {"mesh": replace(p.mesh, cells=p.mesh.cells[:, [1, 0, *range(2, 10)]])}, "inverted or flat"),
    (lambda p: {"mesh": doubled_cell(p.mesh)}, "1 cells are there twice"),
    (lambda p: {"contact_faces": np.zeros((0, 6), dtype=int)}, "contact faces"),
    (lambda p: {"fixed": np.zeros(0, dtype=int)}, "nothing is held in place"),
    (lambda p: {"element": "hex8"}, "no element"),
    (lambda p: {"supports": (Support(p.fixed, -1),)}, "no component -1; use 0, 1 or 2"),
    (lambda p: {"indenter": replace(p.indenter, edge=(np.nan, 0.0, 0.0))}, "edge is not three finite"),
    (lambda p: {"materials": {"muscle": SKIN}}, "region 'skin' has no material"),
]


@pytest.mark.parametrize(("change", "what"), BAD)
def test_bad_input_is_refused_before_anything_is_solved(change, what):
    problem = punch("tet10", 2, 1)
    with pytest.raises(ProblemError, match=what):
        solve(replace(problem, **change(problem)), on_step=lambda step: pytest.fail("a step was solved"))
