"""The synthetic patient as a study: the demo that identifies it, and how long an identification takes."""

import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ...bench.parity import find_reference
from ...bench.timing import time_febio
from ...errors import InputError
from ...execution import make_executor
from ...febio import find_febio
from ...phantom.build import make_phantom, unpack_patient
from ...phantom.robot import simulate_true_force
from ...study import load_study
from ..engine.context import Listener, Progress, ignore_progress
from ..engine.store import Store, read_json
from ..socket.sensors import write_true_sensors
from .run import compile_in_background, run_study

# A site of the paper's kind, of 20,922 nodes, and how often the paper's search improved its parameters.
FEBIO_CASE, FEBIO_ITERATIONS = "residuum/posterior_tet10", 10
_STAGES_DONE_ANEW = ("calibrate", "predict", "report")


def make_phantom_study(
    folder: str | Path,
    *,
    listener: Listener = ignore_progress,
    workers: int = 0,
    sensors: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Make a synthetic patient in ``folder``; returns its truth.

    ``workers``: how many simulate side by side; 0: one per core. ``sensors``: also what sensors in its socket
    measure, from a simulation with the true tissues. ``options``: as
    :func:`limbfit.phantom.build.make_phantom` takes them: ``detail``, ``seed``, ``limb``, ``sites``, and what
    else there is: ``fat``, ``tendon``, ``socket``, ``ultrasound``, ``surface``, ``shear_waves``.
    """
    with compile_in_background() as compiled, make_executor(workers) as executor:

        def map_jobs(function: Callable, jobs: Iterable) -> Iterable:
            if function is simulate_true_force:
                compiled()
            return executor.map(function, jobs)

        return make_phantom(
            Path(folder),
            mapping=map_jobs,
            sensors=write_true_sensors if sensors else None,
            progress=lambda text, done, total: listener(Progress(f"phantom {text}", done, total)),
            **options,
        )


def run_demo(folder: str | Path, *, seed: int = 0, listener: Listener = ignore_progress) -> dict[str, Any]:
    """A coarse synthetic patient identified from its DICOM images and records; goes on where it was stopped.

    The patient of seed 0 comes with limbfit; those of other seeds are made first.

    Returns the summary of :func:`run_study` with the ``truth`` beside it. Raises `InputError` when ``folder``
    holds something else, or the demo of another seed.
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
        what = f"holds the phantom of seed {truth['seed']}, {truth['detail']}"
        raise InputError(what, file=folder, remedy="give another folder, or the same seed")
    summary = run_study(load_study(folder), listener=listener)
    return {**summary, "truth": truth["parameters"]}


def bench_calibrate(
    folder: Path | None = None, *, beside_febio: bool = False, listener: Listener = ignore_progress
) -> dict[str, Any]:
    """Identify a study afresh, in a copy of it, and time the stages after meshing.

    Returns ``seconds`` of calibration and prediction together, ``forward_runs`` of both (and how many of the
    calibration's have sensitivities), ``mean_error_fitted_percent``, ``mean_error_heldout_percent``; beside
    FEBio ``febio_loop_seconds``, extrapolated from that run to (parameters + 1) simulations per iteration and
    fitted site, ten iterations; and ``ratio`` of the two. Raises `InputError` where the study cannot be used,
    or FEBio or its reference case is wanted and not there.

    ``folder``: of the study, or its file; None makes the coarse phantom of seed 0. What its chain has stored
    up to the meshes is used, what stands on them is not. ``beside_febio``: FEBio itself runs one reference
    case afterwards, of 20,922 nodes, on one thread.
    """
    program, reference = (find_febio(), find_reference(Path.cwd())) if beside_febio else (None, Path())
    with tempfile.TemporaryDirectory(prefix="limbfit-bench-") as scratch:
        place = Path(scratch) / "study"
        if folder is None:
            make_phantom_study(place, detail="coarse", seed=0, listener=listener)
        else:
            source = load_study(folder)
            shutil.copytree(source.file.parent, place, ignore=_select_left_out)
            if source.file.name != "study.toml":
                (place / source.file.name).rename(place / "study.toml")
        study = load_study(place)
        run_study(study, until="predict", listener=listener)
        store = Store(study.results)
        predicted = store.results.predict
        seconds = {stage: store.results.stages[stage].seconds for stage in ("calibrate", "predict")}
        names = {file.name for stage in seconds for file in store[stage].glob("runs/*.npz")}
        calibration = store.results.calibration
        parameters, sites = len(study.parameters), len(study.fitted)
        total, runs = sum(seconds.values()), FEBIO_ITERATIONS * sites * (parameters + 1)
        febio = None if program is None else runs * time_febio(program, reference, FEBIO_CASE, 1)
        return {
            "study": study.study.name,
            "seconds": total,
            "seconds_calibrate": seconds["calibrate"],
            "seconds_predict": seconds["predict"],
            "forward_runs": len(names),
            "forward_runs_calibrate": calibration.forward_runs,
            "forward_runs_calibrate_with_sensitivities": calibration.forward_runs_with_sensitivities,
            "sites_fitted": sites,
            "sites_predicted": len(predicted.sites),
            "nodes_per_site": max(site.nodes for site in store.results.mesh.sites.values()),
            "mean_error_fitted_percent": predicted.mean_error_fitted_percent,
            "mean_error_heldout_percent": predicted.mean_error_heldout_percent,
            "febio_loop_seconds": febio,
            "ratio": None if febio is None else febio / total,
            "ratio_calibrate": None if febio is None else febio / seconds["calibrate"],
        }


def _select_left_out(folder: str, names: list[str]) -> set[str]:
    """Results that stand on the meshes, locks and unfinished work."""
    if Path(folder).name != "results":
        return set()
    return {name for name in names if name in _STAGES_DONE_ANEW or name.startswith(".")}
