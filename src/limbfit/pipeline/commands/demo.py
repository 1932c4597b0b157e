"""The synthetic patient as a study, and the demo that identifies it."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...execution import make_executor
from ...phantom.build import make_phantom, unpack_patient
from ...phantom.robot import simulate_true_force
from ...study import load_study
from ..engine.context import Listener, Progress, ignore_progress
from ..engine.storage import read_json
from .run import compile_in_background, run_study


def make_phantom_study(
    folder: str | Path,
    *,
    listener: Listener = ignore_progress,
    workers: int = 0,
    **options: Any,
) -> dict[str, Any]:
    """Make a synthetic patient in ``folder``; returns its truth.

    Parameters
    ----------
    workers : how many simulate side by side; 0: one per core.
    options : as :func:`limbfit.phantom.build.make_phantom` takes them: ``detail``, ``seed``, ``limb``,
        ``sites``, and what else there is: ``fat``, ``tendon``, ``socket``, ``ultrasound``, ``surface``,
        ``shear_waves``.
    """
    with compile_in_background() as compiled, make_executor(workers) as executor:

        def mapping(function: Callable, jobs: Iterable) -> Iterable:
            if function is simulate_true_force:
                compiled()
            return executor.map(function, jobs)

        return make_phantom(
            Path(folder),
            mapping=mapping,
            progress=lambda text, done, total: listener(Progress(f"phantom {text}", done, total)),
            **options,
        )


def run_demo(folder: str | Path, *, seed: int = 0, listener: Listener = ignore_progress) -> dict[str, Any]:
    """A coarse synthetic patient identified from its DICOM images and records; goes on where it was stopped.

    The patient of seed 0 comes with limbfit; those of other seeds are made first.

    Returns
    -------
    dict
        The summary of :func:`run_study` with the ``truth`` beside it.

    Raises
    ------
    InputError
        When ``folder`` holds something else, or the demo of another seed.
    """
    folder = Path(folder)
    truth_file = folder / "truth.json"
    if not truth_file.is_file():
        if seed == 0:
            unpack_patient(folder)
            listener(Progress("phantom: the patient of seed 0, which comes with limbfit", 1, 1))
        else:
            make_phantom_study(folder, detail="coarse", seed=seed, listener=listener)
    truth = read_json(truth_file)
    if truth["seed"] != seed or truth["detail"] != "coarse":
        raise InputError(
            f"holds the phantom of seed {truth['seed']}, {truth['detail']}",
            file=folder,
            remedy="give another folder, or the same seed",
        )
    summary = run_study(load_study(folder), listener=listener)
    return {**summary, "truth": truth["parameters"]}
