"""Files of records are read, or refused with file, place and remedy; what cannot be an indentation is."""

from __future__ import annotations

import numpy as np
import pytest
from made_records import record
from scipy.io import savemat

from limbfit.errors import TraceError
from limbfit.traces import Trace, check_trace, read_trace


def write_csv(path, trace, header="time_s,displacement_mm,force_N", delimiter=",", decimal="."):
    rows = zip(trace.time_s, trace.displacement_mm, trace.force_N)
    lines = [delimiter.join(f"{v:.5f}".replace(".", decimal) for v in row) for row in rows]
    path.write_text("\n".join([header.replace(",", delimiter), *lines]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", "."), ("\t", "."), (";", ",")])
def test_tables_of_all_flavours_read_the_same(tmp_path, delimiter, decimal):
    trace, _ = record(rate=50)
    read = read_trace(write_csv(tmp_path / "a.csv", trace, delimiter=delimiter, decimal=decimal))
    assert read.force_N == pytest.approx(trace.force_N, abs=1e-5)
    assert read.displacement_mm == pytest.approx(trace.displacement_mm, abs=1e-5)


def test_columns_are_found_by_name_whatever_their_order_and_company(tmp_path):
    trace, _ = record(rate=50)
    path = tmp_path / "a.csv"
    rows = [
        f"{t:.4f},x,{f:.4f},{d:.4f}" for t, d, f in zip(trace.time_s, trace.displacement_mm, trace.force_N)
    ]
    path.write_text("\n".join(["# recorded on a Monday", '"t","note","F","u"', *rows]), encoding="utf-8-sig")
    read = read_trace(path, columns=("t", "u", "F"))
    assert read.displacement_mm == pytest.approx(trace.displacement_mm, abs=1e-4)


@pytest.mark.parametrize("struct", [False, True])
def test_mat_files_hold_vectors_or_one_struct(tmp_path, struct):
    trace, _ = record(rate=50)
    content = {
        "time_s": trace.time_s[:, None],
        "displacement_mm": trace.displacement_mm[None],
        "force_N": trace.force_N,
    }
    savemat(tmp_path / "a.mat", {"record": content} if struct else content)
    read = read_trace(tmp_path / "a.mat")
    assert np.array_equal(read.force_N, trace.force_N)
    assert np.array_equal(read.time_s, trace.time_s)


def broken(tmp_path, edit):
    """A file whose lines were edited."""
    trace, _ = record(rate=50)
    path = write_csv(tmp_path / "a.csv", trace)
    lines = path.read_text().splitlines()
    edit(lines)
    path.write_text("\n".join(lines))
    return path


def replace(line, text):
    return lambda lines: lines.__setitem__(line - 1, text)


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (
            replace(1, "time,displacement_mm,force_N"),
            "header: no column 'time_s'.*it has 'time', 'disp.*rename",
        ),
        (replace(7, "0.1,oops,0.2"), "line 7, column displacement_mm: 'oops' is not a number"),
        (replace(7, "0.1,"), "line 7, column displacement_mm: '' is not a number"),
        (replace(7, "0.1"), "line 7, column displacement_mm: the row is too short"),
        (replace(7, "0.1,0.1,nan"), "force_N: nan in sample 6"),
        (replace(7, "0.1,0.1,inf"), "force_N: inf in sample 6"),
        (replace(7, "9.1,0.1,0.1"), "time_s: time goes back at sample 7; remove or sort"),
        (lambda lines: lines.__delitem__(slice(12, None)), "only 11 samples; a record needs at least 20"),
        (lambda lines: lines.clear(), "the file is empty"),
    ],
)
def test_broken_tables_are_refused_with_file_place_and_remedy(tmp_path, edit, says):
    path = broken(tmp_path, edit)
    with pytest.raises(TraceError, match=says) as caught:
        read_trace(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_tables_are_refused(tmp_path):
    with pytest.raises(TraceError, match="no such file"):
        read_trace(tmp_path / "none.csv")
    path = tmp_path / "a.csv"
    path.write_bytes(bytes(100_000))
    with pytest.raises(TraceError, match="not a text table"):
        read_trace(path)
    path.write_bytes(b"time_s,displacement_mm,force_N\n\xff\xfe1,2,3\n")
    with pytest.raises(TraceError, match="not UTF-8"):
        read_trace(path)


def test_broken_mat_files_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + bytes(500))
    with pytest.raises(TraceError, match=r"version 7\.3; save it in MATLAB with '-v7'"):
        read_trace(path)
    for content in (b"", b"nonsense" * 100, bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(TraceError, match="not a readable MAT file"):
            read_trace(path)
    trace, _ = record(rate=50)
    columns = {"time_s": trace.time_s, "displacement_mm": trace.displacement_mm}
    savemat(path, columns | {"force_N": np.ones((4, 4))})
    with pytest.raises(TraceError, match="force_N: not a vector of real numbers"):
        read_trace(path)
    savemat(path, columns | {"force_N": "text"})
    with pytest.raises(TraceError, match="force_N: not a vector"):
        read_trace(path)
    savemat(path, columns)
    with pytest.raises(TraceError, match="no column 'force_N'"):
        read_trace(path)
    savemat(path, columns | {"force_N": trace.force_N[:-1]})
    with pytest.raises(TraceError, match=r"force_N: .* values for .* times"):
        read_trace(path)


# --- what cannot be an indentation


@pytest.mark.parametrize(
    ("factors", "says"),
    [
        ((1, 1e-3, 1), "displacement_mm: a travel of .* looks like metres"),
        ((1, 1e3, 1), "displacement_mm: a travel of .* looks like micrometres"),
        ((1e3, 1, 1), "time_s: a speed of .* looks like milliseconds"),
        ((1 / 3600, 1, 1), "time_s: a speed of .* check the units"),
        ((1, 1, 1e-3), "force_N: a peak force of .* looks like kilonewtons"),
        ((1, 1, 1e3), "force_N: a peak force of .* looks like millinewtons"),
        ((1, -1, 1), "displacement_mm: the displacement falls; .* change the sign"),
        ((1, 1, -1), "force_N: the force falls when the indenter pushes; .* change the sign"),
        ((1, 1, 0), "force_N: no contact"),
    ],
)
def test_units_that_cannot_be_right_are_refused(factors, says):
    trace, _ = record(rate=100)
    t, d, f = factors
    with pytest.raises(TraceError, match=says):
        check_trace(Trace(t * trace.time_s, d * trace.displacement_mm, f * trace.force_N))


def test_a_record_of_noise_is_no_contact():
    trace, _ = record(rate=100)
    rng = np.random.default_rng(5)
    with pytest.raises(
        TraceError, match=r"no contact: the force rises by .* against a noise of .*leave the site"
    ):
        check_trace(Trace(trace.time_s, trace.displacement_mm, 0.03 * rng.standard_normal(trace.time_s.size)))
