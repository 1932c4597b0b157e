"""Wrong records are told by ``limbfit check`` and shown in the report."""

import nibabel
import numpy as np
import pytest

from completing import write_result
from conftest import write_trace
from limbfit import check_study, load_study, run_study
from limbfit.anatomy.imaging import write_labels, write_volume
from limbfit.pipeline.records.traces import read_record
from limbfit.report.page import Bullets
from limbfit.report.sections.inputs import make_model_section, make_record_check_section
from limbfit.report.store import load_store
from limbfit.results.identification import PredictResult
from limbs import leg_image

PLACES = ([40.0, 0.0, 60.0], [0.0, 40.0, 50.0], [-40.0, 0.0, 60.0], [0.0, -40.0, 55.0], [28.0, 28.0, 55.0])


@pytest.fixture
def five(study, commands_unasked):
    """A study of five sites around the stump; the records are of one limb."""
    head = (study / "study.toml").read_text().split("[[sites]]")[0]
    tables = [
        f'[[sites]]\nname = "{k}"\nfitted = {str(k < 3).lower()}\ntrace = "{k}.csv"\nposition = {place}\n'
        for k, place in enumerate(PLACES)
    ]
    (study / "study.toml").write_text(head + "".join(tables))
    for k in range(5):
        write_trace(study / f"{k}.csv", depth=5.0 + 0.2 * k, peak=5.0 + 0.3 * k, rate=20.0)
    return study


def flags(study):
    return check_study(load_study(study))["flags"]


def rewrite(study, name, *factors):
    """The record in other units: factors of time, displacement and force."""
    file = study / f"{name}.csv"
    table = np.loadtxt(file, delimiter=",", skiprows=1) * factors
    head = "time_s,displacement_mm,force_N"
    np.savetxt(file, table, delimiter=",", header=head, comments="")


def test_clean_records_are_not_flagged(five):
    assert flags(five) == []


@pytest.mark.parametrize(("factors", "word"), [((1, 1, 1 / 9.80665), "kgf"), ((1, 0.1, 1), "cm")])
def test_a_record_in_another_unit_is_told(five, factors, word):
    rewrite(five, "3", *factors)
    told = flags(five)
    starts = [flag["sites"] for flag in told if flag["kind"] == "start"]
    assert starts == ([["3"]] if word == "cm" else [])  # read as mm, it begins on the skin
    found = [flag for flag in told if flag["kind"] != "start"]
    assert [flag["sites"] for flag in found] == [["3"]]
    assert word in found[0]["cause"]


def test_an_export_of_a_rig_is_read_and_what_was_done_is_told(five):
    """In kilonewtons, below a preamble: the same site, and a remark."""
    study = load_study(five)
    _, _, plain = read_record(study, study.recorded[3])
    head, *rows = (five / "3.csv").read_text().splitlines()
    table = np.loadtxt(rows, delimiter=",") * (1, 1, 1e-3)
    lines = ["Rig,7", head, "s,mm,kN", *(",".join(map(repr, row)) for row in table.tolist())]
    (five / "3.csv").write_text("\n".join(lines))
    told = check_study(load_study(five))
    assert told["sites"]["3"]["peak_force_N"] == pytest.approx(plain.peak_force_N, rel=1e-6)
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


def test_an_image_that_says_twice_where_it_lies_is_told_by_check_stage_and_report(tmp_path):
    """Read by its sform, where its labels are; its qform is 30 mm off."""
    image, labels = leg_image([4.0, 4.0, 5.0], (32, 32, 32), np.eye(3))
    write_volume(tmp_path / "image.nii", image)
    write_labels(tmp_path / "labels.seg.nrrd", labels)
    header = nibabel.load(tmp_path / "image.nii")
    qform = header.affine.copy()
    qform[0, 3] += 30.0
    header.set_qform(qform, 1)
    header.set_sform(header.affine, 1)
    nibabel.save(nibabel.Nifti1Image(np.asarray(header.dataobj), None, header.header), tmp_path / "two.nii")
    (tmp_path / "study.toml").write_text(
        '[study]\nname = "leg"\n[image]\npath = "two.nii"\n[segmentation]\nlabels = "labels.seg.nrrd"\n'
        '[[sites]]\nname = "1"\nposition = [0.0, 0.0, 0.0]\ndepth_mm = 5.0\n'
    )
    study = load_study(tmp_path)
    words = "image: its qform and sform differ by up to 30.0 mm; the sform is used"
    facts = check_study(study)["facts"]
    assert sum(fact.startswith(f"warning: {words}") for fact in facts) == 1
    said = []
    run_study(study, until="segment", listener=lambda event: said.append(event.text))
    assert sum(text.startswith(f"warning: {words}") for text in said) == 1
    bullets = [
        block for block in make_model_section(load_store(study.results)).blocks if isinstance(block, Bullets)
    ]
    assert bullets[0].items[0].startswith(words)


def section(tmp_path, **predict):
    """The section of a folder that holds predictions alone."""
    write_result(tmp_path, PredictResult, {"sites": [], **predict})
    return make_record_check_section(load_store(tmp_path))


def test_the_report_says_that_nothing_is_wrong_or_what_is(five, tmp_path):
    assert "Nothing looks wrong" in section(tmp_path, flags=[], left_out=[]).blocks[0].text
    rewrite(five, "3", 1, 1, 9.80665)
    left = [{"site": "3", "error": 0.8, "expected": 0.1, "standardised": 8.0, "ratio": 9.7, "cook": 3.0}]
    words, table, sites = section(tmp_path, flags=flags(five), left_out=left).blocks
    assert "9.81" in words.items[0]
    assert table.rows[0].cells[0].text == "3"
    assert sites.rows[0].marked
