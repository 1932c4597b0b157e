"""Ordinary exports of test rigs are read to the same record in s, mm and N, and what was done is said."""

import datetime
import sys

import numpy as np
import openpyxl
import pytest
from made_records import record
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from limbfit.errors import TraceError
from limbfit.traces import COLUMNS, Trace, check_trace, read_layers, read_trace

NAMES = ("Time", "Extension", "Load")


@pytest.fixture(scope="module")
def truth():
    """Rounded to what the files hold."""
    trace, _ = record(rate=50)
    return np.round([trace.time_s, trace.displacement_mm, trace.force_N], 6)


def rows(table, delimiter="\t", quote="", decimal="."):
    cells = ([f"{quote}{v:.9g}{quote}".replace(".", decimal) for v in row] for row in np.transpose(table))
    return [delimiter.join(row) for row in cells]


def write(path, lines, encoding="utf-8"):
    path.write_bytes("\r\n".join(lines).encode(encoding))
    return path


def assert_read(path, truth, notes, names=NAMES):
    found = read_trace(path, names)
    values = np.array([found.time_s, found.displacement_mm, found.force_N])
    assert values == pytest.approx(truth, abs=1e-6)
    assert found.notes == notes


# --- text


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
def test_text_in_utf_16_with_tabs(tmp_path, truth, encoding):
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    path = write(tmp_path / "a.txt", [mark + "\t".join(NAMES), *rows(truth)], encoding)
    assert_read(path, truth, ("the text is UTF-16",))


def test_a_preamble_quoted_cells_and_units_in_brackets_as_instron_exports_them(tmp_path, truth):
    lines = ["Specimen label,Limb 1", "Rate,1,mm/s", "", '"Time","Extension","Load"', '"(s)","(mm)","(kN)"']
    table = truth * [[1], [1], [1e-3]]
    path = write(tmp_path / "a.csv", lines + rows(table, ",", '"'))
    notes = ("what stands before the header in line 4 is skipped", "column 'Load' is converted from kN to N")
    assert_read(path, truth, notes)


def test_semicolons_decimal_commas_and_a_row_of_units_as_zwick_exports_them(tmp_path, truth):
    lines = ["Prüfprotokoll;", "Prüfer;NN", "Prüfzeit;Standardweg;Standardkraft", "ms;m;N"]
    table = truth * [[1e3], [1e-3], [1]]
    path = write(tmp_path / "a.csv", lines + rows(table, ";", decimal=","), "utf-16")
    notes = (
        "the text is UTF-16",
        "what stands before the header in line 3 is skipped",
        "column 'Prüfzeit' is converted from ms to s",
        "column 'Standardweg' is converted from m to mm",
    )
    assert_read(path, truth, notes, ("Prüfzeit", "Standardweg", "Standardkraft"))


def test_a_unit_beside_the_name_is_converted_and_other_brackets_are_left(tmp_path, truth):
    names = ("Time (min)", "Extension [mm]", "Load (filtered)")
    path = write(tmp_path / "a.csv", ["\t".join(names), *rows(truth / [[60], [1], [1]])])
    assert_read(path, truth, ("column 'Time (min)' is converted from min to s",), names)


@pytest.mark.parametrize("unit", ["s", "sec", "seconds", "Seconds", "[s]"])
def test_units_that_are_those_of_limbfit_need_no_remark(tmp_path, truth, unit):
    path = write(tmp_path / "a.csv", ["\t".join(NAMES), f"{unit}\tmm\tNewtons", *rows(truth)])
    assert_read(path, truth, ())


def test_units_beside_the_names_are_converted_however_they_are_spelled(tmp_path, truth):
    names = ("Time (MS)", "Extension (CM)", "Load [KN]")
    path = write(tmp_path / "a.csv", ["\t".join(names), *rows(truth / [[1e-3], [10], [1e3]])])
    units = ((names[0], "MS to s"), (names[1], "CM to mm"), (names[2], "KN to N"))
    assert_read(path, truth, tuple(f"column {name!r} is converted from {how}" for name, how in units), names)


def test_a_force_that_the_study_names_as_displacement_is_refused(tmp_path, truth):
    names = ("Time (s)", "Extension (mm)", "Load (N)")
    path = write(tmp_path / "a.csv", ["\t".join(names), *rows(truth)])
    with pytest.raises(TraceError, match=r"the unit 'N' of column 'Load \(N\)' is none of mm, "):
        read_trace(path, (names[0], names[2], names[1]))


def clock(seconds, form):
    start = datetime.datetime(2026, 3, 1, 23, 59, 57)
    return [(start + datetime.timedelta(seconds=s)).strftime(form) for s in seconds]


@pytest.mark.parametrize(
    "form", ["%H:%M:%S.%f", "%H:%M:%S,%f", "%Y-%m-%dT%H:%M:%S.%fZ", "%d.%m.%Y %H:%M:%S.%f", "%I:%M:%S.%f %p"]
)
def test_times_of_day_are_counted_from_the_first_and_may_pass_midnight(tmp_path, truth, form):
    cells = zip(clock(truth[0], form), rows(truth[1:]))
    path = write(tmp_path / "a.csv", ["\t".join(NAMES), *("\t".join(row) for row in cells)])
    assert_read(path, truth, ("the times of day in column 'Time' are counted from the first",))


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (
            ["Time\tExtension\tLoad", "s\tmm\tV"],
            "units: the unit 'V' of column 'Load' is none of N, .*force_N",
        ),
        (["Time\tExtension\tLoad", "s\tmm\tMN"], "the unit 'MN' of column 'Load' is none of N, .*force_N"),
        (
            ["Zeit\tWeg\tKraft", "s\tmm\tN"],
            r"no column 'Time'; it has 'Zeit', 'Weg', 'Kraft'; .*\] time_s = ",
        ),
        (["Limb\t1", "Zeit\tWeg\tKraft", "s\tmm\tN"], "no column 'Time'; it has 'Zeit', 'Weg', 'Kraft';"),
        (["Limb\t1", "Time\tExtension\tKraft"], r"no column 'Load'; it has .*'Kraft'; .*\[traces\] force_N"),
    ],
)
def test_what_would_need_a_guess_is_refused_and_the_column_option_named(tmp_path, truth, lines, says):
    with pytest.raises(TraceError, match=says):
        read_trace(write(tmp_path / "a.csv", lines + rows(truth)), NAMES)


@pytest.mark.parametrize("unit", ["kg", "Kg", "KG", "g", "lb", "V", "kPa", "mm", "MN"])
def test_a_unit_beside_the_name_that_is_no_force_is_refused(tmp_path, truth, unit):
    names = ("Time", "Extension", f"Load [{unit}]")
    path = write(tmp_path / "a.csv", ["\t".join(names), *rows(truth)])
    with pytest.raises(
        TraceError, match=rf"units: the unit '{unit}' of column 'Load \[{unit}\]' is none of N, "
    ):
        read_trace(path, names)


def test_units_that_contradict_each_other_are_refused(tmp_path, truth):
    lines = ["Time\tExtension (m)\tLoad", "s\tmm\tN", *rows(truth)]
    with pytest.raises(TraceError, match=r"the unit 'mm and m' of column .*displacement_mm = "):
        read_trace(write(tmp_path / "a.csv", lines), ("Time", "Extension (m)", "Load"))


def test_two_columns_of_one_name_are_refused_unless_they_are_the_same(tmp_path, truth):
    header = "\t".join((*NAMES, "Load"))
    assert_read(write(tmp_path / "a.csv", [header, *rows(truth[[0, 1, 2, 2]])]), truth, ())
    path = write(tmp_path / "a.csv", [header, *rows(truth[[0, 1, 2, 1]])])
    with pytest.raises(TraceError, match=r"2 columns are named 'Load'; .*\[traces\] force_N"):
        read_trace(path, NAMES)


def test_times_that_are_no_clock_are_refused(tmp_path, truth):
    cells = list(zip(clock(truth[0], "%H:%M:%S.%f"), rows(truth[1:])))
    cells[4] = ("12:60", cells[4][1])
    path = write(tmp_path / "a.csv", ["\t".join(NAMES), *("\t".join(row) for row in cells)])
    with pytest.raises(TraceError, match="line 6, column Time: '12:60' is not a time of day"):
        read_trace(path, NAMES)


def test_files_that_go_with_a_record_need_its_own_clock(tmp_path):
    path = write(tmp_path / "a.csv", ["Time,muscle_mm", "12:00:01.0,20", "12:00:02.0,19"])
    with pytest.raises(TraceError, match=r"'12:00:01\.0' is not a number"):
        read_layers(path, "Time")
    path = write(tmp_path / "a.csv", ["Time,muscle_mm", "ms,cm", "1000,2", "2000,1.9"])
    assert read_layers(path, "Time").time_s == pytest.approx([1, 2])
    assert read_layers(path, "Time").thickness_mm["muscle"] == pytest.approx([20, 19])


# --- LabVIEW


def lvm_header(x_columns, units=("Newtons", "mm"), step="0.02", gap="\t"):
    return [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab",
        "Decimal_Separator\t.", "Multi_Headings\tYes", f"X_Columns\t{x_columns}", "Time_Pref\tRelative",
        "Operator\tNN", "Date\t2026/03/01", "Time\t11:59:39.849", "***End_of_Header***\t", "\t",
        *lvm_segment(units, "0.0", step, gap),
    ]  # fmt: skip


def lvm_segment(units=("Newtons", "mm"), start="0.0", step="0.02", gap="\t"):
    def of_each(tag, one, other):
        return f"{tag}\t{one}{gap}{other}\t"

    return [
        "Channels\t2\t\t", of_each("Samples", "500", "500"), of_each("Date", "2026/03/01", "2026/03/01"),
        of_each("Time", "11:59:39", "11:59:39"), of_each("Y_Unit_Label", *units),
        of_each("X_Dimension", "Time", "Time"), of_each("X0", start, start), of_each("Delta_X", step, step),
        "***End_of_Header***\t\t\t",
    ]  # fmt: skip


LVM_NAMES = ("time_s", "Extension", "Load")  # the first as the study's default is


def test_lvm_with_one_column_of_times(tmp_path, truth):
    lines = [*lvm_header("One", ("kN", "mm")), "X_Value\tLoad\tExtension\tComment"]
    table = truth[[0, 2, 1]] * [[1], [1e-3], [1]]
    notes = ("the times are LabVIEW's X_Value", "column 'Load' is converted from kN to N")
    assert_read(write(tmp_path / "a.lvm", lines + rows(table)), truth, notes, LVM_NAMES)


def test_lvm_with_a_column_of_times_for_each_channel(tmp_path, truth):
    lines = [*lvm_header("Multi", gap="\t\t"), "X_Value\tLoad\tX_Value\tExtension\tComment"]
    path = write(tmp_path / "a.lvm", lines + rows(truth[[0, 2, 0, 1]]))
    assert_read(path, truth, ("the times are LabVIEW's X_Value",), LVM_NAMES)
    other = truth[[0, 2, 0, 1]] + [[0], [0], [0.1], [0]]
    with pytest.raises(TraceError, match="2 columns are named 'time_s'"):
        read_trace(write(tmp_path / "a.lvm", lines + rows(other)), LVM_NAMES)


def test_lvm_without_times_states_their_step(tmp_path, truth):
    """In two segments, with decimal commas."""
    half = 200
    names = "X_Value\tLoad\tExtension\tComment"
    lines = [*lvm_header("No", step="0,02"), names]
    lines += ["\t" + row for row in rows(truth[[2, 1], :half], decimal=",")]
    lines += ["", *lvm_segment(start=f"{truth[0, half]:g}".replace(".", ","), step="0,02"), names]
    lines += ["\t" + row for row in rows(truth[[2, 1], half:], decimal=",")]
    path = write(tmp_path / "a.lvm", lines)
    assert_read(path, truth, ("the times are LabVIEW's X_Value",), LVM_NAMES)


def test_lvm_whose_channels_are_sampled_at_other_times_is_refused(tmp_path, truth):
    lines = [*lvm_header("No"), "X_Value\tLoad\tExtension\tComment"]
    lines = [line.replace("Delta_X\t0.02\t0.02", "Delta_X\t0.02\t0.01") for line in lines]
    path = write(tmp_path / "a.lvm", lines + ["\t" + row for row in rows(truth[[2, 1]])])
    with pytest.raises(
        TraceError, match=r"Delta_X: its channels are not sampled at the same times; .*time_s"
    ):
        read_trace(path, LVM_NAMES)


def test_lvm_without_names_of_its_channels_is_refused(tmp_path, truth):
    path = write(tmp_path / "a.lvm", lvm_header("One")[:12] + rows(truth))
    with pytest.raises(TraceError, match="header: no column 'time_s'"):
        read_trace(path, LVM_NAMES)
    with pytest.raises(TraceError, match="empty"):
        read_trace(write(tmp_path / "a.lvm", lvm_header("One")), LVM_NAMES)


# --- TDMS


def write_tdms(path, *groups):
    with TdmsWriter(path) as file:
        for name, channels in groups:
            file.write_segment([ChannelObject(name, *channel) for channel in channels])
    return path


def test_tdms_with_a_channel_of_times_and_units(tmp_path, truth):
    units = ({"unit_string": "ms"}, {"unit_string": "mm"}, {"unit_string": "N"})
    channels = list(zip(NAMES, truth * [[1e3], [1], [1]], units))
    path = write_tdms(tmp_path / "a.tdms", ("Config", [("gain", np.ones(3))]), ("Log", channels))
    assert_read(path, truth, ("column 'Time' is converted from ms to s",))


def test_tdms_with_waveforms(tmp_path, truth):
    wave = {"wf_increment": 0.02, "wf_start_offset": 0.0, "wf_samples": truth.shape[1]}
    channels = [("Extension", truth[1], wave), ("Load", truth[2], wave)]
    path = write_tdms(tmp_path / "a.tdms", ("Log", channels))
    assert_read(path, truth, ("the times are those of the waveform",), LVM_NAMES)
    channels[1] = ("Load", truth[2], wave | {"wf_increment": 0.01})
    with pytest.raises(TraceError, match=r"no column 'time_s'; .*\[traces\] time_s"):
        read_trace(write_tdms(tmp_path / "b.tdms", ("Log", channels)), LVM_NAMES)


def test_tdms_with_time_stamps(tmp_path, truth):
    stamps = np.datetime64("2026-03-01T23:59:57") + np.round(truth[0] * 1e6).astype("timedelta64[us]")
    path = write_tdms(tmp_path / "a.tdms", ("Log", list(zip(NAMES, [stamps, *truth[1:]]))))
    assert_read(path, truth, ("the time stamps in column 'Time' are counted from the first",))


def test_tdms_that_cannot_be_used_is_refused(tmp_path, truth):
    groups = [(name, list(zip(NAMES, truth))) for name in ("first", "second")]
    with pytest.raises(TraceError, match="2 of its groups hold these channels; save one"):
        read_trace(write_tdms(tmp_path / "a.tdms", *groups), NAMES)
    (tmp_path / "b.tdms").write_bytes(b"nonsense" * 100)
    with pytest.raises(TraceError, match="not a readable TDMS file"):
        read_trace(tmp_path / "b.tdms", NAMES)


# --- Excel


def write_excel(path, **sheets):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, lines in sheets.items():
        sheet = book.create_sheet(name)
        for line in lines:
            sheet.append(line)
    book.save(path)
    return path


def test_excel_with_a_preamble_units_and_a_second_sheet(tmp_path, truth):
    table = [["Limb", 1], [], list(NAMES), ["s", "mm", "mN"], *(truth.T * [1, 1, 1e3]).tolist()]
    path = write_excel(tmp_path / "a.xlsx", Results=[["Peak", 5.0]], Data=table)
    notes = ("what stands before the header in line 3 is skipped", "column 'Load' is converted from mN to N")
    assert_read(path, truth, notes)


def test_excel_with_times_of_day(tmp_path, truth):
    start = datetime.datetime(2026, 3, 1, 11, 59, 57)
    times = [start + datetime.timedelta(milliseconds=round(1e3 * s)) for s in truth[0]]
    lines = [list(NAMES), *([t, *row] for t, row in zip(times, truth[1:].T.tolist()))]
    path = write_excel(tmp_path / "a.xlsx", Data=lines)
    assert_read(path, truth, ("the times of day in column 'Time' are counted from the first",))


def test_excel_that_cannot_be_used_is_refused(tmp_path, truth):
    lines = [list(NAMES), *truth.T.tolist()]
    with pytest.raises(TraceError, match="the sheets A, B all hold these columns; keep one"):
        read_trace(write_excel(tmp_path / "a.xlsx", A=lines, B=lines), NAMES)
    with pytest.raises(TraceError, match=r"no column 'time_s'; it has 'Time', .*\[traces\] time_s"):
        read_trace(write_excel(tmp_path / "b.xlsx", A=lines))
    (tmp_path / "c.xlsx").write_bytes(b"nonsense" * 100)
    with pytest.raises(TraceError, match="not a readable Excel file"):
        read_trace(tmp_path / "c.xlsx", NAMES)
    (tmp_path / "c.xls").write_bytes(b"nonsense" * 100)
    with pytest.raises(TraceError, match=r"before 2007; save it as \.xlsx"):
        read_trace(tmp_path / "c.xls", NAMES)


@pytest.mark.parametrize(("module", "extra"), [("nptdms", "tdms"), ("openpyxl", "excel")])
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, module, extra):
    path = tmp_path / f"a.{'tdms' if extra == 'tdms' else 'xlsx'}"
    path.write_bytes(b"")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(TraceError, match=rf"is not installed; pip install 'limbfit\[{extra}\]', or export"):
        read_trace(path, NAMES)


@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", "."), ("\t", "."), (";", ",")])
def test_tables_of_all_flavours_read_the_same(tmp_path, truth, delimiter, decimal):
    lines = [delimiter.join(COLUMNS), *rows(truth, delimiter, decimal=decimal)]
    assert_read(write(tmp_path / "a.csv", lines), truth, (), COLUMNS)


def test_columns_are_found_by_name_whatever_their_order_and_company(tmp_path, truth):
    cells = (f"{t:.6f},x,{f:.6f},{d:.6f}" for t, d, f in truth.T)
    path = write(tmp_path / "a.csv", ["# recorded on a Monday", '"t","note","F","u"', *cells], "utf-8-sig")
    assert_read(path, truth, (), ("t", "u", "F"))


@pytest.mark.parametrize("struct", [False, True])
def test_mat_files_hold_vectors_or_one_struct(tmp_path, truth, struct):
    content = dict(zip(COLUMNS, (truth[0][:, None], truth[1][None], truth[2])))
    savemat(tmp_path / "a.mat", {"record": content} if struct else content)
    read = read_trace(tmp_path / "a.mat")
    assert np.array_equal([read.time_s, read.displacement_mm, read.force_N], truth)


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
def test_broken_tables_are_refused_with_file_place_and_remedy(tmp_path, truth, edit, says):
    lines = [",".join(COLUMNS), *rows(truth, ",")]
    edit(lines)
    path = write(tmp_path / "a.csv", lines)
    with pytest.raises(TraceError, match=says) as caught:
        read_trace(path)
    assert str(path) in str(caught.value)


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


def test_broken_mat_files_are_refused(tmp_path, truth):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + bytes(500))
    with pytest.raises(TraceError, match=r"version 7\.3; save it in MATLAB with '-v7'"):
        read_trace(path)
    for content in (b"", b"nonsense" * 100, bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(TraceError, match="not a readable MAT file"):
            read_trace(path)
    columns = dict(zip(COLUMNS, truth[:2]))
    savemat(path, columns | {"force_N": np.ones((4, 4))})
    with pytest.raises(TraceError, match="force_N: not a vector of real numbers"):
        read_trace(path)
    savemat(path, columns | {"force_N": "text"})
    with pytest.raises(TraceError, match="force_N: not a vector"):
        read_trace(path)
    savemat(path, columns)
    with pytest.raises(TraceError, match="no column 'force_N'"):
        read_trace(path)
    savemat(path, columns | {"force_N": truth[2, :-1]})
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


@pytest.mark.parametrize("offset_N", [-50.0, 300.0])
def test_a_force_is_plausible_by_its_rise_whatever_the_zero_of_its_sensor(offset_N):
    trace, _ = record(rate=100)
    check_trace(Trace(trace.time_s, trace.displacement_mm, trace.force_N + offset_N))


def test_an_indenter_that_goes_farther_back_than_it_began_has_no_wrong_sign():
    trace, _ = record(rate=100)
    time = np.arange(1, 2001) / 100
    home = Trace(
        np.r_[trace.time_s, trace.time_s[-1] + time],
        np.r_[trace.displacement_mm, -time],
        np.r_[trace.force_N, np.zeros_like(time)],
    )
    check_trace(home)
    with pytest.raises(TraceError, match="the displacement falls"):
        check_trace(Trace(home.time_s, -home.displacement_mm, home.force_N))


@pytest.mark.parametrize(("point", "comma"), [(".", ","), (",", ".")])
def test_signs_between_thousands_are_refused(tmp_path, truth, point, comma):
    """1,234 mN beside 0.02 s would be read as 1.234 mN."""
    table = [f"{t:.3f};{u:.3f};{1000 * f:,.0f}" for t, u, f in truth.T]
    signs = str.maketrans({".": point, ",": comma})
    path = write(tmp_path / "a.csv", ["Time;Extension;Load (mN)", *(row.translate(signs) for row in table)])
    with pytest.raises(
        TraceError, match=r"has a comma, and .* a point; export numbers with one decimal sign"
    ):
        read_trace(path, ("Time", "Extension", "Load (mN)"))


def test_names_with_commas_in_a_file_with_semicolons_are_found(tmp_path, truth):
    names = ("Time, s", "Way, mm", "Load, N")
    path = write(tmp_path / "a.csv", [";".join(names), *rows(truth, ";")])
    assert_read(path, truth, (), names)
