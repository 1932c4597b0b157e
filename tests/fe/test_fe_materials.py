"""Material laws at a point: energy, stress, moduli, parameters and relaxation against independent forms."""

import numpy as np
import pytest
from blocks import block, check_tangent, punch, untouched
from samples import SAMPLES, energy, kirchhoff, moved, point, pressure, quotients, relaxed, volume_energy

from limbfit.errors import ProblemError
from limbfit.fe import (
    VOLUMETRIC_LAWS,
    FibredMaterial,
    History,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    OgdenQLV,
    StepControl,
    Support,
    System,
    iterate,
    solve,
)
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.materials.elastic import volumetric
from limbfit.fe.observables import compute_element_fields
from limbfit.fe.system import Increment

every_law = pytest.mark.parametrize("law", SAMPLES.values(), ids=SAMPLES)
STRETCHES = {
    "rest": [1.0, 1.0, 1.0],
    "three equal": [0.9, 0.9, 0.9],
    "two equal": [0.7, 1.2, 1.2],
    "nearly equal": [1.1, 1.1 + 1e-9, 0.8],
    "apart": [0.6, 1.1, 1.5],
}
every_stretch = pytest.mark.parametrize("stretches", STRETCHES.values(), ids=STRETCHES)


def response(law, stretches):
    """Slopes and divided differences of the kernel."""
    p, _ = point(law, np.diag(np.asarray(stretches, dtype=float)))
    return p["slope"][:, 0], p["quotient"][:, 0]


@every_stretch
@every_law
def test_slopes_are_derivatives_of_the_stresses(law, stretches):
    slope, _ = response(law, stretches)
    h, x = 1e-6, np.log(stretches)
    for i in range(3):
        step = h * np.eye(3)[i]
        change = (kirchhoff(law, np.exp(x + step)) - kirchhoff(law, np.exp(x - step))) / (2 * h)
        hessian = slope[[[0, 3, 5], [3, 1, 4], [5, 4, 2]]]
        rows = hessian.sum(axis=0)
        moduli = rows.sum() / 9 - (rows + rows[i]) / 3 + hessian[i]
        np.testing.assert_allclose(moduli, change, atol=1e-7 * np.abs(slope).max())


@every_law
@pytest.mark.parametrize("gap", [0.3, 1e-2, 1e-4, 1e-7, 1e-12, 0.0])
def test_divided_differences_have_their_limit(law, gap):
    """(beta_1 - beta_2)/(c2_1 - c2_2) tends smoothly to d beta/d c2 as two stretches meet."""
    c2 = np.array([1.3 * (1 + gap), 1.3, 0.6])
    _, quotient = response(law, np.sqrt(c2))
    assert quotient[2] == pytest.approx(quotients(law, c2)[2], rel=1e-11)


@every_law
def test_moduli_of_small_strains(law):
    slope, quotient = response(law, np.ones(3))
    mu = law.shear_modulus
    np.testing.assert_allclose(slope[:3], 2 * mu, rtol=1e-14)
    np.testing.assert_array_equal(slope[3:], 0.0)
    np.testing.assert_allclose(quotient, mu, rtol=1e-14)
    assert law.table().kappa == pytest.approx(law.kappa_ratio * mu)
    assert law.instantaneous_modulus == pytest.approx(mu * (1 + sum(g for g, _ in law.prony)))


@every_law
def test_parameter_derivatives_of_the_table(law):
    values = np.array(law.parameters)
    assert len(values) == len(law.parameter_names) == len(law.derivatives()) == len(set(law.parameter_names))
    for j, slope in enumerate(law.derivatives()):
        h = 1e-6 * values[j]
        ends = [moved(law, values + s * h * np.eye(len(values))[j]) for s in (1, -1)]
        ahead, back = (end.table() for end in ends)
        for name in ("numbers", "kappa", "prony"):
            change = (np.asarray(getattr(ahead, name)) - getattr(back, name)) / (2 * h)
            np.testing.assert_allclose(getattr(slope, name), change, atol=1e-7 * max(1, law.kappa_ratio))
        change = (ends[0].instantaneous_modulus - ends[1].instantaneous_modulus) / (2 * h)
        assert law.instantaneous_modulus_gradient[j] == pytest.approx(change, rel=1e-7, abs=1e-12)


@every_stretch
@every_law
def test_parameter_derivatives_of_the_stress(law, stretches):
    values, x = np.array(law.parameters), np.array(stretches)
    _, rates = point(law, np.diag(x))
    for j, slope in enumerate(law.derivatives()):
        h = 1e-5 * values[j]
        ends = [moved(law, values + s * h * np.eye(len(values))[j]) for s in (1, -1)]
        change = (kirchhoff(ends[0], x) - kirchhoff(ends[1], x)) / (2 * h)
        found = slope.numbers @ rates["kept"][..., 0]
        np.testing.assert_allclose(found, change, atol=1e-8 * max(1.0, np.abs(change).max()))


def one_brick(law) -> tuple[System, Laws]:
    """A cube of one hexahedron, its bottom held."""
    lines = np.array([0.0, 1.0])
    mesh = block("hex8", lines, lines, lines)
    problem = untouched(mesh, law, fixed=mesh.node_sets["bottom"])
    return System(problem), problem.build_laws()


@every_stretch
@every_law
def test_forces_and_stiffness_are_derivatives_of_the_energy(law, stretches):
    """In axes turned against the stretches, with all the volumetric laws."""
    system, laws = one_brick(law)
    Q, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    u = system.points @ (Q @ np.diag(stretches) @ Q.T - np.eye(3))
    rest = Increment(0.0, 0.0, np.array([2.5, 2.5]), np.zeros((*system.weights.shape, 6)), 1.0)
    d = np.random.default_rng(6).normal(size=u.shape) * ~system.supported
    here = check_tangent(system, laws, u, rest, d, h=1e-5, rel=1e-8)
    J = np.prod(stretches)
    expected = 2.5 * energy(law, np.array(stretches)) + volume_energy(law.volumetric, laws.kappa[0], J)
    assert here.energy == pytest.approx(expected, rel=1e-10, abs=1e-15)


def affine(law, direction, times, history) -> list[np.ndarray]:
    """Cauchy stresses (6,) at the steps of a block; its boundary moves by ``displacement(t) direction X``."""
    lines = np.array([0.0, 0.5, 1.0])
    mesh = block("hex8", lines, lines, lines)
    X = mesh.points
    edge = np.flatnonzero(((X == 0.0) | (X == 1.0)).any(axis=1))
    supports = tuple(Support(np.array([n]), i, direction[i] * X[n, i]) for n in edge for i in range(3))
    problem = untouched(mesh, law, history, supports=supports)
    system, laws = System(problem), problem.build_laws()
    steps = iterate(problem, StepControl(times=tuple(times), tolerance=1e-11))
    return [compute_element_fields(system, laws, s.state).cauchy[0] for s in steps]


@pytest.mark.parametrize("name", ["paper", "power", "ogden", "elastic"])
def test_relaxation_equals_the_integrated_convolution(name):
    """Loading, hold and partial unloading, two stretches equal; second order in the step."""
    law = SAMPLES[name]
    direction = np.array([0.12, 0.12, -0.3])
    history = History(np.array([0.0, 0.5, 1.0, 1.5]), np.array([0.0, 1.0, 1.0, 0.4]))
    fine = np.linspace(0.0, 1.5, 3001)
    stretches = 1 + history.at(fine)[:, None] * direction
    J, S = stretches.prod(axis=1), relaxed(law, fine, stretches)
    p = pressure(law.volumetric, law.kappa_ratio * law.shear_modulus, J)
    exact = S * stretches**2 / J[:, None] + p[:, None]
    errors = []
    for n in (15, 30):
        times = np.linspace(0.0, 1.5, n + 1)[1:]
        found = np.array(affine(law, direction, times, history))
        reference = exact[np.round(times / 1.5 * 3000).astype(int)]
        assert np.abs(found[:, 3:]).max() < 1e-12
        errors.append(np.abs(found[:, :3] - reference).max() / np.abs(reference).max())
    assert errors[1] < 1e-3
    if law.prony:
        assert errors[0] / errors[1] > 3.0
    else:
        assert errors[0] < 1e-10


@pytest.mark.parametrize("law", [SAMPLES["paper"], SAMPLES["power"]], ids=["one term", "power of time"])
def test_a_held_strain_relaxes_as_the_closed_form(law):
    """Of 1 %, ramped in 0.1 s and held for 1000 s, in steps that grow."""
    strain, seconds = 0.01 * np.array([0.5, 0.5, -1.0]), 0.1
    history = History(np.array([0.0, seconds, 1000.0]), np.array([0.0, 1.0, 1.0]))
    times = np.concatenate([np.linspace(0.0, seconds, 6)[1:], seconds + np.geomspace(0.01, 999.9, 100)])
    found = np.array(affine(law, strain, times, history))
    g, tau = np.array(law.prony).T
    t = times[times >= seconds - 1e-12][:, None]
    ramped = tau / seconds * (np.exp(-(t - seconds) / tau) - np.exp(-t / tau))
    elastic = kirchhoff(law, 1.0 + strain) / (1.0 + strain).prod()
    expected = (elastic[2] - elastic[0]) * (1.0 + ramped @ g)
    np.testing.assert_allclose((found[:, 2] - found[:, 0])[-len(t) :], expected, rtol=1e-3)


@pytest.mark.parametrize("law", [SAMPLES[name] for name in ("power", "ogden", "mooney-rivlin")])
def test_a_simulation_has_the_sensitivities_of_its_law(law):
    """Along one direction of all parameters of the law."""
    problem = punch("tet4", 2, 1, materials={"skin": law, "muscle": SAMPLES["paper"]})
    control = StepControl(load_steps=4, unload_steps=3, tolerance=1e-11)
    centre = solve(problem, control, sensitivities=True, store="all")
    values = np.array(law.parameters)
    change = 1e-4 * values * np.random.default_rng(3).uniform(-1, 1, len(values))
    ahead, back = (
        solve(problem.with_materials({**problem.materials, "skin": skin}), control, warm_start=centre).force
        for skin in (moved(law, values + sign * change) for sign in (1, -1))
    )
    difference, slope = (ahead - back) / 2, centre.force_sensitivity[:, : len(values)] @ change
    assert np.abs(difference - slope).max() <= 1e-4 * np.abs(difference).max()


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
    assert U[0][0] == pytest.approx(volume_energy(law, 2.0, J * np.exp(-h)), abs=1e-15)


def test_a_parameter_that_a_material_does_not_have_is_refused_by_name():
    with pytest.raises(ProblemError, match="no parameter 'gama'; use one of c, m, gamma, tau"):
        OgdenQLV(0.005, 4.0, 1.0, 0.5).with_parameters({"gama": 2.0, "taus": 0.3})
    with pytest.raises(ProblemError, match="no parameter 'g1'; use one of mu"):
        FibredMaterial(NeoHookean(0.005), 0.01, 1.0).with_parameters({"g1": 2.0, "tau1": 0.3})


def test_lists_serve_as_well_as_tuples():
    assert OgdenQLV(0.005, 4.0, [1.0], [0.3]) == OgdenQLV(0.005, 4.0, 1.0, 0.3)
    assert Ogden([[0.005, 4]], [[1, 0.3]]) == Ogden(((0.005, 4.0),), ((1.0, 0.3),))


IMPOSSIBLE = [
    (OgdenQLV, (0.0, 4.0, 1.0, 0.3), "c = 0"),
    (OgdenQLV, (np.nan, 4.0, 1.0, 0.3), "c = nan"),
    (OgdenQLV, (0.005, -1.0, 1.0, 0.3), "m = -1"),
    (OgdenQLV, (0.005, 4.0, -0.1, 0.3), "gamma = -0.1"),
    (OgdenQLV, (0.005, 4.0, 1.0, 0.0), "tau = 0"),
    (OgdenQLV, (0.005, 4.0, (1.0, 2.0), (0.1,)), "2 gamma and 1 tau.* give as many of each"),
    (OgdenQLV, (0.005, 4.0, (1.0, -0.2), (0.1, 1.0)), "gamma2 = -0.2 is negative"),
    (OgdenQLV, (0.005, 4.0, (1.0, 0.2), (0.1, 0.0)), "tau2 = 0.0 is not positive"),
    (OgdenQLV, (0.005, 4.0, (), ()), r"gamma = \(\) is no number, nor several"),
    (OgdenQLV, (0.005, 4.0, "much", 1.0), "gamma = much is no number"),
    (Ogden, ((),), "1 to 6 terms"),
    (Ogden, (((0.001, 2.0),) * 7,), "1 to 6 terms"),
    (Ogden, (((0.005, 0.0),),), "m1 is zero"),
    (Ogden, (((0.005, 4.0), (np.nan, 2.0)),), "c2 = nan is not finite"),
    (Ogden, (((0.005, np.inf),),), "m1 = inf is not finite"),
    (Ogden, (((0.005, 4.0), (-0.006, 2.0)),), "shear modulus .* not positive"),
    (Ogden, ((0.005, 4.0),), "not pairs"),
    (Ogden, (((0.005, 4.0),), ((-0.1, 0.3),)), "g1 = -0.1 is negative"),
    (Ogden, (((0.005, 4.0),), ((0.1, 0.3), (0.1, 0.0))), "tau2 = 0.0 is not positive"),
    (Ogden, (((0.005, 4.0),), ((0.1, np.inf),)), "tau1 = inf is not finite"),
    (Ogden, (((0.005, 4.0),), ((1.0, 0.3),), 0.0), "kappa_ratio = 0.0 is not positive"),
    (
        Ogden,
        (((0.005, 4.0),), ((1.0, 0.3),), 1.0, "soft"),
        "unknown volumetric law 'soft'; use one of log, nike3d",
    ),
    (NeoHookean, (0.0,), "mu = 0.0 is not positive"),
    (NeoHookean, (0.1, ((1.0, -1.0),)), "tau1 = -1.0 is not positive"),
    (MooneyRivlin, (0.1, np.nan), "c2 = nan is not finite"),
    (MooneyRivlin, (0.1, -0.1), "shear modulus .* not positive"),
    (MooneyRivlin, (0.1, 0.1, (), -1.0), "kappa_ratio = -1.0 is not positive"),
]


@pytest.mark.parametrize(("law", "given", "what"), IMPOSSIBLE)
def test_impossible_materials_are_refused(law, given, what):
    with pytest.raises(ProblemError, match=what):
        law(*given)
