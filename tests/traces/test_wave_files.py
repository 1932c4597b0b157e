"""Speeds of shear waves as elastography reads them: the file, its means, what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from limbfit.errors import TraceError
from limbfit.traces import read_wave_speeds


def table(folder: Path, head: str, rows: list[str]) -> Path:
    file = folder / "waves.csv"
    file.write_text("\n".join([head, *rows]) + "\n")
    return file


def test_readings_by_place_with_empty_cells(tmp_path: Path) -> None:
    rows = ["0,4.9,", "1,5.1,3.0", "2,,3.2", "3,5.4,3.6"]
    skin, muscle = read_wave_speeds(table(tmp_path, "time_s,skin_m_s,muscle_12.5mm_m_s", rows), "time_s")
    assert (skin.tissue, skin.depth_mm, skin.name) == ("skin", None, "skin")
    assert (muscle.tissue, muscle.depth_mm, muscle.name) == ("muscle", 12.5, "muscle_12.5mm")
    assert skin.time_s.tolist() == [0.0, 1.0, 3.0]
    assert muscle.speed_m_s.tolist() == [3.0, 3.2, 3.6]


def test_means_before_touch_down_are_at_rest(tmp_path: Path) -> None:
    """Two of what comes before, then at most 20; what all share does not shrink with their number."""
    rows = [f"{0.1 * i:.1f},{4.0 + 0.01 * i:.2f}" for i in range(100)]
    (skin,) = read_wave_speeds(table(tmp_path, "time_s,skin_m_s", rows), "time_s")
    means = skin.average(2.0, 8.0)
    assert means.time_s[:2].tolist() == [0.0, 0.0]
    assert len(means.time_s) == 2 + 20
    assert means.speed_m_s[:2] == pytest.approx([4.045, 4.145])
    assert means.time_s[-1] < 6.0
    assert means.samples.sum() == 81
    covariance = means.covariance(0.2, 0.1)
    assert np.diag(covariance) == pytest.approx(0.04 / means.samples + 0.01)
    assert covariance[0, 5] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("head", "rows", "told"),
    [
        ("time_s,skin", ["0,4.9"], "no speed of a wave; name columns such as muscle_m_s"),
        ("time_s,skin_m_s", ["1,4.9", "0,4.9"], "time does not increase; sort the readings"),
        (
            "time_s,skin_m_s",
            ["0,490", "1,500"],
            "490 to 500 m/s is no soft tissue's speed .*; give metres per second",
        ),
        ("time_s,skin_m_s,fat_m_s", ["0,4.9,", "1,4.9,"], "no speed is given; fill some of its cells"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(tmp_path: Path, head: str, rows: list[str], told: str) -> None:
    with pytest.raises(TraceError, match=told) as caught:
        read_wave_speeds(table(tmp_path, head, rows), "time_s")
    assert caught.value.file == tmp_path / "waves.csv"


def test_one_reading_is_not_enough(tmp_path: Path) -> None:
    (skin,) = read_wave_speeds(table(tmp_path, "time_s,skin_m_s", ["0,4.9", "60,5.1"]), "time_s")
    with pytest.raises(TraceError, match=r"1 readings until the indenter lets go .*; give two or more"):
        skin.average(2.0, 8.0)
