"""The verdict on a fit: silent where the model is right, and plain where it cannot follow."""

from dataclasses import replace

import numpy as np
import pytest

from limbfit.identify.checks.fit_quality import assess_fit, refit_residuals, summarise_fit
from limbfit.identify.uncertainty.discrepancy import (
    ResidualModel,
    compute_matern,
    compute_mesh_covariance,
    estimate_mesh_misfit,
)
from limbfit.identify.uncertainty.noise import SiteNoise
from limbfit.results.identification import RecordFit

TIMES = np.linspace(0.0, 12.0, 81)
DEPTH = np.interp(TIMES, [0.0, 4.0, 8.0, 12.0], [0.0, 4.0, 4.0, 0.0])
FORCE = DEPTH**1.5
SD, PEAK = 0.02, 8.0
# White noise, and a site as a whole that may be 1 % stiffer.
COVARIANCE = SD**2 * np.eye(81) + 1e-4 * np.outer(FORCE, FORCE)
RIPPLES = compute_matern(TIMES, 0.07)
SHAPE = np.stack([FORCE, DEPTH, DEPTH**2], axis=1)  # what three parameters would add, per logarithm


def assess(residual: np.ndarray, fitted: bool = True, inside: np.ndarray | None = None) -> RecordFit:
    return assess_fit("05", fitted, TIMES, DEPTH, residual, PEAK, COVARIANCE, inside)


def draw_noise(seed: int) -> np.ndarray:
    # By Cholesky: the default's singular vectors, and with them the draws, differ from machine to machine.
    return np.random.default_rng(seed).multivariate_normal(np.zeros(81), COVARIANCE, method="cholesky")


def test_a_model_that_is_right_is_not_accused() -> None:
    found = [assess(draw_noise(seed)) for seed in range(300)]
    assert not any(one.verdict for one in found)
    assert np.mean([one.times_noise for one in found]) == pytest.approx(1.0, abs=0.02)
    assert np.mean([one.ljung_box_p < 0.05 for one in found]) == pytest.approx(0.05, abs=0.035)
    assert summarise_fit(found[:4]).startswith("the model follows every fitted record")


def test_an_unloading_that_the_model_cannot_follow_is_named() -> None:
    bump = 0.48 * np.clip(np.sin(np.pi * (TIMES - 8.0) / 4.0), 0.0, None) * (TIMES > 8.0)
    found = assess(draw_noise(1) + bump)
    unload = found.phases[-1]
    assert [phase.phase for phase in found.phases] == ["loading", "hold", "unloading"]
    assert unload.error_percent == pytest.approx(100 * 0.48 / np.sqrt(2) / PEAK, rel=0.15)
    assert 8 < unload.times_noise < 0.48 / SD  # part of it might be a stiffer site
    assert max(phase.times_noise for phase in found.phases[:2]) < 1.5
    assert found.verdict.startswith("the model cannot follow the unloading at 05: 4.")
    assert "of the largest force" in found.verdict
    crept = assess_fit(
        "05", True, TIMES, DEPTH, draw_noise(1) + bump, PEAK, COVARIANCE, compared="displacement"
    )
    assert crept.verdict == found.verdict.replace("force", "displacement")
    others = [assess(draw_noise(seed)) for seed in (2, 3)]
    assert summarise_fit([*others, found]) == found.verdict


def test_an_error_of_no_size_or_of_no_memory_is_not_said() -> None:
    """A tenth of a percent is nothing, however well seen; noise that is larger than stated is no model."""
    small = assess_fit("05", True, TIMES, DEPTH, 0.008 * np.sin(TIMES), PEAK, 1e-6 * np.eye(81))
    assert small.times_noise > 3
    assert not small.verdict
    loud = assess(5 * SD * np.random.default_rng(4).standard_normal(81))
    assert loud.times_noise > 3
    assert not loud.verdict


def test_other_parameters_are_tried_before_the_model_is_blamed() -> None:
    """Two records share the parameters; what these explain goes, what is a record's own stays."""
    step = np.array([0.1, -0.25, 0.05])
    shared = [draw_noise(1) + SHAPE @ step, draw_noise(2) + 2 * SHAPE @ step]
    own = [shared[0], shared[1] + 0.3 * np.sin(TIMES) * (TIMES > 8.0)]
    shapes, covariances = [SHAPE, 2 * SHAPE], [COVARIANCE, COVARIANCE]

    def judge(residual: np.ndarray, refitted: np.ndarray) -> RecordFit:
        return assess_fit("06", True, TIMES, DEPTH, residual, PEAK, COVARIANCE, None, refitted)

    right = [judge(*pair) for pair in zip(shared, refit_residuals(shared, shapes, covariances), strict=True)]
    wrong = [judge(*pair) for pair in zip(own, refit_residuals(own, shapes, covariances), strict=True)]
    assert assess(shared[0]).times_noise > 3
    assert max(one.times_noise for one in right) < 1.3
    assert right[0].phases[0].error_percent == assess(shared[0]).phases[0].error_percent
    assert not any(one.verdict for one in right)
    assert wrong[1].verdict.startswith("the model cannot follow the unloading at 06")


def test_nothing_is_refitted_where_no_fitted_record_could_be_simulated() -> None:
    assert refit_residuals([], [], []) == []


def test_a_held_out_record_is_judged_by_its_band() -> None:
    drift = compute_matern(TIMES, 0.3)[0] * 0.8
    off = assess(draw_noise(5) + drift, fitted=False, inside=np.arange(81) < 20)
    assert off.inside_95 == pytest.approx(20 / 81)
    assert off.verdict.startswith("05 is not predicted: 25 % of its points lie in the 95 % band")
    assert not assess(draw_noise(5) + drift, fitted=False, inside=np.ones(81, dtype=bool)).verdict
    fitted = assess(draw_noise(1))
    assert summarise_fit([fitted, off]).endswith("1 of 1 held-out records lie mostly outside their 95 % band")


def test_a_record_on_another_mesh_is_no_fault_of_the_model() -> None:
    """The force rises and falls as the footprint grows over the elements, on another mesh at other depths.

    How much of that there is follows from the difference of two meshes, which has other ripples.
    """
    quiet = (SD / 4) ** 2 * np.eye(81) + 1e-4 * np.outer(FORCE, FORCE)
    noise = (SiteNoise("05", TIMES, quiet, SD / 4, 0.0),) * 4
    model = ResidualModel(noise, np.full(4, PEAK), np.zeros(4), 1.0, 0.0)

    def make_error(seed: int) -> np.ndarray:
        random = np.random.default_rng(seed)
        ripple = random.multivariate_normal(np.zeros(81), RIPPLES, method="cholesky") * (DEPTH > 0)
        return 0.02 * FORCE * random.standard_normal() + 0.004 * PEAK * ripple

    def judge(covariances: list[np.ndarray], wrong: np.ndarray | float = 0.0) -> list[RecordFit]:
        noise = np.random.default_rng(draw).multivariate_normal(np.zeros(81), quiet, 4, method="cholesky")
        residuals = [one + make_error(100 + 10 * draw + i) + wrong for i, one in enumerate(noise)]
        left = refit_residuals(residuals, [SHAPE] * 4, covariances)
        triples = zip(residuals, covariances, left, strict=True)
        return [assess_fit("05", True, TIMES, DEPTH, r, PEAK, C, None, after) for r, C, after in triples]

    late = 0.05 * PEAK * np.clip(np.sin(np.pi * (TIMES - 8.0) / 2.0), 0.0, None) * (TIMES > 8.0)
    shares, most = [], []
    for draw in range(8):
        meshes = [make_error(1000 * draw + i) for i in range(4)]
        found = estimate_mesh_misfit(replace(model, mesh_N=meshes), [SHAPE] * 4, np.eye(3))
        assert found is not None
        assert found.correlation <= 0.12
        without = [quiet + np.outer(mesh, mesh) for mesh in meshes]
        counted = [one + compute_mesh_covariance(found, TIMES, PEAK) for one in without]
        assert any(one.verdict for one in judge(without))
        assert not any(one.verdict for one in judge(counted))
        assert any("the unloading" in one.verdict for one in judge(counted, late))
        shares.append(found.share)
        most.append(max(one.times_noise for one in judge(counted)))
    assert 0.003 < np.mean(shares) < 0.006
    assert np.mean(most) < 1.3
    quiet_mesh = replace(model, mesh_N=[0.0 * FORCE] * 4)
    assert estimate_mesh_misfit(quiet_mesh, [SHAPE] * 4, np.eye(3)) is None
