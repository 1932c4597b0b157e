"""Records with a creeping hold and with two cycles, from the file to residuals and report."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from seen_blocks import TRUTH

from layered import blocks_study, store_blocks
from limbfit import check_study, load_study
from limbfit.execution import SerialExecutor
from limbfit.indentation import SimulationJob, simulate
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.records.records import estimate_site_noise, load_site_record
from limbfit.pipeline.simulation.simulations import CURVE_POINTS
from limbfit.report.page import Table
from limbfit.report.sections.inputs import draw_record_figure, make_record_section
from limbfit.report.store import load_store

PROTOCOLS = {
    "held": (
        (0.0, 2.5, 32.5, 35.0),
        (0.0, 3.0, 3.006, 0.0),
        "load at 1.2 mm/s, hold for 30 s, unload at 1.2 mm/s",
    ),
    "cycles": (
        (0.0, 2.5, 5.0, 7.5, 10.0),
        (0.0, 3.0, 0.0, 3.0, 0.0),
        "2 cycles of load at 1.2 mm/s, unload at 1.2 mm/s",
    ),
}
TEXT = """
[study]
name = "blocks"
[surfaces]
skin = "skin.stl"
[indenter]
edge_radius_mm = 2.0
[solver]
load_steps = 5
unload_steps = 8
penalty_per_mm = 100.0
"""


def write_record(file: Path, knots_s, knots_mm, force, slack_mm=0.36, slack_s=0.3, step_s=0.004) -> None:
    """What a robot writes down: slack before and after, noise of both sensors; ``force`` of the time."""
    times = np.arange(0.0, knots_s[-1] + 2 * slack_s, step_s)
    ends = np.r_[0.0, slack_s + np.array(knots_s), knots_s[-1] + 2 * slack_s]
    moved = np.interp(times, ends, np.r_[0.0, slack_mm + np.array(knots_mm), 0.0])
    pushed = np.where((times > slack_s) & (times < ends[-2]), force(times - slack_s), 0.0)
    random = np.random.default_rng(3)
    columns = (
        times,
        moved + 0.003 * random.standard_normal(times.size),
        pushed + 0.01 * random.standard_normal(times.size),
    )
    np.savetxt(
        file,
        np.column_stack(columns),
        delimiter=",",
        header="time_s,displacement_mm,force_N",
        comments="",
    )


@pytest.mark.parametrize("name", ["cycles", pytest.param("held", marks=pytest.mark.slow)])
def test_a_protocol_goes_from_its_record_to_residuals_and_report(tmp_path, name):
    knots_s, knots_mm, words = PROTOCOLS[name]
    study = blocks_study(tmp_path, TEXT, {name: True})
    truth = tuple(study.vector(TRUTH))

    def write(study, model, *given) -> None:
        model = replace(model, knots_s=knots_s, knots_mm=knots_mm)
        times = model.curve_times(400)
        found = simulate(SimulationJob(model, study.tissues, truth, tuple(times), False))
        assert found.completed
        write_record(
            study.path(Path(f"{name}.csv")), knots_s, knots_mm, lambda t: np.interp(t, times, found.force_N)
        )

    store = store_blocks(study, {name: ((3.0, 11.0), 3.0, True)}, TRUTH, 4, write=write)
    context = Context(study, store, SerialExecutor(), lambda event: None)
    facts = store.results.traces.to_plain()["sites"][name]
    assert facts["phases_in_words"] == words
    assert facts["phases"][0]["kind"] == "approach"
    assert facts["peak_s"] == pytest.approx(0.3 + knots_s[1], abs=0.02)

    record = load_site_record(context, study.indentation(name))
    assert len(record.times_s) <= 1.4 * CURVE_POINTS  # a hold has its own
    response = record.respond(simulate(record.job(np.array(truth))))
    error = response.force_N - record.force_N
    peak = record.force_N.max()
    assert np.sqrt(np.mean(error**2)) < 0.01 * peak
    assert np.abs(error).max() < 0.04 * peak
    noise = estimate_site_noise(study, record, response.force_N)
    assert np.isfinite(np.linalg.cholesky(noise.covariance)).all()
    assert np.sqrt(np.diag(noise.covariance)).max() < 0.05 * peak

    stored = load_store(study.results)
    figure = draw_record_figure(stored, name)
    assert figure is not None
    (table,) = (block for block in make_record_section(stored).blocks if isinstance(block, Table))
    assert f"the indenter's phases are {words}" in figure.caption
    assert words in [cell.text for cell in table.rows[0].cells]


def test_check_tells_the_phases_of_a_record(study, commands_unasked):
    file = study / "study.toml"
    file.write_text(file.read_text() + "[traces]\nsmoothing = 0.1\n")
    times = {"1": PROTOCOLS["held"], "2": PROTOCOLS["cycles"]}
    for name, (knots_s, knots_mm, _) in times.items():
        depth = lambda t, s=knots_s, mm=knots_mm: np.interp(t, s, mm)  # noqa: E731
        force = lambda t, d=depth: 0.6 * d(t) ** 1.3  # noqa: E731
        write_record(study / f"{name}.csv", knots_s, knots_mm, force, step_s=0.02)
    facts = check_study(load_study(study), listener=lambda event: None)["facts"]
    for name, (_, _, words) in times.items():
        assert any(fact.startswith(f"site {name}: peak force") and fact.endswith(words) for fact in facts)
