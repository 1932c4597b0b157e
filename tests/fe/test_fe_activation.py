"""Active stress along fibres: closed forms, tangent, no relaxation, derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import FINE_Z, block, check_sensitivities, check_tangent, punch, untouched
from scipy.optimize import brentq
from test_fe_fibres import ASKEW, GROUND, LINES, TISSUE, bent, body

from limbfit import History, OgdenQLV, Problem
from limbfit.errors import ProblemError
from limbfit.fe import (
    Activation,
    ContractileMaterial,
    FibredMaterial,
    StepControl,
    Support,
    System,
    iterate,
    solve,
)
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.observables import compute_element_fields
from limbfit.fe.system import Increment

ELASTIC = OgdenQLV(0.005, 4.0, 0.0, 1.0)
TENSE = Activation([0.0, 1.0], [0.0, 1.0])


def bar(
    tissue: ContractileMaterial, held: bool, end_s: float = 1.0, activation: Activation = TENSE
) -> Problem:
    """A cube with fibres along x, its sides free; its ends are held, or free too."""
    mesh = block("hex8", LINES, LINES, LINES)
    planes = [Support(np.flatnonzero(mesh.points[:, i] == 0.0), i) for i in range(3)]
    if held:
        planes.append(Support(np.flatnonzero(mesh.points[:, 0] == 1.0), 0))
    still, along = History(np.array([0.0, end_s]), np.array([0.0, 1e-9])), (1.0, 0.0, 0.0)
    return untouched(mesh, tissue, still, supports=tuple(planes), fibres=along, activation=activation)


def test_a_free_bar_shortens_until_the_ground_bears_the_active_stress():
    """At constant volume ``c/m (2 l^m + ...)`` along and across: ``T = 2 c/m (sinh(m e) + sinh(m e/2))``."""
    tissue = ContractileMaterial(FibredMaterial(replace(ELASTIC, kappa_ratio=1e4), 0.0, 1.0), 0.01)
    result = solve(bar(tissue, held=False), StepControl(load_steps=5, tolerance=1e-10), store="all")
    assert result.completed, result.reason
    stretch = 1.0 + result.states[-1].u[:, 0].min()
    c, m = ELASTIC.c, ELASTIC.m

    def missing(e: float) -> float:
        return 2.0 * c / m * (np.sinh(m * e) + np.sinh(m * e / 2.0)) - 0.01

    assert stretch == pytest.approx(np.exp(-brentq(missing, 0.0, 1.0)), rel=1e-3)
    assert stretch < 0.85


def test_a_held_bar_pulls_with_the_active_stress_and_does_not_relax():
    """Sides free, length held: the stress along is the active one; it stays in a hold of relaxing tissue."""
    tissue = ContractileMaterial(FibredMaterial(replace(GROUND, kappa_ratio=1e4), 0.02, 3.0), 0.004)
    held = Activation([0.0, 1.0, 9.0], [0.0, 1.0, 1.0])
    times = StepControl(times=(0.5, 1.0, 3.0, 9.0), tolerance=1e-10)
    problem = bar(tissue, True, 9.0, held)
    system, laws = System(problem), problem.build_laws()
    stress = [
        compute_element_fields(system, laws, step.state).cauchy[:, 0] for step in iterate(problem, times)
    ]
    assert len(stress) == 4
    for found, share in zip(stress, (0.5, 1.0, 1.0, 1.0)):
        np.testing.assert_allclose(found, 0.004 * share, rtol=1e-3)


@pytest.mark.parametrize("element", ["", "tet10p0"])
def test_forces_and_tangent_are_derivatives(element):
    system, passive = body("tet10", element)
    laws = Laws.build([OgdenQLV(0.009, 6.0, 2.0, 0.5), ContractileMaterial(TISSUE, 0.1)])
    K = 0.001 * np.random.default_rng(2).normal(size=(*system.weights.shape, 6))
    step = Increment(0.0, 0.0, np.array([1.5, 2.5]), K, 1.0, activation=0.7)
    u = bent(system)
    d = np.random.default_rng(5).normal(size=u.shape) * ~system.supported
    here = check_tangent(system, laws, u, step, d)
    without = system.evaluate(u, passive, step).residual
    assert np.abs(here.residual - without).max() > 0.05 * np.abs(without).max()


def test_sensitivities_of_a_contracting_muscle_under_a_punch():
    """It tenses while it is pressed; forces by the active stress, the fibres and the ground."""
    muscle = ContractileMaterial(TISSUE, 0.006)
    problem = punch(
        "hex8", 2, 1, 4.0, materials={"skin": GROUND, "muscle": muscle}, fibres=ASKEW,
        activation=Activation([0.0, 4.0, 9.0], [0.0, 1.0, 0.5]),
    )  # fmt: skip
    control = StepControl(load_steps=3, unload_steps=2, tolerance=1e-10)
    centre = check_sensitivities(problem, control, 1e-3, ("muscle", "active"), ("muscle", "c"))
    assert list(centre.parameter_names)[-1] == ("muscle", "active")
    passive = solve(replace(problem, materials={"skin": GROUND, "muscle": TISSUE}), control)
    assert np.abs(centre.force - passive.force_at(centre.times)).max() > 0.02 * passive.force.max()


def test_the_force_between_steps_turns_where_contraction_does():
    """A held punch, and muscle that tenses from 4 to 4.5 s: no spline goes across."""
    problem = punch(
        "tet10", 2, 1, z=FINE_Z, history=History(np.array([0.0, 1.0, 10.0]), np.array([0.0, 3.0, 3.0])),
        fibres=(1.0, 0.0, 0.0), activation=Activation([0.0, 4.0, 4.5, 10.0], [0.0, 0.0, 1.0, 1.0]),
    )  # fmt: skip
    tissue = ContractileMaterial(FibredMaterial(problem.materials["muscle"], 0.001, 1.0), 0.02)
    problem = problem.with_materials({**problem.materials, "muscle": tissue})
    found = solve(problem, StepControl(tolerance=1e-5))
    fine = solve(
        problem, StepControl(times=(0.5, 1.0, 2.0, 3.0, 4.0, 4.5, 5.0, 6.0, 7.0, 8.5, 10.0), tolerance=1e-5)
    )
    after = fine.times >= 2.0
    assert np.ptp(fine.force[after]) > 0.2 * fine.peak_force
    difference = found.force_at(fine.times) - fine.force
    np.testing.assert_allclose(difference[after], 0.0, atol=0.025 * fine.peak_force)


def test_contraction_is_no_strain_energy():
    """What fibres shorten by themselves strains the ground, and nothing else stores energy."""
    tissue = ContractileMaterial(FibredMaterial(ELASTIC, 0.01, 1.0), 0.01)
    problem = bar(tissue, held=False)
    (step,) = iterate(problem, StepControl(times=(1.0,)))
    system, laws = System(problem), problem.build_laws()
    active = compute_element_fields(system, laws, step.state).energy
    assert (active > 1e-4).all()
    resting = replace(step.state, activation=0.0)
    np.testing.assert_allclose(active, compute_element_fields(system, laws, resting).energy, rtol=1e-9)


def test_what_cannot_be_is_refused():
    with pytest.raises(ProblemError, match=r"active = -1\.0 is negative"):
        ContractileMaterial(TISSUE, -1.0)
    with pytest.raises(ProblemError, match="acts at no stated time"):
        solve(replace(bar(ContractileMaterial(TISSUE, 0.01), True), activation=None))
    with pytest.raises(ProblemError, match="do not grow from 0"):
        Activation([1.0, 2.0], [0.0, 1.0])
    with pytest.raises(ProblemError, match="negative or not finite"):
        Activation([0.0, 1.0], [0.0, -1.0])
    with pytest.raises(ProblemError, match="have no direction"):
        solve(replace(bar(ContractileMaterial(FibredMaterial(GROUND, 0.0, 1.0), 0.01), True), fibres=None))
