"""Wrong records are told by ``limbfit check`` and shown in the report."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import write_trace
from limbfit import check_study, load_study
from limbfit.report.sections.doubts import doubts
from limbfit.report.store import Results

PLACES = ([40.0, 0.0, 60.0], [0.0, 40.0, 50.0], [-40.0, 0.0, 60.0], [0.0, -40.0, 55.0], [28.0, 28.0, 55.0])


@pytest.fixture
def five(study):
    """A study of five sites around the stump; the records are of one limb."""
    head = (study / "study.toml").read_text().split("[[sites]]")[0]
    tables = [
        f'[[sites]]\nname = "{k}"\nfitted = {str(k < 3).lower()}\ntrace = "{k}.csv"\nposition = {place}\n'
        for k, place in enumerate(PLACES)
    ]
    (study / "study.toml").write_text(head + "".join(tables))
    for k in range(5):
        write_trace(study / f"{k}.csv", depth=5.0 + 0.2 * k, peak=5.0 + 0.3 * k)
    return study


def flags(study):
    return check_study(load_study(study), listener=lambda event: None)["flags"]


def rewrite(study, name, *factors):
    """The record in other units: factors of time, displacement and force."""
    file = study / f"{name}.csv"
    table = np.loadtxt(file, delimiter=",", skiprows=1) * factors
    head = "time_s,displacement_mm,force_N"
    np.savetxt(file, table, delimiter=",", header=head, comments="")


def test_clean_records_are_not_flagged(five):
    assert flags(five) == []


@pytest.mark.parametrize(
    ("factors", "word"),
    [((1, 1, 1 / 9.80665), "kgf"), ((1, 1, 9.80665), "9.81"), ((1, 0.1, 1), "cm"), ((10, 1, 1), "time")],
)
def test_a_record_in_another_unit_is_told(five, factors, word):
    rewrite(five, "3", *factors)
    found = flags(five)
    assert [flag["sites"] for flag in found] == [["3"]]
    assert word in found[0]["cause"]


def test_an_export_of_a_rig_is_read_and_what_was_done_is_told(five):
    """In kilonewtons, below a preamble: the same site, and a remark."""
    plain = check_study(load_study(five), listener=lambda event: None)["sites"]["3"]
    head, *rows = (five / "3.csv").read_text().splitlines()
    table = np.loadtxt(rows, delimiter=",") * (1, 1, 1e-3)
    lines = ["Rig,7", head, "s,mm,kN", *(",".join(map(repr, row)) for row in table.tolist())]
    (five / "3.csv").write_text("\n".join(lines))
    told = check_study(load_study(five), listener=lambda event: None)
    assert told["sites"]["3"]["peak_force_N"] == pytest.approx(plain["peak_force_N"], rel=1e-6)
    assert [(flag["sites"], flag["kind"]) for flag in told["flags"]] == [(["3"], "reading")]
    words = "the header in line 2 is skipped; column 'force_N' is converted from kN to N"
    assert words in told["flags"][0]["text"]


def test_a_wrong_axis_is_told_with_its_angle(five):
    text = (five / "study.toml").read_text()
    text = text.replace(f"position = {PLACES[2]}", f"position = {PLACES[2]}\naxis = [0.0, 1.0, 0.0]")
    (five / "study.toml").write_text(text)
    found = flags(five)
    assert [(flag["sites"], flag["kind"]) for flag in found] == [(["2"], "axis")]
    assert found[0]["evidence"]["axis_deg"] == pytest.approx(90, abs=8)


def section(tmp_path, **predict):
    empty = {"run": {}, "segment": {}, "surfaces": {}, "sites": (), "traces": {}, "mesh": {}}
    more = {"calibration": {}, "simulated": (), "compared": (), "truth": {}}
    return doubts(Results(tmp_path, **empty, **more, predict={"sites": [], **predict}))


def test_the_report_says_that_nothing_is_wrong_or_what_is(five, tmp_path):
    assert "Nothing looks wrong" in section(tmp_path, flags=[], left_out=[]).blocks[0].text
    rewrite(five, "3", 1, 1, 9.80665)
    left = [{"site": "3", "error": 0.8, "expected": 0.1, "standardised": 8.0, "ratio": 9.7, "cook": 3.0}]
    words, table, sites = section(tmp_path, flags=flags(five), left_out=left).blocks
    assert "9.81" in words.items[0]
    assert table.rows[0].cells[0].text == "3"
    assert sites.rows[0].marked
