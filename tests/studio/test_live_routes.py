"""A session followed through the studio while its record is written: all of it, once, and nothing else."""

import json
import os
import time

import numpy as np
import pytest
from serving_here import open_page

from limbfit.acquire import Recorder
from limbfit.acquire.line_protocol import PINS, Sample
from limbfit.acquire.recording import FOLLOWED_BYTES

STAMP = "20260102T030405.678"
HEAD = {
    "site": "1",
    "settings": {"pin": 3, "force_limit_N": 25.0, "precondition": 1, "repeats": 2},
}


@pytest.fixture
def client(study):
    return open_page(study)


class Session:
    """A session's record, written piece by piece: the test pin at n um with n mN in sample n."""

    def __init__(self, study, site: str = "1", stamp: str = STAMP, head: dict = HEAD) -> None:
        self.folder = study / "acquired" / site / stamp
        self.folder.mkdir(parents=True)
        self.file = self.folder / "record.csv"
        self.recorder = Recorder(self.file, head)
        self.count = 0

    def samples(self, count: int) -> None:
        for _ in range(count):
            self.count += 1
            row = tuple(self.count if pin == 3 else -1 for pin in range(1, PINS + 1))
            self.recorder.sample(
                Sample(self.count, 2000 * self.count, 8, 0, row, row, (5,) * PINS), 2000 * self.count
            )
        # The writer is another thread.
        end = time.monotonic() + 20
        while self.file.read_bytes().count(b"\n#block ") < 1 + self.count // 25:
            assert time.monotonic() < end
            time.sleep(0.01)

    def phase(self, phase: str, **facts) -> None:
        self.recorder.event("phase", 2000 * self.count, phase=phase, **{"cycle": 0} | facts)

    def age(self, seconds: float) -> None:
        at = time.time() - seconds
        os.utime(self.file, (at, at))


def get(client, offset: int = 0, site: str = "1", stamp: str = STAMP) -> dict:
    answer = client.get(f"/api/live/{site}/{stamp}", params={"offset": offset})
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_nothing_is_recorded(client):
    assert client.get("/api/live").json() == {"session": None}


def test_what_is_new_comes_once_and_in_order(client, study):
    session = Session(study)
    assert client.get("/api/live").json()["session"] == {"site": "1", "time": STAMP}
    seen, phases, offset = [], [], 0
    for turn, phase in enumerate(["position", "clamp", "load"]):
        session.phase(phase, cycle=turn, **({"touch_um": 20} if turn else {}))
        session.samples(100 + 25 * turn)
        part = get(client, offset)
        assert part["offset"] > offset
        assert not part["more"]
        assert not part["silent"]
        assert (part["head"] is None) == (turn > 0)
        offset = part["offset"]
        seen += part["force_N"]
        phases += part["phases"]
        assert part["position_mm"] == part["force_N"]
        assert get(client, offset)["force_N"] == []
    assert np.allclose(seen, np.arange(5, 376, 5) / 1000)  # every fifth sample
    assert [one["phase"] for one in phases] == ["position", "clamp", "load"]
    assert [one["touch_mm"] for one in phases] == [None, 0.02, 0.02]
    again = get(client)  # a page that is loaded again
    assert again["force_N"] == seen
    assert again["phases"] == phases
    assert again["head"] == {"pin": 3, "force_limit_N": 25.0, "ramps": 3}
    session.recorder.close()


def test_a_stop_is_told_with_its_reason_and_a_verdict_with_its_trace(client, study):
    session = Session(study)
    session.samples(25)
    session.phase("stopping", reason="pin 3: 26.00 N is over the limit of 25 N")
    session.phase("stopped", reason="pin 3: 26.00 N is over the limit of 25 N")
    session.recorder.close()
    part = get(client)
    assert part["ended"]["phase"] == "stopped"
    assert "over the limit" in part["ended"]["reason"]
    assert part["verdict"] is None
    verdict = {"good": True, "checks": [{"name": "ramps", "passed": None, "found": "1", "remedy": ""}]}
    (session.folder / "verdict.json").write_text(json.dumps(verdict | {"trace": "1.csv"}))
    assert get(client, part["offset"])["verdict"] == verdict | {"trace": "1.csv"}


def test_a_request_reads_a_bounded_part_of_a_long_record(client, study):
    session = Session(study)
    session.samples(FOLLOWED_BYTES // 100)
    session.recorder.close()
    offset, seen, requests, more = 0, [], 0, True
    while more:
        part = get(client, offset)
        assert part["offset"] - offset <= FOLLOWED_BYTES + 10_000
        offset, more = part["offset"], part["more"]
        seen += part["force_N"]
        requests += 1
    assert requests > 1
    assert offset == session.file.stat().st_size
    assert len(seen) == session.count // 5
    assert np.all(np.diff(seen) > 0)


def test_an_unfinished_block_is_waited_for(client, study):
    session = Session(study)
    session.samples(50)
    session.recorder.close()
    data = session.file.read_bytes()
    cut = data.index(b"#block 2 ") + 9
    session.file.write_bytes(data[:cut])
    part = get(client)
    assert len(part["force_N"]) == 5
    session.file.write_bytes(data)
    assert len(get(client, part["offset"])["force_N"]) == 5


def test_the_newest_under_way_is_shown_and_none_lives_for_ever(client, study):
    old, new = Session(study), Session(study, "2", "20260102T040000.000")
    for session in (old, new):
        session.samples(25)
    assert client.get("/api/live").json()["session"]["site"] == "2"
    new.age(30)
    assert client.get("/api/live").json()["session"]["site"] == "1"
    assert get(client, site="2", stamp="20260102T040000.000")["silent"]
    old.age(3600)
    assert client.get("/api/live").json()["session"]["site"] == "2"
    new.age(3600)
    assert client.get("/api/live").json()["session"] is None
    before = client.get("/api/changes").json()["acquired"]
    Session(study, "1", "20260102T050000.000")
    assert client.get("/api/changes").json()["acquired"] != before


DAMAGE = {
    "foreign": lambda data: b"time,force\n1,2\n",
    "empty": lambda data: b"",
    "a byte of the first block": lambda data: data[:40] + b"~" + data[41:],
    "a byte of a later block": lambda data: data[:4000] + b"~" + data[4001:],
    "no head": lambda data: data.replace(b"#head", b"#tail"),
    "endless": lambda data: data[: data.rindex(b"#block")] + b"1" * (FOLLOWED_BYTES + 1),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_or_foreign_record_is_one_clear_line(client, study, damage):
    session = Session(study)
    session.samples(200)
    session.recorder.close()
    session.file.write_bytes(damage(session.file.read_bytes()))
    answer = client.get(f"/api/live/1/{STAMP}")
    if answer.status_code == 200:  # what was whole before it
        answer = client.get(f"/api/live/1/{STAMP}", params={"offset": answer.json()["offset"]})
    assert answer.status_code == 422, answer.text
    said = answer.json()["error"]
    assert "record.csv" in said
    assert "\n" not in said
    assert "internal" not in said


@pytest.mark.parametrize(
    "head",
    [
        {},
        {"settings": []},
        {"settings": HEAD["settings"] | {"pin": 99}},
        {"settings": HEAD["settings"] | {"pin": None}},
        {"settings": HEAD["settings"] | {"force_limit_N": "1e999"}},
    ],
)
def test_heads_that_say_nothing_useful_are_refused(client, study, head):
    session = Session(study, head=head)
    session.samples(25)
    answer = client.get(f"/api/live/1/{STAMP}")
    assert answer.status_code == 422
    assert "lack what a session has" in answer.json()["error"]


@pytest.mark.parametrize("offset", [1, 100, 10**9, 10**12])
def test_offsets_where_no_block_ends_are_refused(client, study, offset):
    Session(study).samples(100)
    answer = client.get(f"/api/live/1/{STAMP}", params={"offset": offset})
    assert answer.status_code == 422
    assert f"byte {offset}: no block ends here" in answer.json()["error"]


@pytest.mark.parametrize("content", ["", "[]", '{"good": 1}', '{"good": true, "checks": [{}]}', "{" * 9999])
def test_a_foreign_verdict_is_one_clear_line(client, study, content):
    session = Session(study)
    session.samples(25)
    (session.folder / "verdict.json").write_text(content)
    answer = client.get(f"/api/live/1/{STAMP}")
    assert answer.status_code == 422
    assert "not a verdict" in answer.json()["error"]


def test_nothing_outside_the_study_is_followed(client, study, tmp_path):
    outside = Session(tmp_path / "elsewhere")
    outside.samples(25)
    (study / "acquired" / "1").mkdir(parents=True)
    (study / "acquired" / "1" / STAMP).symlink_to(outside.folder)
    answer = client.get(f"/api/live/1/{STAMP}")
    assert answer.status_code == 422
    assert "lies outside" in answer.json()["error"]
    for site, stamp in (("1", ".hidden"), ("%2e%2e", STAMP), ("1", "..%2f1"), ("..%2f..", STAMP)):
        assert client.get(f"/api/live/{site}/{stamp}").status_code in (404, 422)
    (study / "acquired" / "1" / "20260102T060000.000").mkdir()
    os.mkfifo(study / "acquired" / "1" / "20260102T060000.000" / "record.csv")
    assert client.get("/api/live/1/20260102T060000.000").status_code == 404
