"""The section that shows FEBio beside limbfit, where both solved a site."""

import numpy as np
import pytest
from stored_results import write_results

from completing import write_result
from limbfit.report import build_report
from limbfit.results.runs import CompareResult


def compared(results, peak=3.0, reason=""):
    run = {"completed": True, "reason": "", "peak_force_N": peak, "difference": {"max_percent": 0.4}}
    febio = {"version": "FEBio 4.11.0", "completed": not reason, "reason": reason, "peak_force_N": 2.9}
    row = {"site": "1", "febio": febio, "limbfit": run, "limbfit_matched": run}
    write_result(results, CompareResult, row, "1")
    t = np.linspace(0, 2, 9)
    columns = np.column_stack([t, t, 2.9 * t, 3 * t, 3 * t])
    head = "time_s,displacement_mm,febio_N,limbfit_N,limbfit_matched_N"
    np.savetxt(results / "compare" / "1.csv", columns, delimiter=",", header=head, comments="")


@pytest.mark.slow
def test_the_comparison_is_shown_where_there_is_one(tmp_path):
    write_results(tmp_path / "results", geometry=False)
    plain = build_report(tmp_path / "results", tmp_path / "plain").read_text()
    assert "Comparison with FEBio" not in plain
    compared(tmp_path / "results", reason="FEBio was <killed>")
    text = build_report(tmp_path / "results", tmp_path / "out").read_text()
    assert "Comparison with FEBio" in text
    assert "Force of the same indentation by FEBio and by limbfit." in text
    assert "FEBio 4.11.0, FEBio was &lt;killed&gt;" in text
    assert ">2.900<" in text.replace(" ", "").replace("\n", "")
