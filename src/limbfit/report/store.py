"""The stored results of a study, read and nothing more: JSON summaries, CSV curves, paths of geometry."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..laws import TissueLaw
from .formats import format_fixed, format_symbol

Curves = dict[str, Array]
Json = dict[str, Any]
PAPER_TISSUES = {"skin": "Skin–adipose", "muscle": "Muscle"}


@dataclass(frozen=True)
class Results:
    """A results folder; every dictionary is empty where its file is not there (yet).

    ``experiments``: what each finished experiment stored, by its name; ``outdated``: those that are stale.
    ``models``: other models of the same records.
    """

    folder: Path
    run: Json
    segment: Json
    surfaces: Json
    sites: tuple[Json, ...]
    traces: Json
    mesh: Json
    calibration: Json
    predict: Json
    simulated: tuple[Json, ...]
    compared: tuple[Json, ...]
    truth: Json
    experiments: dict[str, Json] = field(default_factory=dict)
    outdated: tuple[str, ...] = ()
    models: Json = field(default_factory=dict)

    @property
    def site_names(self) -> tuple[str, ...]:
        """Names of the sites in the order of the study, whichever stage knows them."""
        known = [site["site"] for site in self.sites] or [site["site"] for site in self.predicted]
        return tuple(known or self.traces)

    @property
    def predicted(self) -> tuple[Json, ...]:
        """A row of each record; ``record`` is its name, the site's where that states one only."""
        return tuple({**row, "record": get_record_name(row)} for row in self.predict.get("sites", ()))

    def records_of(self, site: str) -> tuple[str, ...]:
        """Names of the records of a site that are stored."""
        return tuple(name for name, facts in self.traces.items() if facts.get("site", name) == site)

    @property
    def fitted(self) -> tuple[str, ...]:
        rows = self.sites or self.predicted
        return tuple(row["site"] for row in rows if row.get("fitted"))

    @property
    def stages(self) -> tuple[Json, ...]:
        """The stages of the identification, one material first."""
        return tuple(self.calibration.get("stages", ()))

    @property
    def tissues(self) -> tuple[str, ...]:
        """Names of the identified tissues, outermost first; none where nothing was identified."""
        return tuple(self.stages[-1].get("parameters", ())) if self.stages else ()

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Tissue and key of every identified parameter."""
        return tuple((tissue, key) for tissue in self.tissues for key in self.law.keys)

    @property
    def law(self) -> TissueLaw:
        """What the identification says of the tissues' law."""
        return TissueLaw.of_record(self.calibration.get("law") or {})

    @property
    def materials(self) -> str:
        """What the model with a material for each tissue is called: ``two materials``."""
        return str(self.stages[-1].get("name")) if self.stages else "identified materials"

    def mean_error(self, use: str) -> str:
        """``4.5 ± 1.0``: mean and standard deviation of the errors at ``fitted`` or ``heldout`` sites, %."""
        mean, sd = (self.predict.get(f"{kind}_error_{use}_percent") for kind in ("mean", "sd"))
        return format_fixed(mean) if sd is None else f"{format_fixed(mean)} ± {format_fixed(sd)}"

    @property
    def uncertainty(self) -> Json:
        """What the calibration says of its intervals."""
        return self.calibration.get("uncertainty") or {}

    def interval(self, tissue: str, name: str) -> list[float] | None:
        """The stored 95 % interval of a parameter."""
        limits = (self.uncertainty.get("intervals_95") or {}).get(tissue, {}).get(name)
        return limits if limits and None not in limits else None

    def describe_parameter(self, name: str) -> str:
        """A parameter's symbol and what it is."""
        words = {parameter.key: parameter.words for parameter in self.law.parameters}
        return ", ".join(part for part in (format_symbol(name), words.get(name, "")) if part)

    def describe_tissue(self, tissue: str) -> str:
        """A tissue as the head of a row; the two of the paper as the paper names them."""
        return PAPER_TISSUES[tissue] if self.has_paper_tissues else tissue.replace("_", " ").capitalize()

    @property
    def has_paper_tissues(self) -> bool:
        """True for the two tissues of the paper, where fat is no tissue of its own."""
        return self.tissues == tuple(PAPER_TISSUES)

    @property
    def surface_files(self) -> dict[str, Path]:
        """``skin``, each ``bone-<name>`` and each ``region-<name>``: the surfaces that are stored."""
        folder = self.folder / "surfaces"
        inner = (p for kind in ("bone", "region") for p in sorted(folder.glob(f"{kind}-*.stl")))
        files = {"skin": folder / "skin.stl"} | {p.stem: p for p in inner}
        return {name: path for name, path in files.items() if path.is_file()}

    def region(self, site: str) -> str:
        rows = {row["site"]: row for row in (*self.predicted, *self.sites)}
        return str(rows.get(site, {}).get("region") or "")

    @property
    def placed_sites(self) -> dict[str, Json]:
        """The sites whose place and axis are known, by name."""
        return {row["site"]: row for row in self.sites if row.get("position_mm") and row.get("axis")}

    def curves(self, stage: str, name: str) -> Curves | None:
        """The columns of ``<stage>/<name>.csv``, or None where there is no such file."""
        file = self.folder / stage / f"{name}.csv"
        return _read_csv(file) if file.is_file() else None

    def record_curves(self, record: str) -> tuple[Curves | None, Curves | None, tuple[float, float]]:
        """A record as the robot wrote it, regularised in the same time and displacement, and touch-down."""
        raw, regular = self.curves("traces", f"{record}-raw"), self.curves("traces", record)
        facts = self.traces.get(record, {})
        time_s, depth_mm = facts.get("touch_down_s", 0.0), facts.get("touch_down_mm", 0.0)
        if regular is not None:
            time, depth = regular["time_s"] + time_s, regular["displacement_mm"] + depth_mm
            regular = {"time_s": time, "displacement_mm": depth, "force_N": regular["force_N"]}
        return raw, regular, (time_s, depth_mm)

    def with_curves(self, stage: str, rows: Iterable[Json]) -> list[tuple[Json, Curves]]:
        """Rows of records with the curves that the stage stored, where it did."""
        found = ((row, self.curves(stage, get_record_name(row))) for row in rows)
        return [(row, curves) for row, curves in found if curves is not None]

    def vtu(self, stage: str, site: str) -> Path | None:
        """The mesh or fields of a site; of several records' fields the first."""
        files = (self.folder / stage / f"{name}.vtu" for name in (site, *self.records_of(site)))
        return next((file for file in files if file.is_file()), None)


def get_record_name(row: Json) -> str:
    """The name of a row's record; the site's where that states one only."""
    return str(row.get("record", row["site"]))


def find_compared_quantity(curves: Curves) -> tuple[str, str]:
    """What curves compare, and its unit: force, or displacement where a force was stated."""
    return ("displacement", "mm") if "displacement_measured_mm" in curves else ("force", "N")


def load_store(results: Path) -> Results:
    """Read what is below ``results``.

    Raises
    ------
    InputError
        When there is no such folder, or a summary in it is not readable.
    """
    if not results.is_dir():
        raise InputError("no results there", file=results, remedy="run the study first")
    sites = _read_json(results / "sites" / "sites.json").get("sites", [])
    run = _read_json(results / "run.json")
    states = {name: row.get("state") for name, row in (run.get("experiments") or {}).items()}
    done = [name for name, state in states.items() if state == "done"]
    return Results(
        folder=results,
        run=run,
        segment=_read_json(results / "segment" / "segment.json"),
        surfaces=_read_json(results / "surfaces" / "surfaces.json"),
        sites=tuple(sites),
        traces=_read_json(results / "traces" / "traces.json").get("sites", {}),
        mesh=_read_json(results / "mesh" / "mesh.json").get("sites", {}),
        calibration=_read_json(results / "calibrate" / "calibration.json"),
        predict=_read_json(results / "predict" / "predict.json"),
        simulated=tuple(_read_json(file) for file in sorted((results / "simulate").glob("*.json"))),
        compared=tuple(_read_json(file) for file in sorted((results / "compare").glob("*.json"))),
        truth=_read_json(results / "truth.json"),
        experiments={name: _read_json(results / name / f"{name}.json") for name in done},
        outdated=tuple(name for name, state in states.items() if state == "stale"),
        models=_read_json(results / "models" / "models.json"),
    )


def _read_json(file: Path) -> Json:
    if not file.is_file():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"not readable: {error}", file=file, remedy="run its stage again") from None
    if not isinstance(content, dict):
        raise InputError("not a JSON object", file=file, remedy="run its stage again")
    return content


def _read_csv(file: Path) -> Curves:
    lines = file.read_text(encoding="utf-8").splitlines()
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    try:
        values = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"not readable: {error}", file=file, remedy="run its stage again") from None
    if values.shape[1:] != (len(names),):
        raise InputError("its rows do not fit its header", file=file, remedy="run its stage again")
    return {name: values[:, i] for i, name in enumerate(names)}
