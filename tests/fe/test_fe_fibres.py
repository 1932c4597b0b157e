"""Fibres: uniaxial stretch in closed form, tangent, objectivity, sensitivities, patch, and none at all."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import block, check_sensitivities, check_tangent, punch, untouched
from scipy.optimize import fsolve

from limbfit import History, OgdenQLV
from limbfit.errors import ProblemError
from limbfit.fe import FibredMaterial, StepControl, Support, System, solve
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.memory import compute_elastic_stresses
from limbfit.fe.observables import compute_element_fields
from limbfit.fe.system import Increment

GROUND = OgdenQLV(0.005, 4.0, 0.8, 0.4)
TISSUE = FibredMaterial(GROUND, k1=0.02, k2=3.0)
LINES = np.linspace(0.0, 1.0, 3)
ASKEW = np.array([1.0, 2.0, 2.0]) / 3.0


def body(cell_type="tet10", element="", tissue=TISSUE, fibres=ASKEW, layer=0.5) -> tuple[System, Laws]:
    """A block with fibres below and none above."""
    mesh = block(cell_type, LINES, LINES, LINES, layer=layer, jitter=0.05)
    tissues = {"skin": OgdenQLV(0.009, 6.0, 2.0, 0.5), "muscle": tissue}
    problem = untouched(mesh, tissues, fixed=mesh.node_sets["bottom"], element=element, fibres=fibres)
    return System(problem), problem.build_laws()


def at_rest(system: System, history: float = 0.0) -> Increment:
    K = history * np.random.default_rng(2).normal(size=(*system.weights.shape, 6))
    return Increment(0.0, 0.0, np.array([1.5, 2.5]), K, 1.0)


def bent(system: System, seed: int = 4) -> np.ndarray:
    """Displacements of a stretch along the fibres, a shear and noise."""
    rng = np.random.default_rng(seed)
    gradient = 0.2 * np.outer(ASKEW, ASKEW) + 0.1 * rng.normal(size=(3, 3))
    return system.points @ gradient.T + 0.01 * rng.normal(size=system.points.shape)


@pytest.mark.parametrize(("cell_type", "element"), [("tet10", ""), ("tet10", "tet10p0"), ("hex8", "")])
def test_forces_and_tangent_are_derivatives(cell_type, element):
    system, laws = body(cell_type, element)
    u, rest = bent(system), at_rest(system, 0.001)
    d = np.random.default_rng(5).normal(size=u.shape) * ~system.supported
    here = check_tangent(system, laws, u, rest, d)
    plain, isotropic = body(cell_type, element, GROUND)
    without = plain.evaluate(u, isotropic, rest).residual
    assert np.abs(here.residual - without).max() > 0.1 * np.abs(without).max()  # the fibres do pull


def test_a_turned_body_has_turned_forces():
    system, laws = body()
    angle = np.radians(70.0)
    Q = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    u = bent(system)
    turned = (system.points + u) @ Q.T - system.points
    here, there = (system.evaluate(x, laws, at_rest(system)) for x in (u, turned))
    assert there.energy == pytest.approx(here.energy, rel=1e-12)
    np.testing.assert_allclose(there.residual, here.residual @ Q.T, atol=1e-12 * np.abs(here.residual).max())
    np.testing.assert_allclose(
        compute_elastic_stresses(system, laws, turned), compute_elastic_stresses(system, laws, u), atol=1e-14
    )


@pytest.mark.parametrize("k1", [0.0, 0.02])
def test_no_fibres_or_none_stretched_are_the_ground(k1):
    """Exactly: shortened along the fibres, and with k1 = 0."""
    system, laws = body(tissue=FibredMaterial(GROUND, k1, 3.0))
    u = bent(system) if k1 == 0.0 else system.points @ (-0.2 * np.outer(ASKEW, ASKEW))
    plain, isotropic = body(tissue=GROUND, fibres=None)
    here, there = (a.evaluate(u, b, at_rest(a)) for a, b in ((system, laws), (plain, isotropic)))
    np.testing.assert_array_equal(here.residual, there.residual)
    np.testing.assert_allclose(here.tangent, there.tangent, atol=1e-15 * np.abs(there.tangent).max())


def pull(tissue: FibredMaterial, stretch: float, along: bool) -> float:
    """Nominal stress of a bar whose sides are free, MPa: fibres along it, or across along y."""
    ground, i = tissue.ground, 0 if along else 1

    def principal(sides: np.ndarray) -> np.ndarray:
        """Kirchhoff stresses."""
        logs = np.log(np.array([stretch, *sides]))
        volume = logs.sum()
        lt = np.exp(logs - volume / 3.0)
        beta = 2.0 * ground.c / ground.m * np.sinh(ground.m * np.log(lt))
        longer = max(lt[i] ** 2 - 1.0, 0.0)
        beta[i] += 2.0 * lt[i] ** 2 * tissue.k1 * longer * np.exp(tissue.k2 * longer**2)
        return beta - beta.mean() + ground.kappa_ratio * ground.c * volume

    sides = fsolve(lambda x: 1e3 * principal(x)[1:], np.full(2, stretch**-0.5), xtol=1e-13)
    return principal(sides)[0] / stretch


@pytest.mark.parametrize("along", [True, False])
@pytest.mark.parametrize("stretch", [1.25, 0.75])
def test_a_bar_along_and_across_its_fibres(along, stretch):
    tissue = FibredMaterial(OgdenQLV(0.005, 4.0, 0.0, 1.0), 0.02, 3.0)
    mesh = block("hex8", LINES, LINES, LINES)
    planes = [Support(np.flatnonzero(mesh.points[:, i] == 0.0), i) for i in range(3)]
    end = Support(np.flatnonzero(mesh.points[:, 0] == 1.0), 0, 1.0 if stretch > 1 else -1.0)
    pulled = History(np.array([0.0, 1.0]), np.array([0.0, abs(stretch - 1.0)]))
    fibres = (1.0, 0.0, 0.0) if along else (0.0, 1.0, 0.0)
    problem = untouched(mesh, tissue, pulled, supports=(*planes, end), fibres=fibres)
    result = solve(problem, StepControl(load_steps=5, tolerance=1e-9), store="all")
    assert result.completed, result.reason
    fields = compute_element_fields(result.system, problem.build_laws(), result.states[-1])
    area = fields.J / stretch  # of the section, over that at rest
    np.testing.assert_allclose(fields.cauchy[:, 0] * area, pull(tissue, stretch, along), rtol=1e-6)
    bare = replace(tissue, k1=0.0)
    stiffer = abs(pull(tissue, stretch, along) / pull(bare, stretch, along))
    assert stiffer > 1.05 if (stretch > 1) == along else stiffer == pytest.approx(1.0)


def test_an_affine_field_is_kept():
    """Patch test at finite strain on an irregular mesh."""
    mesh = block("tet10", LINES, LINES, LINES, jitter=0.08)
    outer = np.flatnonzero(((mesh.points < 1e-9) | (mesh.points > 1 - 1e-9)).any(axis=1))
    gradient = 0.2 * np.outer(ASKEW, ASKEW) + np.array([[0.05, 0.1, 0], [0, -0.1, 0.05], [0, 0.02, -0.05]])
    u = mesh.points @ gradient.T
    supports = tuple(Support(np.array([n]), i, u[n, i]) for n in outer for i in range(3))
    problem = untouched(mesh, TISSUE, supports=supports, fibres=ASKEW)
    result = solve(problem, StepControl(load_steps=3, tolerance=1e-10), store="all")
    assert result.completed, result.reason
    np.testing.assert_allclose(result.states[-1].u, u, atol=1e-8)


def test_every_parameter_of_fibred_tissue_has_its_sensitivity():
    """Under a punch, which shortens tissue along its axis and stretches it across."""
    changes = {"materials": {"skin": GROUND, "muscle": TISSUE}, "fibres": (1.0, 0.2, 0.0)}
    problem = punch("hex8", 2, 1, 4.0, **changes)
    control = StepControl(load_steps=3, unload_steps=2, tolerance=1e-10)
    centre = check_sensitivities(
        problem, control, 1e-3, *(("muscle", name) for name in TISSUE.parameter_names)
    )
    plain = solve(replace(problem, materials={"skin": GROUND, "muscle": GROUND}), control).force
    assert centre.peak_force > 1.02 * plain.max()


@pytest.mark.parametrize(
    ("fibres", "what"),
    [
        (None, "the fibres of 'muscle' have no direction"),
        ((1.0, 0.0), r"fibres have shape \(2,\)"),
        ((0.0, 0.0, 0.0), "zero or not finite"),
        ((np.nan, 0.0, 1.0), "zero or not finite"),
    ],
)
def test_impossible_directions_are_refused(fibres, what):
    with pytest.raises(ProblemError, match=what):
        body(fibres=fibres)


def test_impossible_fibres_are_refused():
    with pytest.raises(ProblemError, match=r"k1 = -1\.0 is negative"):
        FibredMaterial(GROUND, -1.0, 3.0)
    with pytest.raises(ProblemError, match=r"k2 = 0\.0 is not positive"):
        FibredMaterial(GROUND, 0.01, 0.0)
