"""What a prediction does to the tissue beside what the fitted records did: listed with both, and in words."""

import numpy as np
import pytest

from limbfit.identify.checks.domain import (
    ANGLE,
    LEVEL,
    PRESSURE,
    SHEAR,
    TIME,
    Extent,
    RecordedRange,
    describe_outside,
)
from limbfit.pipeline.simulation.loading import LoadHistory, describe_untested_times, time_socket_loads
from limbfit.results.identification import RecordedExtents
from limbfit.study.socket import SocketLoadTable, SocketTable

RECORDS = (
    [Extent(TIME, "s", 8.0, 13.0), Extent(SHEAR, "", 0.0, 0.2, "muscle"), Extent(LEVEL, "mm", 60.0, 60.0)],
    [Extent(TIME, "s", 2.0, 9.0), Extent(SHEAR, "", 0.0, 0.3, "muscle"), Extent(LEVEL, "mm", 90.0, 90.0)],
)
TESTED = RecordedRange.from_records(RECORDS, (10.0, 350.0, 180.0))


def find(*prediction: Extent) -> list[dict]:
    return RecordedRange.from_stored(RecordedExtents.model_validate(TESTED)).find_outside(prediction)


def test_records_together_go_as_far_as_each_of_them():
    assert Extent(TIME, "s", 2.0, 13.0) in TESTED.extents
    assert Extent(SHEAR, "", 0.0, 0.3, "muscle") in TESTED.extents
    assert all(find(*record) == [] for record in RECORDS)


def test_what_lasts_longer_or_comes_on_faster_is_outside_with_both_ranges():
    assert find(Extent(TIME, "s", 2.0, 15.0)) == []  # half as long again is little for relaxation
    (row,) = find(Extent(TIME, "s", 1.0, 3600.0))
    assert (row.records, row.prediction) == ((2.0, 13.0), (1.0, 3600.0))
    assert row.share == pytest.approx(1.0 - 11.0 / 3599.0)
    (fast,) = find(Extent(TIME, "s", 0.1, 5.0))
    assert fast.share == pytest.approx(1.9 / 4.9)


def test_the_share_of_strained_volume_is_that_beyond_the_records():
    """Strain that rises evenly from 0 to 0.6 over the volume: 1 % exceeds 0.594, and half of it 0.3."""
    values = np.linspace(0.0, 0.6, 4001)
    (row,) = find(Extent.from_values(SHEAR, "", values, np.full(4001, 2.5), "muscle"))
    assert row.prediction == (0.0, pytest.approx(0.594, abs=1e-3))
    assert row.share == pytest.approx(0.5, abs=3e-3)
    weights = np.where(values > 0.3, 1.0, 4.0)
    (row,) = find(Extent.from_values(SHEAR, "", values, weights, "muscle"))
    assert row.share == pytest.approx(0.2, abs=3e-3)
    assert find(Extent.from_values(SHEAR, "", 0.5 * values, weights, "muscle")) == []


def test_a_tissue_that_no_record_strained_is_outside_and_an_unknown_quantity_is_not():
    (row,) = find(Extent(SHEAR, "", 0.0, 0.1, "fat"))
    assert (row.tissue, row.records, row.share) == ("fat", (0.0, 0.0), 1.0)
    assert find(Extent(PRESSURE, "kPa", 0.0, 50.0)) == []  # that of the records is not known


def test_places_are_judged_by_level_and_by_the_nearest_fitted_site_around_the_limb():
    np.testing.assert_allclose(TESTED.measure_angle(np.array([0.0, -20.0, 95.0, 179.0])), [10, 10, 85, 1])
    assert find(Extent(LEVEL, "mm", 45.0, 105.0), Extent(ANGLE, "deg", 0.0, 40.0)) == []
    level, angle = find(Extent(LEVEL, "mm", 30.0, 95.0), Extent(ANGLE, "deg", 0.0, 85.0))
    assert level.records == (60.0, 90.0)
    assert angle.prediction == (0.0, 85.0)


def test_two_short_sentences_say_the_figures_of_the_worst():
    outside = {
        "the load 'walk'": find(Extent(TIME, "s", 0.5, 15.0)),
        "the load 'stand'": find(Extent(TIME, "s", 1.0, 3600.0), Extent(SHEAR, "", 0.0, 0.45, "muscle")),
        "donning": [],
    }
    times, others = describe_outside(outside)
    assert times == (
        "the load 'stand' comes on in 1 s (the records' shortest ramp takes 2 s) and lasts 3600 s (the "
        "records last 13 s): no record tells how tissue relaxes at such times (1 more of 3 too)"
    )
    assert others == (
        "the load 'stand' goes beyond the records: shear strain of muscle 0.45 (records: 0.3, over 33 % of "
        "the volume)"
    )
    assert describe_outside({"donning": [], "unknown": None}) == []


def test_times_of_an_indentation_are_those_of_its_ramps_and_its_end():
    found = LoadHistory.from_knots((0.0, 2.0, 12.0, 13.0, 17.0), (0.0, 4.0, 4.0, 0.0, 4.0))
    assert found == LoadHistory(2.0, 17.0, 0.5)  # mm/s over 4 mm


def test_times_of_a_socket_count_from_the_beginning_of_donning():
    load = SocketLoadTable(name="stance", force_N=(0.0, 0.0, 150.0), duration_s=0.5, hold_s=3600.0)
    found = time_socket_loads(SocketTable(donning_s=2.0, hold_s=10.0, loads=(load,)))
    assert found["donning"].time == Extent(TIME, "s", 2.0, 12.0)
    assert found["stance"].time == Extent(TIME, "s", 0.5, 3612.5)


def test_a_protocol_says_which_times_of_a_socket_it_does_not_determine():
    records = [LoadHistory(1.5, 33.0, 0.7), LoadHistory(0.3, 0.6, 3.0)]
    assert describe_untested_times(records, {"donning": (2.0, 12.0), "stance": (0.5, 40.0)}) == []
    (text,) = describe_untested_times(records, {"donning": (2.0, 12.0), "day": (1.0, 3600.0)})
    assert "the load 'day' lasts 3600 s (the records last 33 s)" in text
