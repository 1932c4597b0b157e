"""A study run again from its record, in a new folder, and compared with what it gave then."""

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..._version import __version__
from ...anatomy.labels.labelfiles import find_sidecar
from ...errors import InputError
from ...results.base import read_curves
from ...study import Study, load_study
from ..engine.context import Listener, ignore_progress
from ..engine.digests import find_data_files
from ..engine.provenance import collect_versions, compute_input_digests, record_settings
from ..engine.store import Store, find_hand_labels, read_json
from .run import run_study

TOLERANCE = 1e-6  # of a parameter, and of the largest force of a site, relative
RECORD = "run.json"


def reproduce_study(
    record: str | Path,
    folder: str | Path,
    *,
    tolerance: float = TOLERANCE,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Copy the inputs of a study to a new folder, run it there, and compare.

    ``record``: ``results/run.json`` of a study, or the study. ``folder``: the new one; must not exist, unless
    an earlier attempt at the same record is to go on. ``tolerance``: how far parameters, and forces over a
    site's largest, may be apart, relative.

    Returns ``same``, ``tolerance``, ``parameters`` and ``forces`` (largest relative difference by name), and
    ``versions`` that differ, each as (then, now). Raises `InputError` where the record is not one, or the
    study's inputs or settings are no longer those of the record.
    """
    record, folder = Path(record), Path(folder)
    study = load_study(record.absolute().parent.parent if record.name == RECORD else record)
    file = study.results / RECORD
    known = _read(file)
    _check_unchanged(study, known, file)
    _copy_inputs(study, folder)
    summary = run_study(load_study(folder), listener=listener)
    then = Store(study.results).results.calibration.parameters
    parameters = {
        f"{tissue}.{name}": abs(summary["parameters"][tissue][name] - value) / max(abs(value), 1e-300)
        for tissue, values in then.items()
        for name, value in values.items()
    }
    forces = dict(_compare_forces(study.results / "predict", folder / "results" / "predict"))
    old: dict[str, str | None] = {"limbfit": known.get("limbfit"), **known["versions"]}
    new: dict[str, str | None] = {"limbfit": __version__, **collect_versions()}
    return {
        "same": bool(max([*parameters.values(), *forces.values()]) <= tolerance),
        "tolerance": tolerance,
        "parameters": parameters,
        "forces": forces,
        "versions": {
            name: [old.get(name), new.get(name)] for name in {**old, **new} if old.get(name) != new.get(name)
        },
        "folder": str(folder),
    }


def _read(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise InputError("no such record", file=file, remedy="run the study first: limbfit run")
    try:
        known = read_json(file)
    except (json.JSONDecodeError, UnicodeDecodeError):
        known = None
    if not isinstance(known, dict) or not {"settings", "inputs", "versions", "stages"} <= set(known):
        raise InputError("is not the record of a run", file=file, remedy="give results/run.json of a study")
    if not {"calibrate", "predict"} <= set(known["stages"]):
        what = "that run did not reach its predictions"
        raise InputError(what, file=file, remedy="run the study to its end")
    return known


def _check_unchanged(study: Study, known: Mapping[str, Any], file: Path) -> None:
    """The inputs and settings must be those that the record tells of: else nothing is to be compared."""
    found = compute_input_digests(study)
    changed = [key for key in {**known["inputs"], **found} if known["inputs"].get(key) != found.get(key)]
    if not changed:
        now = json.loads(json.dumps(record_settings(study, found), default=str))
        changed = [
            table
            for table in {**known["settings"], **now}
            if table not in ("execution", "acquire") and known["settings"].get(table) != now.get(table)
        ]
    if changed:
        remedy = "bring back what it was made from, or run the study again for a new record"
        raise InputError(f"the study has changed since: {', '.join(changed[:4])}", file=file, remedy=remedy)


def _copy_inputs(study: Study, folder: Path) -> None:
    """The study file and what it names below its folder; what lies elsewhere is read where it is."""
    root, begun = study.folder.resolve(), folder / "study.toml"
    goes_on = begun.is_file() and begun.read_bytes() == study.file.read_bytes() and folder.resolve() != root
    if not goes_on and folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError("holds something else", file=folder, remedy="give a folder that does not exist")
    folder.mkdir(parents=True, exist_ok=True)
    edited = find_hand_labels(study)
    # The study file first: by it an attempt that was ended while it copied is known.
    for path in dict.fromkeys([Path(study.file.name), *study.inputs.values(), *filter(None, [edited])]):
        source = study.path(path)
        if path.is_absolute():
            continue
        if not source.resolve().is_relative_to(root) or ".." in path.parts:
            what = f"{path} lies outside the study's folder"
            raise InputError(what, file=study.file, remedy="name it by its full path")
        target = folder / ("study.toml" if path == Path(study.file.name) else path)
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True)
        else:
            shutil.copyfile(source, target)
            for one in (find_sidecar(source), *find_data_files(source)):  # names of labels, and voxels
                if one.is_file() and one.parent == source.parent:
                    shutil.copyfile(one, target.with_name(one.name))


def _compare_forces(then: Path, now: Path) -> Iterator[tuple[str, float]]:
    """Of force, or displacement under a stated force, as simulated: the largest difference of each site."""
    for file in sorted(then.glob("*.csv")):
        curves = [read_curves(folder / file.name) for folder in (then, now)]
        a, b = (one.get("force_simulated_N", one.get("displacement_simulated_mm")) for one in curves)
        if a is not None and b is not None:
            yield file.stem, float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-300))
        elif a is not b:  # one of them could not be predicted: all of the force is missing
            yield file.stem, 1.0
