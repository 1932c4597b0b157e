"""Numbers as people read them."""

import math

import pytest

from limbfit.report.formats import format_duration, format_fixed, format_number
from limbfit.report.sections.methods import flatten_settings


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (4.7, "4.70"),
        (-0.0123456, "−0.0123"),
        (0.000012, "1.20e−05"),
        (0, "0.00"),
        (100.0, "100"),
        (41987.4, "41 987"),
        (3e7, "3.00e+07"),
        (999.4, "999"),
        (999.7, "1 000"),
        (-999.7, "−1 000"),
        (0.00099999, "0.00100"),
        (math.nan, "–"),
        (math.inf, "∞"),
        (None, "–"),
    ],
)
def test_number(value: float | None, text: str) -> None:
    assert format_number(value) == text


def test_a_number_of_two_digits_that_rounds_to_a_hundred_has_no_exponent() -> None:
    assert [
        format_number(99.4, 2),
        format_number(99.96, 2),
        format_number(9.96, 2),
        format_number(0.0, 2),
    ] == ["99", "100", "10", "0.0"]


def test_fixed() -> None:
    assert [format_fixed(6.749), format_fixed(-0.26, 2), format_fixed(None), format_fixed(math.nan)] == [
        "6.7",
        "−0.26",
        "–",
        "–",
    ]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(4.26, "4.3 s"), (151.2, "2 min 31 s"), (5700, "1 h 35 min"), (None, "–")],
)
def test_duration(seconds: float | None, text: str) -> None:
    assert format_duration(seconds) == text


def test_flatten_names_sites_and_keeps_order() -> None:
    settings = {
        "mesh": {"element": "tet10"},
        "sites": [{"name": "A", "axis": [0, 0, 1], "fitted": True, "near": None}],
    }
    assert flatten_settings(settings) == {
        "mesh.element": "tet10",
        "sites.A.name": "A",
        "sites.A.axis": "0, 0, 1",
        "sites.A.fitted": "yes",
        "sites.A.near": "–",
    }
