"""Displacement of the skin around the indenter: from the file to the prediction."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import interp1d
from seen_blocks import Made, SeenBlock, check_truth_within, estimate_at_truth

from limbfit.errors import TraceError
from limbfit.indentation import (
    Simulation,
    SiteModel,
    choose_points_around,
    read_indenter,
)
from limbfit.mesh import Mesh
from limbfit.phantom.robot import write_surface
from limbfit.pipeline.records.secondary_measurements import MAX_POINTS, ChosenPoints, choose_points
from limbfit.pipeline.records.traces import run_traces
from limbfit.report.drawing.figures import draw_seen_figures
from limbfit.report.sections.identification import make_observed_table
from limbfit.report.store import load_store
from limbfit.study import Study
from limbfit.traces import SurfaceMotion

TOOLS = """
[indenter]
shape = "sphere"
width_mm = 12.0
[solver]
load_steps = 6
unload_steps = 5
penalty_per_mm = 200.0
"""
SEEN = 'surface = "a-surface.csv"\n'
FRAME = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # edge, across it, axis


def with_points(model: SiteModel, mesh: Mesh) -> SiteModel:
    points = choose_points_around(mesh, read_indenter(model.indenter, model.position, model.axis, None))
    return replace(model, skin_points=tuple(map(tuple, points)))


def write_seen(study: Study, model: SiteModel, found: Simulation, made: Made) -> None:
    whole, times, random = made
    points, axes = np.array(model.skin_points), np.eye(3)
    if study.recorded[0].surface_frame == "site":
        axes = FRAME
    moves = interp1d(times, found.observed.reshape(len(points), 3, -1))
    write_surface(
        study.path(Path("a-surface.csv")),
        whole,
        points @ axes.T,
        lambda t: np.einsum("ij,kjn->kin", axes, moves(np.minimum(t, times[-1]))),
        random,
    )


BLOCK = SeenBlock("a-surface.csv", with_points, write_seen, (3.0, 12.0), 24.0, 4.0, 6, TOOLS)


@pytest.mark.slow
def test_what_cameras_see_is_fitted_and_predicted(tmp_path: Path) -> None:
    """Beside one ramp: nothing is off at the truth, and every interval is narrower than by force alone.

    The skin's modulus is determined, which it is not by force; the true values lie within the intervals of
    the calibration.
    """
    known = BLOCK.narrowed(tmp_path, SEEN)
    assert [one.name for one in known.records.own] == ["a", "a+surface"]
    assert [one.unit for one in known.records.curves] == ["N", "mm"]
    assert len(known.records.own[1].compared) > 300
    assert known.misfits == pytest.approx([1.0], abs=0.25)
    by_force, by_both = np.exp(known.by_force / 2.0), np.exp(known.by_both / 2.0)
    assert by_force[0] > 2.0  # force alone: 2.6 for the skin's modulus, 1.7 for the muscle's
    assert by_both[0] < 1.5  # 1.45
    assert by_both[4] < 1.2  # 1.09
    found, (surface,) = known.fit_and_predict()
    assert list(found["contact"]) == ["a"]
    assert found["uncertainty"]["residuals"]["sites"]["a+surface"]["unit"] == "mm"
    check_truth_within(found["uncertainty"]["intervals_95"])
    assert (surface["kind"], surface["left_out"]) == ("surface", {})
    assert surface["compared"].startswith("24 points, ")
    assert surface["error_percent"] < 10.0
    results = load_store(known.context.study.results)
    figure, shown = draw_seen_figures(results, fitted=True)[2], make_observed_table(results)
    assert figure is not None
    assert "a: " in figure.markup
    assert shown is not None
    assert shown.rows[0].cells[1].text == "surface"


@pytest.mark.slow
def test_one_component_in_the_frame_of_the_indenter(tmp_path: Path) -> None:
    """The same points and the same moves, along the axis alone."""
    context = BLOCK.stored(tmp_path, SEEN + 'surface_frame = "site"\nedge = [0.0, 1.0, 0.0]\n')
    file = context.study.path(Path("a-surface.csv"))
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    np.savetxt(
        file, rows[:, [0, 1, 2, 3, 6]], delimiter=",", header="time_s,x_mm,y_mm,z_mm,uz_mm", comments=""
    )
    run_traces(context, context.store["traces"])
    records, at, _ = estimate_at_truth(context)
    seen = records.own[1]
    assert set(seen.seen.components.tolist()) == {2}
    assert seen.compared.max() > 0.2  # into the limb
    off = at.responses[1].force_N - seen.compared
    assert np.sqrt(np.mean(off**2)) < 1.3 * seen.seen.noise_sd


PLACE = ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))


def chosen(study: Study, points: np.ndarray | list) -> ChosenPoints:
    """Of points that all go down, on the block's top."""
    mesh = BLOCK.mesh()
    moved = np.tile([0.0, 0.0, -1.0], (1, len(points), 1))
    motion = SurfaceMotion(np.asarray(points, dtype=float), np.array([1.0]), moved)
    skin = mesh.points, mesh.face_sets["skin"]
    return choose_points(study, study.recorded[0], PLACE, skin, motion)


def test_points_that_are_not_compared_are_counted(tmp_path: Path) -> None:
    found = chosen(
        BLOCK.study(tmp_path, SEEN),
        [[8, 0, 0.4], [0, 20, 0], [3, 0, 0], [0, -9, 6], [41, 0, 0], [30.5, 0, 0]],
    )
    assert found.which.tolist() == [0, 1]
    assert found.points[0] == pytest.approx((8.0, 0.0, 0.0))
    assert found.left_out == {
        "farther than 40 mm from the site": 1,
        "more than 5 mm off the skin": 2,
        "under the indenter": 1,
    }
    assert found.words.startswith(
        "2 points compared, 1 farther than 40 mm from the site, 2 more than 5 mm off"
    )


def test_many_points_are_thinned_evenly(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(-20.0, 20.1, 2.0), np.arange(-20.0, 20.1, 2.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    found = chosen(BLOCK.study(tmp_path, SEEN), points)
    assert len(found.which) == MAX_POINTS
    assert found.left_out["thinned out, to 30"] == x.size - MAX_POINTS - found.left_out["under the indenter"]
    kept = np.array(found.points)
    apart = np.linalg.norm(kept[:, None] - kept, axis=2) + 99.0 * np.eye(len(kept))
    assert apart.min() > 4.0


@pytest.mark.parametrize(
    ("frame", "points", "told"),
    [
        (
            "limb",
            [[500.0, 0, 0], [510.0, 0, 0]],
            "no point lies within 40 mm of site a: the nearest is 500 mm",
        ),
        ("limb", [[3.0, 0, 0], [0, 0, 1.0]], "no point can be compared: 2 under the indenter"),
        ("limb", [[8.0, 0, 9.0]], 'off the skin; give LPS millimetres .*, or surface_frame = "site"'),
        ("site", [[8.0, 0, 9.0]], 'off the skin; give millimetres from the site, or surface_frame = "limb"'),
    ],
)
def test_a_surface_elsewhere_is_refused(tmp_path: Path, frame: str, points: list, told: str) -> None:
    more = SEEN + f'surface_frame = "{frame}"\n' * (frame == "site")
    with pytest.raises(TraceError, match=told) as caught:
        chosen(BLOCK.study(tmp_path, more), np.array(points))
    assert caught.value.file == tmp_path / "a-surface.csv"
