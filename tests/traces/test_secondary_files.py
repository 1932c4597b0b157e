"""What is measured beside the force, from the file to what is compared: moves of the skin, shear waves."""

from pathlib import Path

import numpy as np
import pytest

from limbfit.errors import TraceError
from limbfit.traces import SurfaceMotion, read_surface_motion, read_wave_speeds, select_frames_in_contact

HEAD = "time_s,x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm"
AT = ((10.0, 0.0, 0.0), (0.0, 12.0, 0.0))


def table(folder: Path, head: str, *rows: str) -> Path:
    file = folder / "s.csv"
    file.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return file


def test_rows_become_frames_of_points(tmp_path: Path) -> None:
    """In any order, with cells that are empty and points that are not seen at every time."""
    file = table(
        tmp_path, HEAD, "2,0,12,0,0.1,,-0.5", "1,10,0,0,0.2,0.0,-0.1", "2,10,0,0,0.4,0.0,-0.2", "3,10,0,0,,,"
    )
    found = read_surface_motion(file, "time_s")
    assert found.time_s.tolist() == [1.0, 2.0, 3.0]
    assert found.points.tolist() == [[0.0, 12.0, 0.0], [10.0, 0.0, 0.0]]
    assert np.isnan(found.moved_mm[0, 0]).all()
    assert np.isnan(found.moved_mm[2, 1]).all()
    assert found.moved_mm[1, 1].tolist() == [0.4, 0.0, -0.2]
    assert found.moved_mm[1, 0, [0, 2]].tolist() == [0.1, -0.5]
    assert np.isnan(found.moved_mm[1, 0, 1])


def test_one_component_will_do(tmp_path: Path) -> None:
    file = table(tmp_path, "time_s;x_mm;y_mm;z_mm;uz_mm", "1;10;0;0;-0,5", "1;0;12;0;-0,2")
    found = read_surface_motion(file, "time_s")
    assert np.isnan(found.moved_mm[..., :2]).all()
    assert found.moved_mm[0, :, 2].tolist() == [-0.2, -0.5]
    means = found.average(np.array([0, 1]))
    assert means.component.tolist() == [2, 2]


WRONG = {
    "no place": ("time_s,ux_mm", ["1,2"], "no column 'x_mm'"),
    "no move": ("time_s,x_mm,y_mm,z_mm", ["1,2,3,4"], "no displacement of a point; name columns ux_mm"),
    "metres": (HEAD, ["1,0.01,0,0,0.001,0,0", "1,0,0.012,0,0.0,0,0"], "points lie within 0.012 mm"),
    "moves in metres": (
        HEAD,
        ["1,10,0,0,0.002,0,0", "1,0,12,0,0,0,0"],
        "the largest displacement is 0.002 mm",
    ),
    "moves too far": (HEAD, ["1,10,0,0,2e3,0,0", "1,0,12,0,0,0,0"], "the largest displacement is 2e"),
    "a gap in a place": (HEAD, ["1,10,,0,2,0,0"], "nan in sample 1; give a number"),
    "an endless move": (
        HEAD,
        ["1,10,0,0,inf,0,0"],
        "inf in sample 1; give a number, or leave the cell empty",
    ),
    "all gaps": (HEAD, ["1,10,0,0,,,", "1,0,12,0,nan,,"], "no displacement is given"),
    "twice": (
        HEAD,
        ["1,10,0,0,1,0,0", "1,10,0,0,2,0,0", "1,0,1,0,0,0,0"],
        r"\(10, 0, 0\) has two rows at 1 s",
    ),
    "words": (HEAD, ["1,10,0,0,down,0,0"], "'down' is not a number"),
}


@pytest.mark.parametrize(("head", "rows", "told"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_with_a_file_is_told_in_one_line(
    tmp_path: Path, head: str, rows: list[str], told: str
) -> None:
    with pytest.raises(TraceError, match=told) as caught:
        read_surface_motion(table(tmp_path, head, *rows), "time_s")
    assert caught.value.file == tmp_path / "s.csv"
    assert caught.value.place


def motion(times: np.ndarray) -> SurfaceMotion:
    """Two points that go down with time squared."""
    moved = np.zeros((len(times), 2, 3))
    moved[:, :, 2] = -0.1 * times[:, None] ** 2 * [1.0, 2.0]
    return SurfaceMotion(np.array(AT), times, moved)


def test_times_are_of_the_records_clock() -> None:
    seen = motion(np.arange(0.0, 10.0))
    found = select_frames_in_contact(seen, (0.0, 12.0), 2.0, 8.0)
    assert found.time_s.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    with pytest.raises(
        TraceError, match="times from 0 to 9 s, and the record goes from 0 to 8 s; give times"
    ):
        select_frames_in_contact(seen, (0.0, 8.0), 2.0, 7.0)
    with pytest.raises(TraceError, match=r"no displacement while the indenter presses \(9.20 to 11.00 s\)"):
        select_frames_in_contact(seen, (0.0, 12.0), 9.2, 11.0)


def test_means_are_of_the_frames_that_show_a_point() -> None:
    """Each is compared with the same mean of a simulation: on a curve that bends nothing is off."""
    times = np.linspace(0.1, 6.0, 60)
    seen = motion(times)
    seen.moved_mm[::3, 1] = np.nan
    seen.moved_mm[40:, 1, 0] = np.nan
    found = seen.average(np.array([1, 0]))
    of_point = np.array(AT)[[1, 0]][found.point]
    assert len(np.unique(found.time_s.round(6))) > 8  # other frames, other times
    assert len(found.moved_mm) < 8 * 2 * 3
    curve = -0.1 * times**2
    down = found.component == 2
    scale = np.where(of_point[:, 0] == 0.0, 2.0, 1.0)
    assert found.moved_mm[down] == pytest.approx((scale * (found.frames @ curve))[down])
    assert found.frames.sum(axis=1) == pytest.approx(1.0)
    assert found.samples.min() == 4
    assert found.samples.max() == 8


def test_one_scan_is_one_time() -> None:
    found = motion(np.array([3.0])).average(np.array([0, 1]))
    assert len(found.moved_mm) == 6
    assert found.samples.tolist() == [1.0] * 6


# --- speeds of shear waves


def test_readings_by_place_with_empty_cells(tmp_path: Path) -> None:
    rows = ["0,4.9,", "1,5.1,3.0", "2,,3.2", "3,5.4,3.6"]
    skin, muscle = read_wave_speeds(table(tmp_path, "time_s,skin_m_s,muscle_12.5mm_m_s", *rows), "time_s")
    assert (skin.tissue, skin.depth_mm, skin.name) == ("skin", None, "skin")
    assert (muscle.tissue, muscle.depth_mm, muscle.name) == ("muscle", 12.5, "muscle_12.5mm")
    assert skin.time_s.tolist() == [0.0, 1.0, 3.0]
    assert muscle.speed_m_s.tolist() == [3.0, 3.2, 3.6]


def test_means_before_touch_down_are_at_rest(tmp_path: Path) -> None:
    """Two of what comes before, then at most 20; what all share does not shrink with their number."""
    rows = [f"{0.1 * i:.1f},{4.0 + 0.01 * i:.2f}" for i in range(100)]
    (skin,) = read_wave_speeds(table(tmp_path, "time_s,skin_m_s", *rows), "time_s")
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
def test_what_is_wrong_with_speeds_is_told(tmp_path: Path, head: str, rows: list[str], told: str) -> None:
    with pytest.raises(TraceError, match=told) as caught:
        read_wave_speeds(table(tmp_path, head, *rows), "time_s")
    assert caught.value.file == tmp_path / "s.csv"


def test_one_reading_of_a_speed_is_not_enough(tmp_path: Path) -> None:
    (skin,) = read_wave_speeds(table(tmp_path, "time_s,skin_m_s", "0,4.9", "60,5.1"), "time_s")
    with pytest.raises(TraceError, match=r"1 readings until the indenter lets go .*; give two or more"):
        skin.average(2.0, 8.0)
