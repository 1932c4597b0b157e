"""A study file is made by asking; its answers are what a person would have written."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from limbfit import load_study

PLACES = ("40 0 60", "0, 40, 50")


def ask(folder: Path, *answers: str) -> subprocess.CompletedProcess[str]:
    """What the command prints, and how it ends, with these lines typed."""
    command = [sys.executable, "-m", "limbfit", "init", str(folder)]
    return subprocess.run(
        command, input="\n".join(answers) + "\n", capture_output=True, text=True, check=False
    )


def test_surfaces_and_records_become_a_study(study: Path) -> None:
    written = load_study(study)
    (study / "study.toml").unlink()
    records = ("y", "y", "1", PLACES[0], "y", "2", PLACES[1], "n")
    done = ask(study, "stump", "1", "tibia", "mm", "square", "20", *records)
    assert done.returncode == 0, done.stderr
    assert "limbfit check" in done.stdout
    made = load_study(study)
    assert made.study.name == "stump"
    assert made.surfaces == written.surfaces
    assert made.indenter == written.indenter
    assert made.sites == written.sites


def test_a_place_that_is_none_is_asked_for_again(study: Path) -> None:
    (study / "study.toml").unlink()
    records = ("y", "n", "1", "40 0", PLACES[0], "y")
    done = ask(study, "stump", "1", "tibia", "mm", "square", "20", *records)
    assert done.returncode == 0
    assert "give three numbers" in done.stdout + done.stderr
    assert load_study(study).site("1").position == (40.0, 0.0, 60.0)


def test_without_records_the_way_to_sites_is_said_and_nothing_runs_beyond_surfaces(
    study: Path, limbfit: Callable[..., tuple[int, str, str]]
) -> None:
    (study / "study.toml").unlink()
    done = ask(study, "stump", "1", "tibia", "mm", "square", "20", "n", "n")
    assert "it has no site yet" in done.stdout
    for words in (("run",), ("simulate", "--site", "1"), ("uncertainty",), ("design", "--sites", "2")):
        code, _, error = limbfit(words[0], study, *words[1:])
        assert code == 2
        assert "the study has no site yet; add [[sites]], or place sites in limbfit studio" in error
    code, shown, _ = limbfit("check", study)
    assert code == 0
    assert "the study has no site yet" in shown


def test_a_folder_that_has_a_study_is_left_alone(study: Path) -> None:
    before = (study / "study.toml").read_text()
    done = ask(study, "stump", "1", "tibia", "mm", "square", "20", "n", "n")
    assert done.returncode == 2
    assert "there is a study already" in done.stderr
    assert (study / "study.toml").read_text() == before
