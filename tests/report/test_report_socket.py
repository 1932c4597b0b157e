"""What table and report say beside a socket's pressures: where intervals come from, what others found."""

from copy import deepcopy

import pytest

from completing import complete
from limbfit.cli.socket import show_socket
from limbfit.report.page import Table
from limbfit.report.sections.socket import make_interval_table, make_published_table
from limbfit.results.socket import SocketLoad, SocketResult, SocketState
from limbfit.socket.published import FINDINGS, WHOLE, select_published_findings

SHARES = {"skin.c_kPa": 80.0, "muscle.tau_s": 12.4}
REGION = {
    "region": "tibial crest",
    "mean_kPa": 30.0,
    "peak_kPa": 60.0,
    "shear_kPa": 4.0,
    "interval_kPa": [28.0, 32.0],
    "interval_from": SHARES,
    "change_kPa": {"skin.c_kPa": 1.0, "muscle.tau_s": 0.2, "liner.c_kPa": -0.5},
}
HELD = {
    "name": "stance",
    "mean_kPa": 12.0,
    "peak_kPa": 60.0,
    "contact_area_mm2": 3e4,
    "settling_mm": 9.0,
    "settling_interval_mm": [8.0, 10.0],
    "settling_interval_from": SHARES,
    "settling_change_mm": {"liner.c_kPa": -0.25},
    "regions": [REGION],
}
STANCE = SocketLoad.model_validate(complete(SocketLoad, deepcopy(HELD)))


def don(region: dict) -> SocketState:
    return SocketState.model_validate(complete(SocketState, {"regions": [dict(region)]}))


def test_the_table_of_intervals_names_parameters_and_what_the_liner_changes():
    table = make_interval_table(STANCE, "stance")
    assert isinstance(table, Table)
    assert table.head[3:] == ("muscle τ (%)", "skin c (%)", "Change, liner c 10 % larger")
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    assert rows == [
        ["tibial crest", "30.0 kPa", "2.00 kPa", "12", "80", "−0.5 kPa"],
        ["settling", "9.0 mm", "1.00 mm", "12", "80", "−0.25 mm"],
    ]


def test_a_simulated_change_of_friction_has_a_column_of_its_own():
    rougher = {**REGION, "change_kPa": {**REGION["change_kPa"], "friction": 1.25}}
    table = make_interval_table(don(rougher), "stance")
    assert isinstance(table, Table)
    assert table.head[-1] == "Change, friction 10 % larger"
    assert table.rows[0].cells[-1].text == "1.2 kPa"


def test_relaxation_beyond_the_records_has_a_column_of_its_own():
    relaxed = {**REGION, "interval_from": {"relaxation": 90.0, "skin.c_kPa": 8.0}}
    table = make_interval_table(don(relaxed), "stance")
    assert isinstance(table, Table)
    assert table.head[3:5] == ("relaxation (%)", "skin c (%)")
    assert "or relaxation beyond the records" in table.caption


def test_without_identified_tissues_there_is_no_such_table():
    unknown = {**REGION, "interval_kPa": None, "interval_from": None, "change_kPa": None}
    assert make_interval_table(don(unknown), "donning") is None


def test_the_command_says_what_most_of_an_interval_comes_from(capsys):
    content = {
        "donning": {key: HELD[key] for key in ("peak_kPa", "contact_area_mm2", "regions")},
        "loads": [HELD],
        "socket": {"notes": ["its triangles looked away from the tissue and were turned"]},
        "parameters_from": "identified",
        "friction": "sticky",
        "balance_percent": 0.01,
        "outside_text": ["the load 'stance' lasts 3600 s; the records last 13 s"],
        "samples": {"simulated": 5, "failed": ["the load could not be carried"]},
        "worn_s": 3600.0,
    }
    show_socket(SocketResult.model_validate(complete(SocketResult, deepcopy(content))))
    printed = capsys.readouterr()
    assert "warning: the load 'stance' lasts 3600 s; the records last 13 s" in printed.err
    out = " ".join(printed.out.split())
    assert "socket: its triangles looked away from the tissue and were turned" in out
    assert "settled by 9.0 mm (95 %: 8.0 to 10.0, mostly from skin c 80 %)" in out
    assert "28.0 to 32.0 skin c 80 %" in out
    assert "by derivatives and 5 simulated draws; another failed: the load could not be carried" in out


@pytest.mark.parametrize("finding", FINDINGS, ids=lambda finding: finding.source)
def test_every_finding_is_told_of_its_regions_with_its_source(finding):
    rows = select_published_findings([*finding.regions, "another"])
    assert finding.source in {row.source for row in rows}
    table = make_published_table(rows, STANCE, "stance")
    assert any(finding.found in {cell.text for cell in row.cells} for row in table.rows)
    assert all(set(row.regions) <= {*finding.regions, WHOLE} for row in rows)


def test_what_others_found_stands_beside_the_regions_own_pressures():
    """By region; what was found over the whole limb beside the whole limb's."""
    rows = select_published_findings(["tibial crest"])
    table = make_published_table(rows, STANCE, "stance")
    own = {tuple(cell.text for cell in row.cells[:3]) for row in table.rows}
    assert own == {("tibial crest", "30.0", "60.0"), (WHOLE, "12.0", "60.0")}
    assert len(table.rows) == sum("tibial crest" in one.regions or WHOLE in one.regions for one in FINDINGS)
    assert "stance" in table.caption
