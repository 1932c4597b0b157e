"""Stage folders: atomic, resumable, keyed by their inputs."""

import errno
import os
import subprocess
import sys

import numpy as np
import pytest

from limbfit.errors import RunError
from limbfit.pipeline.engine.digests import compute_input_digest
from limbfit.pipeline.engine.store import (
    EARLIER,
    ResultFiles,
    Store,
    lock,
    read_json,
    translate_disk_errors,
    write_json,
)


def test_stage_is_done_only_for_its_key(tmp_path):
    store = Store(tmp_path)
    assert store.state("mesh", "a").state == "missing"
    store.make("mesh", "a", lambda folder: write_json(folder / "x.json", 1) or {"facts": 7})
    assert store.state("mesh", "a").state == "done"
    assert store.state("mesh", "b").state == "stale"
    assert store.stamp("mesh").facts == 7
    assert read_json(store["mesh"] / "x.json") == 1


def test_interrupted_stage_goes_on_in_its_folder(tmp_path):
    store = Store(tmp_path)

    def dies(folder):
        write_json(folder / "first.json", 1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.make("mesh", "a", dies)
    assert store.state("mesh", "a").state == "begun"
    assert not store["mesh"].exists()

    def goes_on(folder):
        assert read_json(folder / "first.json") == 1
        return {}

    store.make("mesh", "a", goes_on)
    assert store.state("mesh", "a").state == "done"
    assert sorted(p.name for p in store["mesh"].iterdir()) == ["first.json", "stage.json"]


def test_unfinished_work_of_other_inputs_is_dropped(tmp_path):
    store = Store(tmp_path)
    store.work_folder("mesh", "old").mkdir()
    store.make("mesh", "new", lambda folder: {})
    assert not store.work_folder("mesh", "old").exists()


def test_simulations_of_unfinished_work_of_other_inputs_are_kept_until_the_stage_is_done(tmp_path):
    store = Store(tmp_path)
    old = store.work_folder("calibrate", "old") / "runs"
    old.mkdir(parents=True)
    (old / "a.npz").write_bytes(b"a")

    def produce(folder):
        assert (folder / EARLIER / "a.npz").read_bytes() == b"a"
        return {}

    store.make("calibrate", "new", produce)
    assert [p.name for p in store["calibrate"].iterdir()] == ["stage.json"]


@pytest.mark.parametrize("left", [b"", b"1x", bytes(8)])
def test_a_clock_that_a_power_cut_has_left_in_part_starts_anew(tmp_path, left):
    store = Store(tmp_path)
    work = store.work_folder("mesh", "a")
    work.mkdir()
    (work / ".seconds").write_bytes(left)
    assert store.make("mesh", "a", lambda folder: {}).seconds < 10.0


def test_a_stage_whose_result_or_stamp_is_cut_short_is_made_anew(tmp_path):
    store = Store(tmp_path)
    store.make("calibrate", "a", lambda folder: write_json(folder / "calibration.json", {"c": 1}) or {})
    whole = (store["calibrate"] / "calibration.json").read_bytes()
    for left in (b"", whole[:-2], bytes(len(whole))):
        (store["calibrate"] / "calibration.json").write_bytes(left)
        assert store.state("calibrate", "a").state == "begun"
    (store["calibrate"] / "stage.json").write_text("")  # as a power cut leaves it
    assert store.state("calibrate", "a").state == "missing"
    store.make("calibrate", "a", lambda folder: write_json(folder / "calibration.json", {"c": 1}) or {})
    assert store.state("calibrate", "a").state == "done"


def test_a_kept_simulation_that_is_cut_short_is_none(tmp_path):
    kept = ResultFiles(tmp_path / "runs", also=[tmp_path / "earlier"])
    made = {"reason": ""}, {"force_N": np.arange(500.0)}
    kept.put("a", made)
    file = tmp_path / "runs" / "a.npz"
    whole = file.read_bytes()
    for size in (0, 1, 60, len(whole) // 2, len(whole) - 30):
        file.write_bytes(whole[:size])
        assert kept.find("a") is None
    (tmp_path / "earlier").mkdir()
    (tmp_path / "earlier" / "a.npz").write_bytes(whole)
    facts, arrays = kept.find("a")
    assert facts == made[0]
    np.testing.assert_array_equal(arrays["force_N"], made[1]["force_N"])
    assert file.read_bytes() == whole


@pytest.mark.parametrize(("cut_short", "made"), [(False, 1), (True, 2)])
def test_a_stage_that_was_complete_when_killed_is_only_put_in_place(tmp_path, cut_short, made):
    """Unless its stamp is not whole: then it is made anew."""
    store = Store(tmp_path)
    store.make("mesh", "a", lambda folder: {"made": 1})
    store["mesh"].rename(store.work_folder("mesh", "a"))  # killed just before the renaming
    if cut_short:
        (store.work_folder("mesh", "a") / "stage.json").write_text("")
    assert store.make("mesh", "a", lambda folder: {"made": 2}).made == made
    assert store.state("mesh", "a").state == "done"


def test_what_a_kill_between_renames_has_left_is_put_right(tmp_path):
    store = Store(tmp_path)
    for stage in ("mesh", "sites"):
        store.make(stage, "a", lambda folder: {})
    store["mesh"].rename(tmp_path / ".old-mesh")
    (tmp_path / ".old-sites").mkdir()
    (tmp_path / ".run.json.1234.part").write_text("{")
    with lock(tmp_path):
        assert store.state("mesh", "a").state == "done"
        assert sorted(p.name for p in tmp_path.iterdir()) == [".holder", ".lock", "mesh", "sites"]


def test_a_stage_in_the_place_of_a_link_is_made_again_and_again(tmp_path):
    """As where someone moved a large stage to another disk, and put a link in its place."""
    store, elsewhere = Store(tmp_path / "results"), tmp_path / "elsewhere"
    store.make("mesh", "a", lambda folder: {})
    store["mesh"].rename(elsewhere)
    store["mesh"].symlink_to(elsewhere, target_is_directory=True)
    (elsewhere / "precious").write_text("kept")
    for key in "bcd":
        store.make("mesh", key, lambda folder: {})
        with lock(store.folder):
            assert store.state("mesh", key).state == "done"
    assert sorted(path.name for path in store.folder.iterdir()) == [".lock", "mesh"]
    assert (elsewhere / "precious").read_text() == "kept"


def test_a_file_is_readable_by_whom_the_user_lets_read(tmp_path):
    before = os.umask(0o022)
    try:
        write_json(tmp_path / "x.json", 1)
    finally:
        os.umask(before)
    assert (tmp_path / "x.json").stat().st_mode & 0o777 == 0o644


def test_failed_rewrite_leaves_the_old_file(tmp_path):
    file = tmp_path / "x.json"
    write_json(file, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(file, {"a": float("nan")})
    assert read_json(file) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_file_digest_sees_names_and_contents(tmp_path):
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "1").write_text("x")
    before = compute_input_digest(tmp_path / "d")
    (tmp_path / "d" / "1").rename(tmp_path / "d" / "2")
    renamed = compute_input_digest(tmp_path / "d")
    (tmp_path / "d" / "2").write_text("y")
    assert len({before, renamed, compute_input_digest(tmp_path / "d")}) == 3


def test_second_run_is_refused_while_the_first_lives(tmp_path):
    program = (
        "import sys; from pathlib import Path; from limbfit.pipeline.engine.store import lock\n"
        "with lock(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert holder.stdout.readline().strip() == "held"
    with (
        pytest.raises(RunError, match=rf"process {holder.pid} \(since .* UTC\).*kill"),
        lock(tmp_path),
    ):
        pass
    holder.kill()
    holder.wait()
    with lock(tmp_path):
        pass


def test_full_disk_is_one_clear_line(tmp_path):
    with pytest.raises(RunError, match="disk is full"), translate_disk_errors(tmp_path):
        raise OSError(errno.ENOSPC, "no space")
    with pytest.raises(FileNotFoundError), translate_disk_errors(tmp_path):
        raise FileNotFoundError(errno.ENOENT, "gone")
