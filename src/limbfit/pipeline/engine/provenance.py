"""What results are made from: keys of stages and experiments, and versions, machine, settings and inputs.

A key is a digest of all that decides a result. Only digests are kept beside results, so that no setting or
file name leaves a trace in them.
"""

import os
import platform
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from ..._version import __version__
from ...anatomy.labels.labelfiles import find_sidecar
from ...extensions import compute_extensions_digest
from ...fe import StepControl
from ...results.runs import StageParts
from ...study import Study
from .digests import code_parts, compute_digest, compute_input_digest
from .store import find_hand_labels

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
_MAX_NAMED = 4  # causes of one kind that are named
_BY_NAME = ("indenters.", "material.", "calibration.prior.")  # tables of which the order says nothing


def collect_versions() -> dict[str, str]:
    """Versions of the libraries that decide numbers; a library that is not installed is left out."""
    found = {name: find_version(name) for name in LIBRARIES}
    return {name: version for name, version in found.items() if version is not None}


def find_version(distribution: str) -> str | None:
    """The version of a distribution; None where it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


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
    measured = [path for one in study.socket.measured for path in (one.file, one.markups)]
    files["socket"] = [path for path in (study.socket.file, *measured) if path is not None]
    files["sensors"] = files["socket"]
    files["traces"] += [path for record in study.recorded for path in record.files]
    return files


def compute_input_digests(study: Study) -> dict[str, str]:
    """SHA-256 of every input by its key in the study file; names of files and folders may be a patient's."""
    return {key: compute_input_digest(study.path(path)) for key, path in study.inputs.items()}


def record_settings(study: Study, digests: Mapping[str, str]) -> dict[str, Any]:
    """Every setting of a study, with digests in place of paths and series, which may identify a person.

    Beside them: what the solver takes that no study sets.
    """
    by_path = {path: f"sha256:{digests[key][:16]}" for key, path in study.inputs.items()}

    def to_plain(value: Any) -> Any:
        if isinstance(value, Path):
            # Of `febio.program`, which is no input, the name alone: each machine has it elsewhere.
            return by_path.get(value, f"sha256:{compute_digest(value.name)}")
        if isinstance(value, dict):
            return {key: to_plain(part) for key, part in value.items()}
        return [to_plain(part) for part in value] if isinstance(value, list | tuple) else value

    record = to_plain(study.model_dump())
    for key in ("series", "markers_series"):
        if record["image"] and record["image"][key]:
            record["image"][key] = f"sha256:{compute_digest(record['image'][key])}"
    widths_mm = [indenter.width_mm for indenter in study.all_indenters.values()]
    record["mesh"]["accuracy"] = study.mesh.find_accuracy(widths_mm)
    control = StepControl()
    record["solver"] |= {key: getattr(control, key) for key in ("tolerance", "max_cuts", "penetration")}
    return record


@dataclass(frozen=True)
class Stage:
    """A stage: what it stands on, which tables it reads, and which keys of ``[[sites]]`` and ``[[records]]``.

    ``run(context, folder)`` does it, and may return facts for its stamp. ``apart`` are keys of its tables,
    such as ``socket.design``, without effect on what it makes. Its code is that of `digests.find_sources`.
    """

    name: str
    run: Callable[..., dict[str, Any] | None]
    needs: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    site_keys: tuple[str, ...] = ()
    record_keys: tuple[str, ...] = ()
    apart: tuple[str, ...] = ()

    def read(self, stated: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        """What it reads of a study: each value with its name, such as ``records.1-slow.trace``."""
        found = {table: stated[table] for table in self.tables}
        for table, _, key in (name.partition(".") for name in self.apart):
            found[table] = {name: value for name, value in (found[table] or {}).items() if name != key}
        yield from _iterate_leaves(found, "")
        for site in stated["sites"] if self.site_keys else ():
            yield from _iterate_leaves({key: site[key] for key in self.site_keys}, f"sites.{site['name']}.")
        for row in stated["records"] if self.record_keys else ():
            name = f"records.{row['site']}-{row['name']}."
            yield from _iterate_leaves({key: row[key] for key in self.record_keys}, name)


@dataclass(frozen=True)
class StageKey:
    """The key of a stage, and what it is a digest of."""

    digest: str
    parts: StageParts


class Keys:
    """Keys of the stages of one study; input files are digested once, whatever part of it is asked about."""

    def __init__(self, study: Study) -> None:
        self.study = study
        named = {path for paths in list_input_files(study).values() for path in paths}
        places = {path: study.path(path) for path in named}
        # A record that is yet to be made has none.
        self._files = {path: compute_input_digest(at) if at.exists() else "" for path, at in places.items()}
        own = compute_extensions_digest(study.extensions)  # they may change what any stage does
        self._code = {"limbfit": __version__} | ({"study.extensions": own} if own else {})

    def compute_key(
        self,
        stage: Stage,
        below: Mapping[str, str],
        options: Mapping[str, Any] | None = None,
        study: Study | None = None,
    ) -> StageKey:
        """The key of a stage.

        Parameters
        ----------
        below : keys of the stages below it, by name.
        options : what it is run with beside the study.
        study : a part of the study, instead of the whole.
        """
        study = study or self.study
        if "acquire" not in stage.tables:  # only who plans records presses with indenters that none names
            used = {name: table for name, table in study.indenters.items() if name in study.used_indenters}
            study = study.model_copy(update={"indenters": used})
        names = {path: key for key, path in study.inputs.items()}
        by_stage = list_input_files(study)
        files = [*by_stage.get(stage.name, ()), *(by_stage["indenters"] if "mesh" in stage.needs else ())]
        read = dict(stage.read(study.model_dump(mode="json")))
        parts = StageParts(
            settings={name: compute_digest(value) for name, value in read.items()},
            inputs={names.get(path, "labels corrected by hand"): self._files[path][:16] for path in files},
            code=code_parts(stage.run) | self._code,
            stages={name: below[name] for name in stage.needs if name in below},
        )
        # Of sites, records and bones: results are in it too.
        order = [name for name in read if not name.startswith(_BY_NAME)]
        return StageKey(compute_digest(stage.name, parts.to_plain(), order, *filter(None, [options])), parts)


def _iterate_leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _iterate_leaves(part, f"{name}{key}.")
    else:
        yield name.removesuffix("."), value


def describe_causes(before: StageParts | None, now: StageParts) -> list[str]:
    """What differs, in words; what is above a lower stage's change comes last."""
    if before is None:
        return ["made by an older version, which did not store what its key depends on"]
    found = []
    for kind, word in (("settings", "setting"), ("inputs", "input file"), ("stages", "stage")):
        names = _find_different(getattr(before, kind), getattr(now, kind))
        found += [f"{word} {_list_few(names)} changed"] if names else []
    code, then = _find_different(before.code, now.code), before.code.get("limbfit")
    if then != __version__:
        found.append(f"limbfit was {then}, is {__version__}")
    elif code:
        found.append(f"code of {_list_few(code)} changed")
    return found or ["its options, or the order of sites, records or bones, changed"]


def _list_few(names: list[str]) -> str:
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return ", ".join(names[:_MAX_NAMED]) + more


def _find_different(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    return [name for name in {**before, **now} if before.get(name) != now.get(name)]
