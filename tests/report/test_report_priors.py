"""The report says what was known beforehand, and how much of each interval comes from it."""

import json
from pathlib import Path
from typing import Any

import pytest
from stored_results import NAMES, write_results

from completing import write_result
from editing import rewritten
from limbfit.priors import SOURCE
from limbfit.report.page import Prose, Table
from limbfit.report.sections.identification import make_parameter_section
from limbfit.report.store import load_store
from limbfit.results.identification import CalibrationResult


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return write_results(tmp_path / "results", geometry=False)


def add_priors(results: Path) -> None:
    with rewritten(results / "calibrate" / "calibration.json") as content:
        content["uncertainty"]["priors"] = {
            "stated": {
                "skin.c_kPa": {"median": 7.37, "factor": 2.18, "source": SOURCE},
                "muscle.m": {"median": 3.0, "factor": 1.25, "source": "the study"},
            },
            "share": {name: 0.625 if name == "skin.c_kPa" else 0.031 for name in NAMES},
            "wider_without": {name: 1.84 if name == "skin.c_kPa" else 1.02 for name in NAMES},
        }


def find_table(results: Path, name: str) -> tuple[Any, Any]:
    """A table of the section of parameters and the paragraph before it; None: there is none."""
    blocks = make_parameter_section(load_store(results)).blocks
    pairs = zip((None, *blocks), blocks)
    return next(
        ((words, block) for words, block in pairs if getattr(block, "name", "") == name), (None, None)
    )


def test_each_interval_s_share_of_the_priors_is_shown_with_its_source(results: Path) -> None:
    assert find_table(results, "priors") == (None, None)
    add_priors(results)
    words, table = find_table(results, "priors")
    assert isinstance(words, Prose)
    assert SOURCE in words.text
    assert "the study" in words.text
    assert isinstance(table, Table)
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    assert len(rows) == len(NAMES)
    assert rows[0][3:] == ["7.37", "2.18", "62", "1.84 times"]
    assert rows[1][3:] == ["–", "–", "3", "1.02 times"]


def test_moduli_at_several_times_are_shown_with_what_the_records_prefer(results: Path) -> None:
    assert find_table(results, "moduli") == (None, None)
    content = json.loads((results / "calibrate" / "calibration.json").read_text())
    content["uncertainty"]["relaxation"] = {
        "words": ["the records cannot tell the relaxation of the model from a power law of time"],
        "moduli": [
            {"tissue": "muscle", "time_s": time, "modulus_kPa": 5.0, "interval_95": [low, 5.5]}
            for time, low in ((1.0, 4.6), (3600.0, 1.0))
        ],
        "prior": {"slope": [0.0, 0.3], "source": "published tissue"},
        "beyond": {"longest_s": 12.6},
    }
    write_result(results, CalibrationResult, content)
    words, table = find_table(results, "moduli")
    assert words.text.startswith("The records cannot tell")
    assert "after 13 s" in words.text
    assert "published tissue" in words.text
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    assert [row[2:] for row in rows] == [["5.00", "4.60 to 5.50"], ["5.00", "1.00 to 5.50"]]
