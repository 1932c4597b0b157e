"""The small study of `identification.py`, its copies, and what an identification of one ended with."""

import resource
import shutil
from pathlib import Path
from typing import Any

from identification_cases import make_study

from limbfit import load_study, run_study
from limbfit.indentation import list_flat_names, to_vector
from limbfit.pipeline.engine.store import Store, read_json

Record = dict[str, Any]
NAMES = tuple(f"{tissue}.{name}" for tissue, name in list_flat_names(("skin", "muscle")))


def quiet(progress: Any) -> None:
    """What the pipeline tells is in the study's log."""


def cpu_s() -> float:
    """Processor seconds of this process and the meshers that it started."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


class Study:
    """The study and its copies: ``study`` as made and meshed, ``clean`` as identified from it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.made = make_study(folder / "study")
        run_study(load_study(self.made), until="mesh", listener=quiet)

    def clean(self) -> Path:
        """A copy that is run to the end."""
        copy = self.copy("clean", self.made)
        run_study(load_study(copy), until="predict", listener=quiet)
        return copy

    def copy(self, name: str, of: Path) -> Path:
        """A copy of one of the two; one that was begun is gone on with."""
        place = self.folder / name
        if not place.is_dir():
            draft = self.folder / f".{name}"
            shutil.rmtree(draft, ignore_errors=True)
            shutil.copytree(of, draft)
            draft.rename(place)
        return place


def outcome(copy: Path) -> Record:
    """What a study that was run to its prediction found."""
    store = Store(copy / "results")
    found, predicted = (
        read_json(store["calibrate"] / "calibration.json"),
        read_json(store["predict"] / "predict.json"),
    )
    rows = predicted["sites"]
    return {
        **ending(found),
        "error_percent_by_site": {row["site"]: row["error_percent"] for row in rows},
        "error_heldout_percent": predicted["mean_error_heldout_percent"],
        "peak_force_N": {row["site"]: row["peak_force_N"] for row in rows},
        "flags": predicted["flags"],
        "standardised": {row["site"]: row["standardised"] for row in predicted["left_out"]},
    }


def ending(calibration: Record) -> Record:
    """How an identification ended."""
    stages = calibration["stages"]
    return {
        "parameters": to_vector(stages[-1]["parameters"], ("skin", "muscle")).tolist(),
        "cost": stages[-1]["cost"],
        "error_percent": stages[-1]["iterations"][-1]["error_percent"],
        "evaluations": [stage["evaluations"] for stage in stages],
        "converged": [stage["converged"] for stage in stages],
        "reasons": [stage["reason"] for stage in stages],
        "verdicts": list(calibration["uncertainty"]["verdict"].values()),
    }
