"""Several records of a site: how a study states them, and that what is chosen is chosen by site."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from completing import complete
from limbfit.errors import StudyError, TraceError
from limbfit.identify.checks.crossvalidation import Fold, average_by_site, expand_to_records, list_choices
from limbfit.identify.checks.outliers import LeaveOutFits, list_pairs
from limbfit.identify.checks.plausibility import RecordFacts, check_plausibility
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.prediction import PredictionModel
from limbfit.identify.uncertainty.noise import estimate_record_noise
from limbfit.identify.uncertainty.uncertainty import FitSensitivity
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.limb.mesh import mesh_job, mesh_settings
from limbfit.pipeline.records.traces import read_record
from limbfit.report.sections.identification import make_site_table
from limbfit.report.store import load_store
from limbfit.results.identification import PredictResult, RecordResiduals
from limbfit.study import Record, Study, load_study

STUDY = """
[study]
name = "records"
[surfaces]
skin = "skin.stl"
[indenters.ball]
shape = "sphere"
width_mm = 30.0
[[sites]]
name = "1"
fitted = true
weight = 3.0
trace = "a.csv"
position = [0.0, -50.0, 10.0]
[[sites]]
name = "2"
position = [0.0, 50.0, 10.0]
[[sites]]
name = "3"
depth_mm = 5.0
position = [50.0, 0.0, 10.0]
[[records]]
site = "1"
name = "fast"
trace = "b.csv"
peak_s = 4.0
[[records]]
site = "2"
name = "slow"
trace = "c.csv"
[[records]]
site = "1"
name = "ball"
trace = "d.csv"
indenter = "ball"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("skin.stl", "a.csv", "b.csv", "c.csv", "d.csv"):
        (tmp_path / name).write_text(name)
    return tmp_path


def read(folder: Path, text: str = STUDY) -> Study:
    (folder / "study.toml").write_text(text)
    return load_study(folder)


def test_records_of_a_study(folder: Path) -> None:
    study = read(folder)
    assert [one.name for one in study.indentations] == ["1", "1-fast", "1-ball", "2-slow", "3"]
    assert [record.name for record in study.records_at(*study.fitted)] == ["1", "1-fast", "1-ball"]
    assert [record.weight for record in study.recorded] == [1.0, 1.0, 1.0, 1.0]
    fast = study.indentation("1-fast")
    assert isinstance(fast, Record)
    assert (fast.site.name, fast.trace, fast.peak_s, fast.fitted) == ("1", Path("b.csv"), 4.0, True)
    assert study.indentation("2").name == "2-slow"
    assert study.indentation("3") is study.sites[2]
    assert study.indentation("1").trace == Path("a.csv")
    assert study.indenter_of(study.indentation("1-ball")).shape == "sphere"
    assert [study.width_at(site) for site in study.sites] == [30.0, 20.0, 20.0]
    assert study.inputs["records.1-fast.trace"] == Path("b.csv")


WRONG = {
    "unknown site": ('site = "2"', 'site = "4"', "records.slow: no site is named '4'"),
    "one name twice": ('name = "ball"', 'name = "fast"', "two records, .* have the name '1-fast'"),
    "the name of a site": ('name = "3"', 'name = "1-fast"', "a record and a site, have the name '1-fast'"),
    "a name of limbfit": ('name = "slow"', 'name = "raw"', "give another name"),
    "unknown indenter": ('indenter = "ball"', 'indenter = "bal"', "1-ball: no indenter is named 'bal'"),
    "neither": ("depth_mm = 5.0\n", "", r"sites\.3: give either trace .* \[\[records\]\]\) or depth_mm"),
    "plan and record": ('site = "2"', 'site = "3"', r"sites\.2: give either trace"),
    "a missing file": ('"d.csv"', '"e.csv"', r"records\.1-ball\.trace: e\.csv does not exist"),
    "no force": ('indenter = "ball"', 'control = "strength"', "records.1-ball.control: Input should be"),
    "paper": (
        'indenter = "ball"',
        'control = "force"\n[calibration]\nobjective = "paper"',
        '1-ball: control = "force" is no force',
    ),
    "times": ("peak_s = 4.0", "peak_s = 4.0\ntouch_down_s = 5.0", "touch_down_s must come before peak_s"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "told"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_told_in_one_line(folder: Path, old: str, new: str, told: str) -> None:
    assert old in STUDY
    with pytest.raises(StudyError, match=told) as caught:
        read(folder, STUDY.replace(old, new))
    assert "\n" not in str(caught.value)


def test_an_indenter_that_no_record_names_is_told(folder: Path) -> None:
    assert read(folder).notes == ()
    (note,) = read(folder, STUDY + "[indenters.tip]\nwidth_mm = 10.0\n").notes
    assert note == "indenters.tip: no record names it; only limbfit design --protocol does"


def test_a_site_with_several_records_does_not_stand_for_one(folder: Path) -> None:
    study = read(folder, STUDY.replace('trace = "a.csv"\n', ""))
    with pytest.raises(StudyError, match="several records; name one of 1-fast, 1-ball"):
        study.indentation("1")


def test_records_held_out_do_not_touch_the_calibration(folder: Path) -> None:
    before = compute_keys(read(folder))
    more = '[[records]]\nsite = "{}"\nname = "more"\ntrace = "c.csv"\n'
    held, fitted = (compute_keys(read(folder, STUDY + more.format(site))) for site in ("2", "1"))
    assert held["traces"] != before["traces"]
    assert held["calibrate"] == before["calibrate"] != fitted["calibrate"]
    assert held["mesh"] != before["mesh"]  # another indenter may be wider


def test_a_mesh_is_fine_under_the_widest_indenter_of_its_site(folder: Path) -> None:
    study = read(folder)
    context = Context(study, Store(study.results), None, lambda event: None)  # type: ignore[arg-type]
    context.store.make("surfaces", "key", lambda place: {})
    jobs = [mesh_job(context, name, [0.0] * 3, [0.0] * 3, mesh_settings(study), folder) for name in "12"]
    assert [job.settings.near_radius_mm for job in jobs] == [14.0 + 5.0, 14.0]


def test_cross_validation_chooses_sites_with_all_their_records() -> None:
    groups = [(0, 1, 2), (3,), (4, 5)]
    chosen = [expand_to_records(choice, groups) for choice in list_choices(3, 2)]
    assert chosen == [(0, 1, 2, 3), (0, 1, 2, 4, 5), (3, 4, 5)]
    fold = Fold((0, 1, 2, 3), np.ones(2), (1.0, 2.0, 3.0, 5.0, 4.0, 8.0), True, ())
    found = average_by_site(fold, (0, 1), groups)
    assert found.errors_percent == (2.0, 5.0, 6.0)
    assert (found.heldout, found.mean_heldout) == ((2,), 6.0)


def test_a_record_is_left_out_with_its_site() -> None:
    """The twin of a wrong record would pull the fit to it."""
    slopes = np.linspace(0.1, 1.0, 20)[:, None] * np.array([[1.0, 0.0]])

    def simulate(p: np.ndarray) -> list[SiteResponse]:
        return [SiteResponse(slopes @ p, slopes) for _ in range(5)]

    true, wrong = np.array([1.0, 1.0]), np.array([2.0, 1.0])
    measured = [MeasuredCurve(name, slopes @ true) for name in ("a", "b", "c")]
    twins = [MeasuredCurve(name, slopes @ wrong, 0.5, "d") for name in ("d", "d-fast")]
    alone = [replace(one, site="") for one in twins]
    together, apart = (LeaveOutFits(simulate, [*measured, *some], true) for some in (twins, alone))
    assert together.fit_without(3) == pytest.approx(true, rel=1e-6)
    assert together.fit_without(3) is together.fit_without(4)
    assert apart.fit_without(3)[0] > 1.02


def test_what_is_a_site_s_own_moves_its_records_together() -> None:
    gain = FitSensitivity(tuple(np.array([[value]]) for value in (1.0, 2.0, 3.0)))
    change = [np.ones(1)] * 3
    assert gain.compute_covariance(change, False) == pytest.approx(1 + 4 + 9)
    assert gain.compute_covariance(change, False, ("1", "1", "2")) == pytest.approx((1 + 2) ** 2 + 9)


def test_records_of_one_site_may_differ() -> None:
    """Another speed or indenter is another stiffness; one wrong axis is told of once."""
    one = RecordFacts("1", 5.0, 5.0, 1.0, 0.01, 11.0, 20.0, 40.0, position_mm=(0.0, 0.0, 0.0), site="1")
    facts = [one, replace(one, record="1-fast", peak_N=8.0)]
    assert [(flag.sites, flag.kind) for flag in check_plausibility(facts)] == [(("1",), "axis")]
    apart = [replace(one, site="") for one in facts]
    assert {flag.kind for flag in check_plausibility(apart)} == {"axis", "place"}


def test_table_2_has_a_row_of_each_record_and_means_over_sites(tmp_path: Path) -> None:
    (tmp_path / "predict").mkdir()
    rows = [("1", "1", 2.0), ("1", "1-fast", 4.0), ("2", "2", 9.0)]
    text = ", ".join(
        f'{{"site": "{site}", "record": "{record}", "fitted": true, "error_percent": {error}, '
        f'"error_one_material_percent": {error}, "peak_force_N": 5.0}}'
        for site, record, error in rows
    )
    (tmp_path / "predict" / "predict.json").write_text(
        json.dumps(complete(PredictResult, json.loads(f'{{"sites": [{text}]}}')))
    )
    table = make_site_table(load_store(tmp_path))
    assert [row.cells[0].text for row in table.rows] == ["1", "1-fast", "2"]
    (mean,) = table.foot
    assert mean.cells[1].text == "2 sites"
    assert mean.cells[5].text == "6.0"
    assert "means are over sites" in table.caption


def creep(seconds: float = 6.0, rate: float = 200.0) -> np.ndarray:
    """Time, displacement and force of an approach, a ramp to 2 N in 0.5 s, a hold and its release."""
    time = np.arange(0.0, 2.0 + seconds, 1 / rate)
    since = time - 1.0
    force = np.interp(since, [0.0, 0.5, 0.5 + seconds, 0.9 + seconds], [0.0, 2.0, 2.0, 0.0])
    depth = 1.5 * force * (1.0 + 0.5 * (1.0 - np.exp(-np.maximum(since, 0.0) / 1.5)))
    moved = np.where(since < 0.0, 0.8 * since, depth)
    random = np.random.default_rng(3)
    noise = random.normal(0.0, 0.004, (2, time.size))
    return np.column_stack([time, 0.8 + moved + noise[0], force + noise[1]])


def under_force(folder: Path, table: np.ndarray) -> Study:
    head = "time_s,displacement_mm,force_N"
    np.savetxt(folder / "d.csv", table, delimiter=",", header=head, comments="")
    return read(folder, STUDY.replace('name = "ball"', 'name = "ball"\ncontrol = "force"'))


def test_a_record_under_force_is_ramps_of_force_and_smooth_depths(folder: Path) -> None:
    study = under_force(folder, creep())
    record = study.indentation("1-ball")
    assert isinstance(record, Record)
    assert (record.forced, record.unit) == (True, "mm")
    raw, smooth, facts = read_record(study, record)
    assert facts.touch_down_s == pytest.approx(1.0, abs=0.02)
    assert facts.touch_down_mm == pytest.approx(0.8, abs=0.03)
    held = next(phase for phase in facts.phases if phase.kind == "hold" and phase.end_s > 5.0)
    assert held.start_s == pytest.approx(1.5, abs=0.03)
    assert held.end_s == pytest.approx(7.5, abs=0.03)
    assert held.end_mm == pytest.approx(1.5 * 2.0 * 1.5, rel=0.02)  # creep, so a hold that goes deeper
    assert facts.peak_force_N == pytest.approx(2.0, rel=0.01)
    assert facts.depth_mm == pytest.approx(4.46, rel=0.02)
    since = raw.time_s - facts.touch_down_s
    left = (raw.displacement_mm - smooth.curve(since))[(since > 1.0) & (since < 6.0)]  # of the hold
    assert np.std(left) == pytest.approx(0.004, rel=0.2)
    assert facts.knots_N[0] == 0.0
    assert facts.knots_N[-1] == pytest.approx(0.05 * 2.0, abs=0.02)
    even = smooth.resample(81)
    true = creep()
    expected = np.interp(even.time_s + facts.touch_down_s, true[:, 0], true[:, 1]) - facts.touch_down_mm
    assert even.displacement_mm == pytest.approx(expected, abs=0.03)
    assert even.force_N == pytest.approx(np.interp(even.time_s, facts.knots_s, facts.knots_N))


def test_a_force_that_never_rises_is_refused_in_one_line(folder: Path) -> None:
    table = creep()
    table[:, 2] = np.random.default_rng(4).normal(0.0, 0.004, len(table))
    study = under_force(folder, table)
    with pytest.raises(TraceError, match=r"d\.csv: force_N: no contact: the force rises by") as caught:
        read_record(study, study.recorded[2])
    assert "\n" not in str(caught.value)


def test_a_wrong_touch_down_shifts_all_depths() -> None:
    times = np.linspace(0.0, 5.0, 40)
    white = np.random.default_rng(5).normal(0.0, 0.004, 4000)
    found = estimate_record_noise("1", times, white, np.full(40, 3.0), None, 0.02)
    assert found.unit == "mm"
    assert np.linalg.eigvalsh(found.covariance)[-1] == pytest.approx(40 * 0.02**2, rel=0.05)


def test_an_interval_takes_the_noise_of_what_is_compared() -> None:
    rows = {"1": ("N", 0.1), "2": ("N", 0.3), "2-creep": ("mm", 0.02)}
    sites = {
        name: RecordResiduals.model_construct(unit=unit, compared_noise_sd_N=sd, misfit_share=0.0)
        for name, (unit, sd) in rows.items()
    }
    known = PredictionModel(np.zeros((1, 1)), np.ones(1), sites, 0.01, 50.0)
    assert known.find_residual_sd("3")[0] == pytest.approx(0.2)
    assert known.find_residual_sd("3-creep", "mm")[0] == pytest.approx(0.02)
    del sites["2-creep"]
    assert known.find_residual_sd("3-creep", "mm") == (0.0, 0.01)


def test_what_is_seen_at_a_site_that_is_not_fitted_has_the_noise_that_is_stated_for_it() -> None:
    """Fitted are moves of the skin, known to 0.02 mm; its ultrasound is known to 0.3 mm."""
    of_skin = RecordResiduals.model_construct(unit="mm", compared_noise_sd_N=0.02, misfit_share=0.0)
    known = PredictionModel(np.zeros((1, 1)), np.ones(1), {"1-surface": of_skin}, 0.0, 1e6)
    seen = SiteResponse(np.linspace(0.0, 2.0, 5), np.zeros((5, 1)))
    for name, noise in (("2-muscle", 0.3), ("1-surface", 0.02)):
        low, high = known.compute_interval_95(seen, np.ones(1), name, "mm", noise_N=0.3)
        assert high - low == pytest.approx(2 * 1.96 * noise, rel=1e-3)


def test_an_interval_covers_the_most_probable_parameters_too() -> None:
    """Force in proportion to the parameter, whose answer is 10 % above the most probable value."""
    sites = {"1": RecordResiduals.model_construct(unit="N", compared_noise_sd_N=0.01, misfit_share=0.0)}
    force = np.linspace(0.0, 5.0, 6)
    known = PredictionModel(np.array([[1e-4]]), np.array([2.0]), sites, 0.0, 1e6)
    at_it, above = (
        known.compute_interval_95(
            SiteResponse(share * force, 0.5 * force[:, None]), np.array([2.0 * share]), "1"
        )
        for share in (1.0, 1.1)
    )
    assert at_it[1] - at_it[0] == pytest.approx(2 * 1.96 * np.hypot(0.01 * force, 0.01), rel=1e-3)
    assert above[0] == pytest.approx(at_it[0], abs=0.01 * force[-1])
    assert above[1] - 1.1 * force == pytest.approx(1.96 * np.hypot(0.011 * force, 0.01), rel=1e-3)


def test_records_of_force_and_depth_are_never_exchanged() -> None:
    curve = np.linspace(0.1, 1.0, 20)
    measured = [
        MeasuredCurve("1", curve),
        MeasuredCurve("2", curve),
        MeasuredCurve("2-creep", curve, site="2", unit="mm"),
        MeasuredCurve("3", curve, unit="mm"),
    ]
    assert list_pairs(measured, [3, 0, 1, 2]) == [(0, 1), (2, 3)]
