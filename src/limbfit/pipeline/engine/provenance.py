"""What a run was made with: versions, machine, settings and the digests of its inputs."""

import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from ...anatomy.labels.labelfiles import find_sidecar
from ...fe import StepControl
from ...study import Study
from .digests import compute_digest, compute_file_digest
from .files import find_hand_labels

LIBRARIES = (
    "numpy",
    "scipy",
    "numba",
    "pypardiso",
    "mkl",
    "scikit-sparse",
    "SimpleITK",
    "vtk",
    "pyvista",
    "libigl",
    "gpytoolbox",
    "mmgpy",
    "pydantic",
)


def collect_versions() -> dict[str, str]:
    """Versions of the libraries that decide numbers; a library that is not installed is left out."""
    found = {}
    for name in LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def describe_machine() -> dict[str, Any]:
    """The machine in figures, without its name or its user's."""
    return {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "system": platform.system(),
        "processor": platform.machine(),
        "memory_GB": round(psutil.virtual_memory().total / 1e9, 1),
    }


def list_input_files(study: Study) -> dict[str, list[Path]]:
    """The study's input files and folders by the stage that reads them; ``indenters``: all on meshes."""
    files: dict[str, list[Path]] = {"segment": [], "surfaces": [], "traces": []}
    if study.image is not None:
        files["segment"] += [study.image.path, *filter(None, [study.image.marked])]
    files["segment"] += [path for path in (study.segmentation.contours, find_hand_labels(study)) if path]
    if study.segmentation.labels is not None:
        files["segment"].append(study.segmentation.labels)
        names = find_sidecar(study.segmentation.labels)
        files["segment"] += [names] if study.path(names).is_file() else []
    if study.surfaces is not None:
        files["surfaces"] += [study.surfaces.skin, *study.surfaces.bones.values()]
    files["surfaces"] += [one.surface for one in study.geometry.regions if one.surface is not None]
    files["indenters"] = [one.file for one in study.all_indenters.values() if one.file is not None]
    if study.socket.file is not None:
        files["socket"] = [study.socket.file]
    files["traces"] += [path for record in study.recorded for path in record.files]
    return files


def compute_input_digests(study: Study) -> dict[str, str]:
    """SHA-256 of every input by its key in the study file; names of files and folders may be a patient's."""
    return {key: compute_file_digest(study.path(path)) for key, path in study.inputs.items()}


def record_settings(study: Study, digests: Mapping[str, str]) -> dict[str, Any]:
    """Every setting of a study, with digests in place of paths and series, which may identify a person.

    Beside them: what the solver takes that no study sets.
    """
    by_path = {path: f"sha256:{digests[key][:16]}" for key, path in study.inputs.items()}

    def plain(value: Any) -> Any:
        if isinstance(value, Path):
            # Of `febio.program`, which is no input, the name alone: each machine has it elsewhere.
            return by_path.get(value, f"sha256:{compute_digest(value.name)}")
        if isinstance(value, dict):
            return {key: plain(part) for key, part in value.items()}
        return [plain(part) for part in value] if isinstance(value, list | tuple) else value

    record = plain(study.model_dump())
    for key in ("series", "markers_series"):
        if record["image"] and record["image"][key]:
            record["image"][key] = f"sha256:{compute_digest(record['image'][key])}"
    widths_mm = [indenter.width_mm for indenter in study.all_indenters.values()]
    record["mesh"]["accuracy"] = study.mesh.find_accuracy(widths_mm)
    control = StepControl()
    record["solver"] |= {key: getattr(control, key) for key in ("tolerance", "max_cuts", "penetration")}
    return record
