"""What is expected of a site's stiffness: by its tissue's thickness, and how well surfaces are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from scipy.signal import lfilter

from layered import block_context, block_study
from limbfit.identify.fit.objective import SiteResponse
from limbfit.identify.fit.prediction import PredictionModel
from limbfit.indentation import Simulation
from limbfit.mesh import read_vtu, write_vtu
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.identification.predict import SitePrediction, _write_observed
from limbfit.pipeline.records.records import (
    GIVEN_MM,
    LEAST_SHARE,
    OF_A_VOXEL,
    SiteRecord,
    compute_expected_share,
    compute_thickness_slope,
    estimate_site_deviation,
    estimate_site_noise,
    estimate_surface_error_mm,
    load_site_record,
    measure_bone_distance_mm,
)
from limbfit.pipeline.records.secondary_measurements import WaveMeasurement
from limbfit.pipeline.records.traces import read_record
from limbfit.results.base import read_curves
from limbfit.study.tables import ImageTable

TRUTH = {"skin": {"c_kPa": 8.0, "m": 5.0, "gamma": 2.0, "tau_s": 0.5}}
TRUTH["muscle"] = TRUTH["skin"] | {"c_kPa": 4.0}


def context(folder: Path, more: str = "") -> Context:
    return block_context(block_study(folder, "", more), TRUTH)


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> Context:
    """The block with its record, which the tests leave as it is."""
    return context(tmp_path_factory.mktemp("block"))


def over_bone(context: Context) -> SiteRecord:
    """The block of 18 mm, whose bottom is bone."""
    record = load_site_record(context, context.study.recorded[0])
    mesh = read_vtu(record.model.mesh)
    bone = {"fixed_bone": mesh.node_sets["fixed_bottom"]}
    file = record.model.mesh.with_name("bone.vtu")
    write_vtu(replace(mesh, node_sets=bone), file)
    return replace(record, model=replace(record.model, mesh=file))


def test_thin_tissue_is_stiffer_by_its_thickness() -> None:
    """Hayes's table between a / h = 0.8 and 1.0; a thin layer goes with the cube, a thick one is none."""
    assert compute_thickness_slope(0.9, 1.0) == pytest.approx(
        np.log(3.609 / 2.855) / np.log(1.0 / 0.8), rel=0.1
    )
    assert compute_thickness_slope(10.0, 1.0) == pytest.approx(3.0)
    assert compute_thickness_slope(0.01, 1.0) < 0.03


def test_a_site_is_off_by_its_surfaces_and_a_little_more(found: Context) -> None:
    radius = 20.0 / np.sqrt(np.pi)
    share = compute_expected_share(over_bone(found).model, 0.5)
    assert share == pytest.approx(
        np.hypot(LEAST_SHARE, compute_thickness_slope(radius, 18.0) * 0.5 / 18.0), rel=0.02
    )
    assert compute_expected_share(load_site_record(found, found.study.recorded[0]).model, 0.5) == LEAST_SHARE


def test_where_surfaces_are_known_from(found: Context, tmp_path: Path) -> None:
    """Of files, whatever an earlier image has left, of an image by its voxels, or as stated."""
    assert estimate_surface_error_mm(found.study, found.store) == GIVEN_MM
    labels = sitk.Image(4, 4, 4, sitk.sitkUInt8)
    labels.SetSpacing((1.0, 1.0, 8.0))
    found.store["segment"].mkdir(parents=True)
    sitk.WriteImage(labels, str(found.store["segment"] / "labels.seg.nrrd"))
    assert estimate_surface_error_mm(found.study, found.store) == GIVEN_MM
    imaged = found.study.model_copy(update={"image": ImageTable(path=Path("mri"))})
    assert estimate_surface_error_mm(imaged, found.store) == pytest.approx(2.0 * OF_A_VOXEL)
    stated = block_study(tmp_path, "", "[calibration]\nsurface_error_mm = 0.1\n")
    assert estimate_surface_error_mm(stated, found.store) == 0.1


def test_a_stiffer_site_moves_its_force_along_all_moduli(found: Context) -> None:
    """Derivatives by both c times c, as much of it as is expected; exponents and times have no part."""
    record = over_bone(found)
    parameters = found.study.vector(TRUTH)
    moduli = [i for i, (_, name) in enumerate(found.study.parameters) if name == "c_kPa"]
    jacobian = np.zeros((5, len(parameters)))
    jacobian[:, moduli] = np.linspace(0, 1, 5)[:, None]
    jacobian[:, moduli[0] + 1] = 7.0
    off = estimate_site_deviation(found.study, record, SiteResponse(np.ones(5), jacobian), parameters)
    assert off == pytest.approx(12.0 * np.linspace(0, 1, 5) * compute_expected_share(record.model, GIVEN_MM))


def test_thinner_tissue_under_an_indenter_has_faster_waves(found: Context) -> None:
    """By the share of its strain, and not at rest, where its own stiffness alone may differ."""
    record, parameters = over_bone(found), found.study.vector(TRUTH)
    speeds = np.array([4.0, 4.0, 4.5, 6.0])
    at = np.eye(4, len(record.times_s))
    seen = WaveMeasurement(
        "w", speeds, np.array([0.0, 0.0, 1.0, 2.0]), np.zeros(4, int), at, np.eye(4), {"sd": 0.1}
    )
    jacobian = np.zeros((4, len(parameters)))
    jacobian[:, 0] = 0.5 * speeds / parameters[0]
    off = estimate_site_deviation(
        found.study, replace(record, seen=seen), SiteResponse(speeds, jacobian), parameters
    )
    thickness = measure_bone_distance_mm(record.model)
    assert thickness is not None
    assert off == pytest.approx(0.5 * LEAST_SHARE * speeds + (speeds - 4.0) * GIVEN_MM / thickness)


@pytest.mark.parametrize("lag", [pytest.param(0.0, marks=pytest.mark.slow), 0.98])
def test_slow_noise_of_a_record_is_not_taken_for_the_force(tmp_path: Path, lag: float) -> None:
    """At 0.98 the smoothing removes a fifth of it only."""
    found = context(tmp_path)
    record = load_site_record(found, found.study.recorded[0])
    file = found.study.path(record.record.trace)
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    _, smooth, facts = read_record(found.study, record.record)
    since = table[:, 0] - facts.touch_down_s
    force = np.interp(since, smooth.time_s, smooth.force_N, right=0.0)
    sd, stated = 0.005 * smooth.peak_force_N, []
    for seed in range(2):
        new = np.random.default_rng(seed).standard_normal(len(table) + 1000)
        noise = lfilter([np.sqrt(1 - lag**2)], [1.0, -lag], new)[1000:]
        rows = np.stack([*table.T[:2], force + sd * noise], axis=1)
        np.savetxt(file, rows, delimiter=",", header=file.read_text().splitlines()[0], comments="")
        stated.append(estimate_site_noise(found.study, record, record.force_N).sd_N)
    assert np.mean(stated) == pytest.approx(sd, rel=0.2 if lag else 0.03)


def test_what_is_seen_at_a_held_out_site_is_off_as_the_site_is(found: Context, tmp_path: Path) -> None:
    """Speeds of waves: beside what noise and parameters leave open, by the thickness of the tissue."""
    record, parameters = over_bone(found), found.study.vector(TRUTH)
    speeds, times = np.array([4.0, 5.0, 6.0]), record.times_s[:3]
    at = np.eye(3, len(record.times_s))
    seen = WaveMeasurement(
        "w", speeds, times, np.zeros(3, int), at, 0.01 * np.eye(3), {"sd": 0.1, "compared": ""}
    )
    known = PredictionModel(0.0 * np.eye(len(parameters)), parameters, {}, 0.01, 100.0)
    n = len(record.times_s)
    observed = np.r_[speeds, np.zeros(n - 3)][None]
    slopes = np.zeros((1, n, len(parameters)))
    own = Simulation("a", np.ones(n), slopes[0], True, "", 0.0, {}, (), observed, slopes)
    widths = []
    for fitted in (True, False):
        site = record.site.model_copy(update={"fitted": fitted})
        one = replace(record, record=record.record.model_copy(update={"site": site}), secondary=(seen,))
        _write_observed(
            tmp_path, found.study, SitePrediction(one, None, own, None, None, None), parameters, known
        )
        curves = read_curves(tmp_path / f"{one.name}+w.csv")
        widths.append(curves["speed_high_m_s"] - curves["speed_low_m_s"])
    thickness = measure_bone_distance_mm(record.model)
    assert widths[0].min() > 0.2 * 1.96  # the readings' own noise, as no fitted record has a speed
    assert widths[1][0] == pytest.approx(widths[0][0])  # at rest
    off = (speeds - 4.0) * GIVEN_MM / thickness
    assert np.all(widths[1][1:] > 2 * 1.96 * np.hypot(off, 0.01 * 6.0)[1:])
    assert np.all(widths[0][1:] < widths[1][1:])
