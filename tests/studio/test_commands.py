"""Commands that the studio starts: in the study's folder, without running what lies there."""

import time

import psutil
import pytest

from limbfit.errors import InputError
from limbfit.studio.folder import StudyFolder
from limbfit.studio.processes import find_command, interrupt_process, start_command, start_run


def ended(process, within_s=60.0):
    until = time.monotonic() + within_s
    while psutil.pid_exists(process) and psutil.Process(process).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_command_is_found_and_interrupted(tmp_path):
    words = ["-c", "import time; time.sleep(600)", str(tmp_path)]
    process = start_command([*words, "more"], tmp_path)
    while find_command(words) is None:
        time.sleep(0.05)
    assert find_command(words) == (process, [*words, "more"])
    interrupt_process(process)
    ended(process)
    assert find_command(words) is None


def test_a_run_works_beside_the_link_that_names_the_study_file_and_runs_no_code_beside_it(study, tmp_path):
    for name in ("limbfit", "psutil", "typer"):
        (study / f"{name}.py").write_text("open('ran', 'w').close()")
    other = tmp_path / "other"
    other.mkdir()
    (study / "study.toml").rename(other / "study.toml")
    (study / "study.toml").symlink_to(other / "study.toml")
    ended(start_run(StudyFolder(study / "study.toml"), "surfaces", None, ())["process"])
    assert (study / "results" / "surfaces" / "stage.json").is_file()
    assert not (other / "results").exists()
    assert not (study / "ran").exists()


def test_a_stage_to_repeat_that_comes_after_the_last_one_is_refused_at_once(study):
    folder = StudyFolder(study / "study.toml")
    with pytest.raises(InputError, match="predict comes after mesh"):
        start_run(folder, "mesh", None, ("predict",))
