"""Malformed, spoilt, replayed, reordered and oversized lines: refused, counted, never acted on."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_process import Bench, connect, device, session_in

from limbfit.acquire.line_protocol import (
    DEVICE_LINE,
    HOST_LINE,
    PINS,
    Acceptance,
    Bye,
    Decoder,
    Encoder,
    Fence,
    Heartbeat,
    Hello,
    Hold,
    Identity,
    LimitTrip,
    Move,
    NotePhase,
    NoteSite,
    Rejection,
    Sample,
    SetLimits,
    Stop,
    StuckPins,
    derive_salt,
    format_sample,
    parse_command,
    parse_report,
)
from limbfit.acquire.protocol import Phase

COMMANDS = [
    Hello(1, "0123456789abcdef"),
    SetLimits(3, 25_000, 25_000, 60_000, 8000, 20),
    NoteSite("patella-1"),
    NotePhase("clamp"),
    Heartbeat(123_456_789),
    Bye(),
    Move(14, 12_345, 960, 18_000),
    Hold(1),
    Stop(""),
    Fence(2, 30_000),
]
WHO = Identity(1, "f" * 16, 14, 500, 60_000, 50_000, 12_500, "real", "FitSocket-2", "SN.12", "2024-05-01")
SAMPLE = Sample(7, 123_456, 8, 5, tuple(range(PINS)), tuple(range(-7, 7)), tuple(range(100, 114)))
REPORTS = [WHO, Acceptance(5), Rejection(6, "speed"), LimitTrip("watchdog", 0), StuckPins(0b101), SAMPLE]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: type(c).__name__)
def test_commands_survive_the_wire(command) -> None:
    number, line = Encoder(salt=9, first=41).encode(command.body)
    assert len(line) <= HOST_LINE
    (found,) = Decoder(HOST_LINE, salt=9, last=40).feed(line)
    assert found.number == number == 41
    assert parse_command(found.body) == command


@pytest.mark.parametrize("report", REPORTS, ids=lambda r: type(r).__name__)
def test_reports_survive_the_wire(report) -> None:
    body = format_sample(report) if isinstance(report, Sample) else report.body
    assert parse_report(body, 7) == report


@pytest.mark.parametrize(
    "body",
    [
        *("MOVE 0 1 1 0", "MOVE 15 1 1 0", "MOVE 1 -5 1 0", "MOVE 1 1 0 0", "MOVE 1 1 1", "MOVE 1 1 1 0 0"),
        *(
            "MOVE 1 1e3 1 0",
            "MOVE 1 1_0 1 0",
            "MOVE 1  1 1 0",
            "MOVE 1 ١ 1 0",
            "MOVE 1 2000000 1 0",
            "move 1 1 1 0",
        ),
        *(
            "STOP now",
            "HOLD all",
            "LIMITS 1 0 1 1 1 1",
            "SITE a b",
            "SITE ../x",
            "SITE \x1b[2J",
            "",
            "FENCE 1 0",
        ),
        *("HELLO 1 nonce", "HELLO one 0123456789abcdef", "BEAT", "EXEC 1"),
    ],
)
def test_what_is_no_command_is_none(body: str) -> None:
    assert parse_command(body) is None


@pytest.mark.parametrize(
    "body",
    [
        WHO.body.replace("FitSocket-2", "Fit\x1b[31mSocket"),
        WHO.body.replace("SN.12", "A" * 41),
        WHO.body.replace("500", "-500"),
        WHO.body + " more",
        "S 1,2,3",
        format_sample(SAMPLE) + ",1",
        format_sample(SAMPLE).replace("100", "nan"),
        *("OK", "OK x", "STUCK 99999999", "FAULT watch dog", "FAULT x 15", "NO 1 <b>"),
    ],
)
def test_what_is_no_report_is_none(body: str) -> None:
    assert parse_report(body, 1) is None


@settings(deadline=None, derandomize=True)
@given(st.lists(st.binary(max_size=300), max_size=8), st.integers(1, 50))
def test_noise_between_lines_costs_no_line_and_no_memory(noise: list[bytes], chunk: int) -> None:
    """Whatever comes, in whatever pieces: sound lines get through, nothing else does, little is held."""
    encoder, decoder = Encoder(salt=5), Decoder(HOST_LINE, salt=5)
    data, sent = b"", []
    for part in noise:
        number, line = encoder.encode("STOP")
        sent.append(number)
        data += part + b"\n" + line
    found = []
    for at in range(0, len(data), chunk):
        found += decoder.feed(data[at : at + chunk])
        assert len(decoder._rest) < HOST_LINE
    assert [line.number for line in found] == sent


def test_every_refusal_is_counted() -> None:
    encoder, decoder = Encoder(salt=5), Decoder(HOST_LINE, salt=5)
    lines = [encoder.encode(f"HOLD {pin}")[1] for pin in (1, 2, 3, 4, 5)]
    assert len(decoder.feed(lines[1])) == 1
    assert decoder.refused.missing == 1
    assert decoder.feed(lines[0]) == []  # out of order
    assert decoder.feed(lines[1]) == []  # again
    assert decoder.refused.replayed == 2
    assert decoder.feed(lines[2].replace(b"HOLD 3", b"HOLD 9")) == []
    assert decoder.feed(Encoder(salt=6, first=9).encode("HOLD 1")[1]) == []  # of another session
    assert decoder.refused.checksum == 2
    assert decoder.feed(b"HOLD 1\n\x00\xff\n4 HOLD 1*zzzzzzzz\n") == []
    assert decoder.refused.malformed == 3
    assert decoder.feed(b"9" * 10_000) == []
    assert decoder.feed(b"9" * 10_000 + b"\n") == []
    assert decoder.refused.oversized == 1
    assert len(decoder.feed(lines[4])) == 1
    assert decoder.refused.total == 8


def hostile(bench: Bench) -> dict[str, bytes]:
    """Lines that would move pin 1 in, were they believed."""
    move = Move(1, 50_000, 8000).body
    end = bench.wire._encoder
    again = next(line for line in reversed(bench.link.sent) if b"MOVE" in line)
    return {
        "malformed": move.encode() + b"\n",
        "checksum": f"{end.next + 5} {move}*00000000\n".encode(),
        "replayed": again,
        "oversized": f"{end.next + 5} {move}".encode() + b" " * 5000 + b"*00000000\n",
        "unknown": Encoder(end.salt, end.next + 5).encode("MOVE 1 50000 8000 0 now")[1],
    }


@pytest.mark.parametrize("kind", ["malformed", "checksum", "replayed", "oversized", "unknown"])
def test_the_device_acts_on_none_of_them(kind: str) -> None:
    bench = session_in(Phase.READY)
    motors, refused = bench.device.motors, bench.device.refusals
    before = getattr(refused, kind)
    line = hostile(bench)[kind]
    answer = bench.device.feed(line)
    assert answer == b""
    assert not motors.driving.any()
    # A replayed burst may hold several lines, each refused.
    assert getattr(refused, kind) == before + line.count(b"\n")


def test_moves_beyond_the_limits_are_declined() -> None:
    wire = connect(device())
    wire.send(SetLimits(1, 25_000, 25_000, 30_000, 8000, 500), 0.0)
    for move, code in ((Move(1, 40_000, 1000), "position"), (Move(1, 20_000, 9000), "speed")):
        wire.send(move, 0.0)
        assert [r.code for r in wire.receive() if isinstance(r, Rejection)] == [code]
    wire.send(Stop(""), 0.0)
    wire.send(Move(1, 20_000, 1000), 0.0)
    assert [r.code for r in wire.receive() if isinstance(r, Rejection)] == ["stopped"]
    assert not wire._link.far.motors.driving.any()


def test_nothing_moves_without_a_session() -> None:
    far = device()
    assert far.feed(Encoder().encode(Move(1, 20_000, 1000).body)[1]) == b""
    assert not far.motors.driving.any()
    wire = connect(far)
    wire.send(Move(1, 20_000, 1000), 0.0)
    assert [r.code for r in wire.receive() if isinstance(r, Rejection)] == ["not-armed"]


def test_the_documented_exchange_is_what_is_spoken() -> None:
    page = (Path(__file__).parents[2] / "docs" / "device-protocol.md").read_text(encoding="utf-8")
    lines = [line[6:].encode() + b"\n" for line in page.split("\n") if line.startswith(("    > ", "    < "))]
    hello, who, limits, accepted, _, beat = lines
    device_end, host_end = Decoder(HOST_LINE, numbered=False), Decoder(DEVICE_LINE, numbered=False)
    (greeting,), (answer,) = device_end.feed(hello), host_end.feed(who)
    greeted, identity = parse_command(greeting.body), parse_report(answer.body, answer.number)
    salt = derive_salt(greeted.nonce, identity.nonce)
    device_end.restart(salt)
    host_end.restart(salt)
    assert [parse_command(line.body) for line in device_end.feed(limits + beat)] == [
        SetLimits(1, 25_000, 25_000, 60_000, 8000, 20),
        Heartbeat(2),
    ]
    assert [parse_report(line.body, line.number) for line in host_end.feed(accepted)] == [Acceptance(1)]
    assert device_end.refused.total == host_end.refused.total == 0
