"""Runs of a study that are stopped, and the states of its stages."""

from collections.abc import Callable
from pathlib import Path

from limbfit import Progress, load_study, study_status


class StoppedError(Exception):
    """Stands for a kill: nothing in limbfit catches it."""


def stop_at(text: str = "") -> Callable[[Progress], None]:
    """A listener that stops a run where it first tells the text; without one, before it does anything."""

    def listen(event: Progress) -> None:
        if text in event.text:
            raise StoppedError

    return listen


def states(study: Path) -> dict[str, str]:
    return {row["stage"]: row["state"] for row in study_status(load_study(study))}
