"""Records: what was written is read, whatever a crash or a bad disk leaves of it."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_process import Bench

from editing import append, edit
from limbfit import check_recording, load_study
from limbfit.acquire import Recorder, check_record, find_ramps, follow_recording, read_recording
from limbfit.acquire.line_protocol import PINS, Sample
from limbfit.acquire.recording import RecordedRamp, list_columns
from limbfit.errors import InputError, TraceError
from limbfit.pipeline.commands.acquire import write_ramp
from limbfit.traces import COLUMNS as TRACE_COLUMNS
from limbfit.traces import Trace, find_touch_down, read_trace, regularise


def sample(number: int) -> Sample:
    return Sample(number, 2000 * number, 8, 0, (number,) * PINS, (-number,) * PINS, (5,) * PINS)


def write(file, rows: int) -> None:
    recorder = Recorder(file, {"site": "1", "settings": {"pin": 1}})
    for number in range(1, rows + 1):
        recorder.sample(sample(number), 2000 * number + 300)
        if number == 30:
            recorder.event("phase", 60_400, phase="clamp")
    recorder.close()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    file = tmp_path_factory.mktemp("record") / "record.csv"
    write(file, 130)
    return file


def test_what_was_written_is_read(written) -> None:
    found = read_recording(written)
    assert found.head["site"] == "1"
    assert found.lost_bytes == 0
    assert found.number.tolist() == list(range(1, 131))
    assert (found.force_mN == -found.number[:, None]).all()
    assert found.phases() == [("clamp", 60_400, 260_301)]


def test_a_ramp_is_written_in_the_units_that_the_names_of_the_columns_state(study) -> None:
    """Whatever writes the study's other records, ``limbfit acquire`` measures in s, mm and N."""
    made, read = write_under(study, ("Time (ms)", "Depth (cm)", "Load (kN)"))
    for key in TRACE_COLUMNS:
        np.testing.assert_allclose(getattr(read, key), getattr(made, key), rtol=1e-4, atol=1e-4)


def write_under(study, names) -> tuple[Trace, Trace]:
    """A ramp, and what is read of it once it is written under names of columns."""
    made = read_trace(study / "1.csv")
    stated = "\n".join(f'{key} = "{name}"' for key, name in zip(TRACE_COLUMNS, names))
    append(study, f"[traces]\n{stated}\n")
    write_ramp(load_study(study), study / "ramp.csv", RecordedRamp(1, made))
    return made, read_trace(study / "ramp.csv", names)


def test_any_table_reader_reads_the_rows(written) -> None:
    table = np.genfromtxt(written, delimiter=",", names=True, comments="#", skip_header=2)
    assert table.dtype.names == list_columns(14)
    assert table["p3_um"].tolist() == list(range(1, 131))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(share=st.floats(0, 1))
def test_a_record_cut_anywhere_is_read_up_to_a_tenth_of_a_second(written, tmp_path_factory, share) -> None:
    data = written.read_bytes()
    cut = data[: int(share * len(data))]
    file = tmp_path_factory.mktemp("cut") / "record.csv"
    file.write_bytes(cut)
    whole = len([line for line in cut.split(b"\n")[:-1] if line[:1].isdigit()])
    if cut.find(b"#block 0 ") < 0 or b"\n" not in cut[cut.find(b"#block 0 ") :]:
        with pytest.raises(TraceError):
            read_recording(file)
    else:
        found = read_recording(file)
        assert whole - len(found.number) <= 50  # 0.1 s
        assert found.number.tolist() == list(range(1, len(found.number) + 1))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(share=st.floats(0, 0.999), byte=st.integers(0, 255))
def test_a_damaged_byte_is_never_believed(written, tmp_path_factory, share, byte) -> None:
    data = bytearray(written.read_bytes())
    at = int(share * len(data))
    if data[at] == byte:
        return
    data[at] = byte
    file = tmp_path_factory.mktemp("damage") / "record.csv"
    file.write_bytes(data)
    try:
        found = read_recording(file)
    except TraceError:
        return
    assert found.number.tolist() == list(range(1, len(found.number) + 1))
    assert (found.position_um == found.number[:, None]).all()
    assert found.lost_bytes > 0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(shares=st.lists(st.floats(0, 1), max_size=5), every=st.sampled_from([1, 5, 25]))
def test_a_record_that_grows_is_followed_without_a_gap(written, tmp_path_factory, shares, every) -> None:
    data, whole = written.read_bytes(), read_recording(written)
    file = tmp_path_factory.mktemp("grown") / "record.csv"
    head = data.index(b"#block 0 ") + 100
    offset, seen, events = 0, [], []
    for length in sorted([*(head + int(share * (len(data) - head)) for share in shares), len(data)]):
        file.write_bytes(data[:length])
        part, offset = follow_recording(file, offset, every=every)
        seen += part.number.tolist()
        events += part.events
        assert part.head == whole.head
        assert part.lost_bytes == length - offset
    assert seen == whole.number[every - 1 :: every].tolist()
    assert tuple(events) == whole.events


@settings(max_examples=60, deadline=None, derandomize=True)
@given(share=st.floats(0, 0.999), byte=st.integers(0, 255))
def test_a_damaged_byte_is_never_followed(written, tmp_path_factory, share, byte) -> None:
    data = bytearray(written.read_bytes())
    data[int(share * len(data))] = byte
    file = tmp_path_factory.mktemp("damage") / "record.csv"
    file.write_bytes(data)
    try:
        found, offset = follow_recording(file)
        numbers = [*found.number, *follow_recording(file, offset)[0].number]
    except TraceError:
        return
    assert numbers == list(range(1, len(numbers) + 1))
    assert (found.position_um == found.number[:, None]).all()


@pytest.mark.parametrize("content", [b"", b"time,force\n1,2\n", b"#limbfit-recording 1\n", b"\xff" * 100])
def test_what_is_no_record_is_refused(tmp_path, content: bytes) -> None:
    file = tmp_path / "record.csv"
    file.write_bytes(content)
    with pytest.raises(TraceError):
        read_recording(file)


def test_a_record_is_never_overwritten(written) -> None:
    with pytest.raises(FileExistsError):
        Recorder(written, {})


def session(file, **changes):
    """A whole session, recorded."""
    bench = Bench(depth_mm=3.0, precondition=1, settle_s=0.5, **changes)
    stated = ("pin", "repeats", "precondition", "ramp_speed_mm_s")
    settings = {key: getattr(bench.settings, key) for key in stated}
    recorder = bench.session.recorder = Recorder(
        file, {"site": "1", "settings": settings, "device": {"range_mN": 50_000}}
    )
    bench.until()
    recorder.close()
    return bench, read_recording(file)


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """A good session, whose ramps are held."""
    file = tmp_path_factory.mktemp("session") / "record.csv"
    return session(file, repeats=1, ramp_speed_mm_s=2.5, hold_s=0.6, pause_s=2.0)


def checks(recording) -> dict[str, bool | None]:
    return {check.name: check.passed for check in check_record(recording).checks}


def test_a_good_session_is_called_good_and_its_ramps_are_kept_with_their_holds(held) -> None:
    bench, recording = held
    verdict = check_record(recording)
    assert verdict.is_good, verdict
    found = find_ramps(recording)
    assert [ramp.cycle for ramp in found] == [1, 2]
    protocol = bench.session.protocol
    depth = (protocol.depth_um - protocol.start_um) / 1000
    for ramp in found:
        assert ramp.trace.displacement_mm.max() == pytest.approx(depth, abs=0.02)
        assert np.allclose(np.diff(ramp.trace.time_s), 0.002)
        assert abs(ramp.trace.displacement_mm[[0, -1]]).max() < 0.1
    curve = regularise(found[1].trace, find_touch_down(found[1].trace))
    assert [phase.kind for phase in curve.phases] == ["load", "hold", "unload"]
    hold = curve.phases[1]
    assert hold.duration_s == pytest.approx(0.6, abs=0.1)
    inside = (curve.time_s > hold.start_s + 0.1) & (curve.time_s < hold.end_s - 0.1)
    assert np.diff(curve.force_N[inside])[[0, -1]].max() < 0.0  # it relaxes


def test_what_is_wrong_is_named(held) -> None:
    recording = deepcopy(held[1])
    recording.head["settings"]["ramp_speed_mm_s"] = 0.96  # and the device ran at 2.5 mm/s
    assert checks(recording)["speed"] is False
    recording.force_mN[recording.host_us > 3_000_000, 0] += 400
    recording.force_mN[100, 7] = 50_000
    found = checks(recording)
    assert found["drift"] is False
    assert found["saturation"] is False
    keep = np.ones(len(recording.number), dtype=bool)
    keep[200:220] = False
    arrays = {name: value for name, value in vars(recording).items() if isinstance(value, np.ndarray)}
    thinned = replace(recording, **{name: value[keep] for name, value in arrays.items()})
    assert checks(thinned)["samples"] is False


@pytest.mark.slow
def test_ramps_that_do_not_repeat_are_named(tmp_path) -> None:
    _, recording = session(tmp_path / "record.csv", repeats=2, ramp_speed_mm_s=1.4, pause_s=3.0)
    assert checks(recording)["repeatability"] is True
    second = [event["at_us"] for event in recording.events if event.get("phase") == "load"][2]
    recording.force_mN[recording.host_us > second, 0] *= 2
    assert checks(recording)["repeatability"] is False


@pytest.mark.parametrize(
    ("trace", "what"),
    [
        ("../elsewhere.csv", "../elsewhere.csv lies outside the study's folder; nothing is recorded"),
        ("/elsewhere/1.csv", "/elsewhere/1.csv lies outside the study's folder; nothing is recorded"),
        ("1.xlsx", r"written as text, which 1\.xlsx is not; name a file \.csv"),
    ],
)
def test_a_record_that_cannot_be_kept_is_refused_before_it_is_made(study, trace, what):
    edit(study, "1.csv", trace)
    with pytest.raises(InputError, match=what):
        check_recording(load_study(study, recorded=False), "1", depth_mm=5.0)


def test_a_ramp_under_names_with_commas_is_read_back(study):
    made, read = write_under(study, ("Time, s", "Way, mm", "Load, N"))
    assert read.force_N == pytest.approx(made.force_N)
