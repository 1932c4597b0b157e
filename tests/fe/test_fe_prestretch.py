"""Tissue that is strained where the mesh is: closed forms, tangent, relaxation, derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import MUSCLE, SKIN, block, check_sensitivities, check_tangent, punch, untouched

from limbfit import History, OgdenQLV, Problem
from limbfit.errors import ProblemError
from limbfit.fe import StepControl, Support, System, isochoric_stretch, iterate, solve
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.observables import compute_element_fields
from limbfit.fe.system import Increment

LINES = np.linspace(0.0, 2.0, 3)
TISSUE = OgdenQLV(0.005, 4.0, 2.0, 0.5)
ASKEW = np.array([1.0, 2.0, 2.0]) / 3.0
UP = np.array([0.0, 0.0, 1.0])
EXACT = StepControl(times=(0.5, 1.0), tolerance=1e-11)


def cube(G: np.ndarray, cell_type: str, element: str = "", held: bool = True) -> Problem:
    """A cube of one tissue, its inner nodes anywhere; its boundary is held, or free but for three planes."""
    mesh = block(cell_type, LINES, LINES, LINES, jitter=0.2)
    outside = np.flatnonzero(((mesh.points < 1e-9) | (mesh.points > 2.0 - 1e-9)).any(axis=1))
    planes = [Support(np.flatnonzero(mesh.points[:, i] < 1e-9), i) for i in range(3)]
    still = History(np.array([0.0, 1.0]), np.zeros(2))
    how = {"fixed": outside} if held else {"supports": tuple(planes)}
    return untouched(mesh, TISSUE, still, element=element, prestretch=G, **how)


def tension(stretch: float) -> np.ndarray:
    """Principal Cauchy stresses (along, across) of the long-term law at constant volume, deviatoric, MPa."""
    c, m = TISSUE.c, TISSUE.m
    beta = np.array([2.0 * c / m * np.sinh(m * np.log(s)) for s in (stretch, stretch**-0.5)])
    return beta - (beta[0] + 2.0 * beta[1]) / 3.0


@pytest.mark.parametrize(
    ("cell_type", "element", "stretch"),
    [("tet4", "", 1.3), ("tet10", "", 0.8), ("tet10", "tet10p0", 1.3), ("hex8", "", 0.8)],
)
def test_a_held_block_has_the_long_term_stress_of_its_pre_stretch(cell_type, element, stretch):
    """Nothing moves, whatever the inner nodes (patch test), and nothing relaxes: it has long since."""
    G = isochoric_stretch(ASKEW, stretch)[0]
    problem = cube(G, cell_type, element)
    laws, system = problem.build_laws(), System(problem)
    along, across = tension(stretch)
    stress = across * np.eye(3) + (along - across) * np.outer(ASKEW, ASKEW)
    expected = stress[[0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
    steps = list(iterate(problem, EXACT))
    assert len(steps) == 2
    for step in steps:
        np.testing.assert_allclose(step.state.u, 0.0, atol=1e-8)
        found = compute_element_fields(system, laws, step.state).cauchy
        np.testing.assert_allclose(found, np.tile(expected, (len(found), 1)), atol=1e-7 * abs(along))


@pytest.mark.parametrize("element", ["", "tet10p0"])
def test_a_free_block_goes_back_to_what_it_is_on_its_own(element):
    """``F G`` is the identity then: an affine field, without stress."""
    G = np.diag([1.2, 0.9, 1.05])  # its volume has changed, too
    problem = cube(G, "tet10", element, held=False)
    result = solve(problem, EXACT, store="all")
    assert result.completed, result.reason
    F = np.linalg.inv(G)
    np.testing.assert_allclose(result.states[-1].u, problem.mesh.points @ (F - np.eye(3)).T, atol=1e-7)
    last = list(iterate(problem, EXACT))[-1].state
    fields = compute_element_fields(System(problem), problem.build_laws(), last)
    np.testing.assert_allclose(fields.cauchy, 0.0, atol=1e-9)


@pytest.mark.parametrize("element", ["", "tet10p0"])
def test_forces_and_tangent_are_derivatives(element):
    stretches = np.random.default_rng(4).uniform(0.8, 1.2, 48)
    problem = cube(np.eye(3), "tet10", element, held=False)
    problem = replace(problem, prestretch=isochoric_stretch(np.tile(ASKEW, (48, 1)), stretches))
    system, laws = System(problem), Laws.build([SKIN, MUSCLE])
    random = np.random.default_rng(5)
    K = 0.001 * random.normal(size=(*system.weights.shape, 6))
    u = 0.03 * random.normal(size=(system.rows, 3)) * ~system.supported
    d = random.normal(size=u.shape) * ~system.supported
    check_tangent(system, laws, u, Increment(0.0, 0.0, np.array([1.5, 2.5]), K, 1.0), d)


def taut(stretch: float) -> Problem:
    """The block of `punch` whose skin is stretched in its plane."""
    problem = punch("hex8", 2, 1, depth=4.0)
    history = History(np.array([0.0, 4.0, 7.0]), np.array([0.0, 4.0, 1.0]))
    mesh, skin = problem.mesh, problem.mesh.region_names.index("skin")
    stretches = np.where(mesh.regions == skin, stretch**-2.0, 1.0)
    G = isochoric_stretch(np.tile(UP, (len(mesh.cells), 1)), stretches)
    sides = np.flatnonzero((np.abs(mesh.points[:, :2]) > 30.0 - 1e-9).any(axis=1))  # that keep it taut
    return replace(problem, history=history, prestretch=G, fixed=np.union1d(problem.fixed, sides))


def test_taut_skin_is_stiffer_and_no_stretch_is_none():
    control = StepControl(load_steps=4, unload_steps=3, tolerance=1e-10)
    plain = solve(replace(taut(1.0), prestretch=None), control)
    none, tense = solve(taut(1.0), control), solve(taut(1.2), control)
    np.testing.assert_allclose(none.force, plain.force, atol=1e-7 * plain.peak_force)
    assert tense.completed, tense.reason
    assert tense.peak_force > 1.05 * plain.peak_force


def test_tissue_that_swells_against_an_indenter_presses_it_from_the_beginning():
    """It has done so long since: nothing changes while the indenter stays."""
    still = History(np.array([0.0, 1.0]), np.zeros(2))
    stretch = isochoric_stretch(UP, 0.9)
    problem = punch("hex8", 2, 1, history=still, start="as-given", prestretch=stretch)
    problem = replace(problem, indenter=replace(problem.indenter, centre=(0.0, 0.0, 0.0)))
    found = solve(problem, StepControl(tolerance=1e-8), sensitivities=True)
    assert found.force[0] > 0.1
    np.testing.assert_allclose(found.force, found.force[-1], rtol=1e-5)
    np.testing.assert_allclose(found.force_at([0.0, 0.01]), found.force[-1], rtol=1e-5)
    largest = np.abs(found.force_sensitivity[-1]).max()
    np.testing.assert_allclose(found.force_sensitivity[0], found.force_sensitivity[-1], atol=1e-3 * largest)


def test_derivatives_under_a_punch():
    """They follow the equilibrium before, and where the indenter touches."""
    problem, control = taut(1.15), StepControl(load_steps=4, unload_steps=3, tolerance=1e-11)
    check_sensitivities(problem, control, 1e-3, ("skin", "m"), ("muscle", "tau"))


def test_what_cannot_be_is_refused():
    problem = cube(np.eye(3), "tet4")
    for given, match in (
        (np.ones(3), r"shape \(3,\); give \(3, 3\), or \(48, 3, 3\)"),
        (-np.eye(3), "its determinant is not positive"),
        (np.full((3, 3), np.nan), "not finite"),
    ):
        with pytest.raises(ProblemError, match=match):
            System(replace(problem, prestretch=given))
    with pytest.raises(ProblemError, match="no vector of three numbers with a length"):
        isochoric_stretch(np.zeros(3), 1.1)
    with pytest.raises(ProblemError, match="a pre-stretch is not positive"):
        isochoric_stretch(UP, 0.0)
    forced = punch("hex8", 2, 1, history=History(np.array([0.0, 1.0]), force=np.array([0.0, 1.0])))
    with pytest.raises(ProblemError, match="touches pre-strained tissue is driven by displacement"):
        solve(replace(forced, prestretch=np.eye(3)))
