"""The stored results of a study, read and nothing more: JSON summaries, CSV curves, paths of geometry."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from ..arrays import Array
from ..errors import InputError
from ..laws import TissueLaw
from ..results import identification, limb
from ..results.base import Interval, ResultPart, StoredResult, read_curves
from ..results.runs import CompareResult, RunResult, SimulateResult, is_current
from ..results.socket import SocketResult
from ..results.study_results import MODELS
from ..results.uncertainty import ModelsResult
from .formats import format_fixed

Curves = dict[str, Array]
Json = dict[str, Any]


Row = TypeVar("Row", bound=ResultPart)  # of a record, or of a site


@dataclass(frozen=True)
class Results:
    """A results folder; what is not there (yet) is None or empty.

    ``experiments``: what each finished experiment stored, by its name (of an extension as its file has it);
    ``outdated``: those that are stale. ``models``: other models of the same records, unless they are stale.
    """

    folder: Path
    run: RunResult | None
    segment: limb.SegmentResult | None
    surfaces: limb.SurfacesResult | None
    sites: Sequence[limb.PlacedSite]
    traces: Mapping[str, limb.TraceFacts]
    mesh: Mapping[str, limb.MeshMeasures]
    calibration: identification.CalibrationResult | None
    predict: identification.PredictResult | None
    simulated: tuple[SimulateResult, ...]
    compared: tuple[CompareResult, ...]
    truth: Json
    experiments: Mapping[str, StoredResult | Json] = field(default_factory=dict)
    outdated: tuple[str, ...] = ()
    models: ModelsResult | None = None

    @property
    def site_names(self) -> tuple[str, ...]:
        """Names of the sites in the order of the study, whichever stage knows them."""
        known = [site.site for site in self.sites] or [site.site for site in self.predicted]
        return tuple(known or self.traces)

    @property
    def predicted(self) -> Sequence[identification.RecordPrediction]:
        """A row of each record."""
        return self.predict.sites if self.predict else ()

    @property
    def compared_quantity(self) -> str:
        """What the records compare: see `name_compared`."""
        return name_compared(self.predicted)

    def records_of(self, site: str) -> tuple[str, ...]:
        """Names of the records of a site that are stored."""
        return tuple(name for name, facts in self.traces.items() if facts.site == site)

    @property
    def fitted(self) -> tuple[str, ...]:
        rows = self.sites or self.predicted
        return tuple(dict.fromkeys(row.site for row in rows if row.fitted))

    @property
    def socket(self) -> SocketResult | None:
        """What the experiment ``socket`` stored, where it is not stale."""
        found = self.experiments.get("socket")
        return found if isinstance(found, SocketResult) else None

    @property
    def stages(self) -> Sequence[identification.SearchStage]:
        """The stages of the identification, one material first."""
        return self.calibration.stages if self.calibration else ()

    @property
    def tissues(self) -> tuple[str, ...]:
        """Names of the identified tissues, outermost first; none where nothing was identified."""
        return tuple(self.stages[-1].parameters) if self.stages else ()

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Tissue and key of every identified parameter."""
        return tuple((tissue, key) for tissue in self.tissues for key in self.law.keys)

    @property
    def law(self) -> TissueLaw:
        """What the identification says of the tissues' law."""
        return TissueLaw.of_record(self.calibration.law.to_plain() if self.calibration else {})

    @property
    def materials(self) -> str:
        """What the model with a material for each tissue is called: ``two materials``."""
        return self.stages[-1].name if self.stages else "identified materials"

    def mean_error(self, use: str) -> str:
        """``4.5 ± 1.0``: mean and standard deviation of the errors at ``fitted`` or ``heldout`` sites, %."""
        mean, sd = (getattr(self.predict, f"{kind}_error_{use}_percent", None) for kind in ("mean", "sd"))
        return format_fixed(mean) if sd is None else f"{format_fixed(mean)} ± {format_fixed(sd)}"

    @property
    def uncertainty(self) -> identification.CalibrationUncertainty | None:
        """What the calibration says of its intervals."""
        return self.calibration.uncertainty if self.calibration else None

    def interval(self, tissue: str, name: str) -> Interval | None:
        """The stored 95 % interval of a parameter."""
        return self.uncertainty.intervals_95[tissue][name] if self.uncertainty else None

    @property
    def has_paper_tissues(self) -> bool:
        """True for the two tissues of the paper, where fat is no tissue of its own."""
        return self.tissues == ("skin", "muscle")

    @property
    def surface_files(self) -> dict[str, Path]:
        """``skin``, each ``bone-<name>`` and each ``region-<name>``: the surfaces that are stored."""
        folder = self.folder / "surfaces"
        inner = (p for kind in ("bone", "region") for p in sorted(folder.glob(f"{kind}-*.stl")))
        files = {"skin": folder / "skin.stl"} | {p.stem: p for p in inner}
        return {name: path for name, path in files.items() if path.is_file()}

    @property
    def placed_sites(self) -> dict[str, limb.PlacedSite]:
        """The sites by name."""
        return {row.site: row for row in self.sites}

    def curves(self, stage: str, name: str) -> Curves | None:
        """The columns of ``<stage>/<name>.csv``, or None where there is no such file."""
        file = self.folder / stage / f"{name}.csv"
        return read_curves(file) if file.is_file() else None

    def record_curves(self, record: str) -> tuple[Curves | None, Curves | None, tuple[float, float]]:
        """A record as the robot wrote it, regularised in the same time and displacement, and touch-down."""
        raw, regular = self.curves("traces", f"{record}-raw"), self.curves("traces", record)
        facts = self.traces.get(record)
        time_s, depth_mm = (facts.touch_down_s, facts.touch_down_mm) if facts else (0.0, 0.0)
        if regular is not None:
            time, depth = regular["time_s"] + time_s, regular["displacement_mm"] + depth_mm
            regular = {"time_s": time, "displacement_mm": depth, "force_N": regular["force_N"]}
        return raw, regular, (time_s, depth_mm)

    def with_curves(self, stage: str, rows: Iterable[Row]) -> list[tuple[Row, Curves]]:
        """Rows of records with the curves that the stage stored, where it did."""
        names = ((row, getattr(row, "record", "") or getattr(row, "site", "")) for row in rows)
        found = ((row, self.curves(stage, str(name))) for row, name in names)
        return [(row, curves) for row, curves in found if curves is not None]

    def vtu(self, stage: str, site: str) -> Path | None:
        """The mesh or fields of a site; of several records' fields the first."""
        files = (self.folder / stage / f"{name}.vtu" for name in (site, *self.records_of(site)))
        return next((file for file in files if file.is_file()), None)


def name_compared(rows: Sequence[identification.RecordPrediction]) -> str:
    """What records compare: ``force``, ``displacement`` where they state the force, or either."""
    forced = [row.control == "force" for row in rows]
    return "force" if not any(forced) else "displacement" if all(forced) else "force or displacement"


def find_compared_quantity(curves: Curves) -> tuple[str, str]:
    """What curves compare, and its unit: force, or displacement where a force was stated."""
    return ("displacement", "mm") if "displacement_measured_mm" in curves else ("force", "N")


def load_store(results: Path) -> Results:
    """Read what is below ``results``; `InputError` where it is no folder, or a summary is not readable."""
    if not results.is_dir():
        raise InputError("no results there", file=results, remedy="run the study first")
    run, calibration = RunResult.find(results), identification.CalibrationResult.find(results)
    sites, traces = limb.SitesResult.find(results), limb.TracesResult.find(results)
    mesh, models = limb.MeshResult.find(results), ModelsResult.find(results)
    experiments = run.experiments if run else {}
    done = [name for name, row in experiments.items() if row.state == "done"]
    outdated = [name for name, row in experiments.items() if row.state == "stale"]
    # Other models have no stamp: they belong to the identification whose parameters stand beside theirs.
    if models and not (calibration and models.models[0].parameters == calibration.parameters):
        models = None
        outdated.append("uncertainty --models")
    simulated, compared = SimulateResult.find_all(results), CompareResult.find_all(results)
    for verb, rows in (("simulate", simulated), ("compare", compared)):
        for name in [name for name, row in rows.items() if not is_current(row, calibration)]:
            outdated.append(f"{verb} --site {rows.pop(name).site}")
    return Results(
        folder=results,
        run=run,
        # Of a study that has surfaces now it is what an image left that it had before.
        segment=None if run and "segment" not in run.stages else limb.SegmentResult.find(results),
        surfaces=limb.SurfacesResult.find(results),
        sites=sites.sites if sites else (),
        traces=traces.sites if traces else {},
        mesh=mesh.sites if mesh else {},
        calibration=calibration,
        predict=identification.PredictResult.find(results),
        simulated=tuple(simulated.values()),
        compared=tuple(compared.values()),
        truth=_read_json(results / "truth.json"),
        experiments={name: _read_experiment(results, name) for name in done},
        outdated=tuple(outdated),
        models=models,
    )


def _read_experiment(results: Path, name: str) -> StoredResult | Json:
    model = MODELS.get(name.replace("-", "_"))
    return model.read(results) if model else _read_json(results / name / f"{name}.json")


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
