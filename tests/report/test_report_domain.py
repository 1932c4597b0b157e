"""What the report says of predictions and socket loads that go beyond the fitted records."""

from dataclasses import replace

import pytest
from stored_results import write_results

from limbfit.identify.checks.domain import SHEAR, TIME, Extent, RecordedRange, describe_outside
from limbfit.report.formats import format_number
from limbfit.report.page import Figure, Note, Section, Table
from limbfit.report.sections.identification import make_domain_section
from limbfit.report.store import Results, load_store
from limbfit.results.socket import SocketLoad, SocketResult, SocketState


def loading(ramp_s: float, end_s: float, skin: float, muscle: float) -> list[Extent]:
    return [
        Extent(TIME, "s", ramp_s, end_s),
        Extent(SHEAR, "", 0.0, skin, "skin"),
        Extent(SHEAR, "", 0.0, muscle, "muscle"),
    ]


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Results:
    """Records of ramps; a load of a socket that lasts an hour and shears the skin more."""
    found = load_store(write_results(tmp_path_factory.mktemp("study") / "results", geometry=False))
    own = [
        loading(7.0 + 0.1 * i, 14.0 + 0.2 * i, 0.24 - 0.01 * i, 0.2 + 0.01 * i)
        for i in range(len(found.predicted))
    ]
    fitted = [one for one, row in zip(own, found.predicted, strict=True) if row.fitted]
    tested, worn = RecordedRange.from_records(fitted, ()), loading(1.0, 3600.0, 0.36, 0.18)
    sites = [
        row.model_copy(update={"loading": one, "outside_records": tested.find_outside(one)})
        for one, row in zip(own, found.predicted, strict=True)
    ]
    changed = {"sites": sites, "recorded_range": tested, "outside_text": ()}
    outside = tested.find_outside(worn)
    socket = SocketResult.model_construct(
        donning=SocketState.model_construct(),
        loads=[SocketLoad.model_construct(name="stance", loading=worn, outside_records=outside)],
        outside_text=describe_outside({"the load 'stance'": outside}),
    )
    predict = found.predict.model_copy(update=changed)
    return replace(found, predict=predict, experiments={"socket": socket})


def blocks(section: Section, kind: type) -> list:
    return [block for block in section.blocks if isinstance(block, kind)]


def test_what_lies_outside_stands_in_words_in_a_picture_and_in_a_table(store):
    section = make_domain_section(store)
    (times, strain) = (note.text for note in blocks(section, Note))
    assert "lasts 3600 s (the records last 14.6 s)" in times
    assert "shear strain of skin 0.36 (records: 0.24" in strain
    (figure,) = blocks(section, Figure)
    assert "stance" in figure.markup
    assert "muscle" in figure.markup
    (table,) = blocks(section, Table)
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    assert ["socket, stance", "shear strain", "skin", "–", "to 0.24", "to 0.36", "33"] in rows
    assert ["socket, stance", "time", "–", "s", "7.0 to 15", f"1.0 to {format_number(3600.0)}", "100"] in rows


def test_where_nothing_lies_outside_the_report_says_so(store):
    predict = store.predict.model_copy(update={"sites": [row for row in store.predicted if row.fitted]})
    section = make_domain_section(replace(store, predict=predict, experiments={}))
    (note,) = blocks(section, Note)
    assert note.text.startswith("Every prediction lies within")
