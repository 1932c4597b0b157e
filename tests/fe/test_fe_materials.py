"""Material laws at a point: stress and moduli against differences, relaxation against its closed form."""

from __future__ import annotations

import numpy as np
import pytest
from blocks import block

from limbfit.errors import ProblemError
from limbfit.fe import History, OgdenQLV, Problem, StepControl, Support, System, iterate
from limbfit.fe.kinematics import logarithmic_stretches, principal
from limbfit.fe.laws import Laws
from limbfit.fe.materials import VOLUMETRIC_LAWS, prony_factors
from limbfit.fe.materials.ogden import ogden
from limbfit.fe.materials.volumetric import volumetric
from limbfit.fe.observables import element_fields

LAW = OgdenQLV(0.00522, 4.79, 3.57, 0.32)


def response(c2):
    e, beta, slope, quotient = (np.empty(3) for _ in range(4))
    logarithmic_stretches(np.asarray(c2, dtype=float), e)
    energy = ogden(LAW.table().terms, np.asarray(c2, dtype=float), e, beta, slope, quotient)
    return energy, beta, slope, quotient


@pytest.mark.parametrize("seed", range(20))
def test_principal_stresses_are_derivatives_of_the_energy(seed):
    x = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)  # ln lambda
    _, beta, slope, _ = response(np.exp(2 * x))
    h = 1e-6
    for i in range(3):
        step = h * np.eye(3)[i]
        ahead, back = response(np.exp(2 * (x + step))), response(np.exp(2 * (x - step)))
        assert (ahead[0] - back[0]) / (2 * h) == pytest.approx(beta[i], abs=1e-9 * np.abs(slope).max())
        moduli = slope.sum() / 9 - (slope + slope[i]) / 3 + slope[i] * np.eye(3)[i]
        np.testing.assert_allclose((ahead[1] - back[1]) / (2 * h), moduli, atol=1e-7 * slope.max())


@pytest.mark.parametrize("gap", [0.3, 1e-2, 1e-4, 1e-7, 1e-12, 0.0])
def test_divided_differences_have_their_limit(gap):
    """(beta_1 - beta_2)/(c2_1 - c2_2) tends smoothly to d beta/d c2 as two stretches meet."""
    c2 = np.array([1.3 * (1 + gap), 1.3, 0.6])
    _, _, _, quotient = response(c2)
    c, m = LAW.c, LAW.m
    # The difference quotient of f is the mean of f' over the interval; f = 2 c/m sinh(m e).
    x, w = np.polynomial.legendre.leggauss(30)
    between = c2[1] + (c2[0] - c2[1]) * (x + 1) / 2
    strain = 0.5 * np.log(between) - np.log(c2).sum() / 6
    exact = (w / 2 * c * np.cosh(m * strain) / between).sum()
    assert quotient[2] == pytest.approx(exact, rel=1e-12)


def test_small_strain_shear_modulus_is_c():
    _, _, slope, quotient = response(np.ones(3))
    np.testing.assert_allclose(slope, 2 * LAW.c, rtol=1e-14)
    np.testing.assert_allclose(quotient, LAW.c, rtol=1e-14)


def test_principal_axes_rebuild_the_strain():
    rng = np.random.default_rng(0)
    for F in [np.eye(3), *(np.eye(3) + 0.4 * rng.normal(size=(50, 3, 3)))]:
        A, c2, N = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        principal(F, A, c2, N)
        np.testing.assert_allclose(N @ np.diag(c2) @ N.T, F.T @ F, atol=1e-14 * c2.max())
        np.testing.assert_allclose(N.T @ N, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("law", sorted(VOLUMETRIC_LAWS))
@pytest.mark.parametrize("J", [0.7, 1.0, 1.4])
def test_volumetric_laws(law, J):
    code, h = VOLUMETRIC_LAWS[law], 1e-6
    U = [volumetric(code, 2.0, J * np.exp(s * h)) for s in (-1, 1)]
    _, slope, curvature = volumetric(code, 2.0, J)
    assert (U[1][0] - U[0][0]) / (2 * h) == pytest.approx(slope, abs=1e-9)
    assert (U[1][1] - U[0][1]) / (2 * h) == pytest.approx(curvature, rel=1e-8)
    if J == 1.0:
        assert curvature == pytest.approx(2.0)


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 0.1, 10.0])
def test_prony_factors_and_their_derivatives(dt):
    tau, h = 0.32, 1e-5
    _, ramp, d_decay, d_ramp = prony_factors(dt, tau)
    grid = np.linspace(0.0, dt, 20001)
    assert ramp == pytest.approx(np.trapezoid(np.exp(-(dt - grid) / tau), grid) / dt, rel=1e-6)
    ahead, back = prony_factors(dt, tau + h), prony_factors(dt, tau - h)
    assert d_decay == pytest.approx((ahead[0] - back[0]) / (2 * h), rel=1e-5)
    assert d_ramp == pytest.approx((ahead[1] - back[1]) / (2 * h), rel=1e-4, abs=1e-10)


def test_hold_relaxes_like_the_prony_series():
    """A stretch applied quickly and held: the stress falls as 1 + gamma exp(-t/tau), to 1e-3 of a ramp."""
    law = OgdenQLV(0.005, 4.8, 3.6, 0.3, kappa_ratio=1e5)
    lines = np.array([0.0, 1.0])
    mesh = block("hex8", lines, lines, lines)
    X = mesh.points
    sides = tuple(Support(np.flatnonzero(X[:, i] == 0.0), i) for i in range(3))
    top = Support(np.flatnonzero(X[:, 2] == 1.0), 2, -0.2)
    ramp = 1e-4
    history = History(np.array([0.0, ramp, 2.0]), np.array([0.0, 1.0, 1.0]))
    none = np.zeros(0, dtype=int)
    problem = Problem(
        mesh, {"skin": law, "muscle": law}, none, np.zeros((0, 4), int), None, history, supports=(*sides, top)
    )
    times = (ramp, *np.linspace(0.1, 2.0, 15))
    system, laws = System(problem), Laws.build([law, law])
    stress = [
        element_fields(system, laws, s.state).cauchy[0, 2]
        for s in iterate(problem, StepControl(times=times, tolerance=1e-10))
    ]
    stretch, c, m = 0.8, law.c, law.m
    elastic = 2 * c / m * (np.sinh(m * np.log(stretch)) + np.sinh(m * np.log(stretch) / 2))
    expected = elastic * (1 + law.gamma * np.exp(-np.array(times) / law.tau))
    np.testing.assert_allclose(stress, expected, rtol=2e-3)


@pytest.mark.parametrize("change", [{"c": 0.0}, {"c": np.nan}, {"m": -1.0}, {"gamma": -0.1}, {"tau": 0.0}])
def test_impossible_parameters_are_refused(change):
    values = {"c": 0.005, "m": 4.0, "gamma": 1.0, "tau": 0.3, **change}
    with pytest.raises(ProblemError, match=next(iter(change))):
        OgdenQLV(**values)
