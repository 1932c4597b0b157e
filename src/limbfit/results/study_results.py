"""All stored results of a study by name, each read when it is first used."""

from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ..arrays import Array
from ..errors import InputError
from . import variants
from .base import StoredResult, read_curves
from .identification import CalibrationResult, PredictResult
from .limb import MeshResult, QualityResult, SegmentResult, SitesResult, SurfacesResult, TracesResult
from .planning import DesignResult, ProtocolResult
from .population import PopulationResult
from .runs import CompareResult, RunResult, SimulateResult, StageStamp
from .socket import SensorsResult, SocketDesignResult, SocketResult
from .uncertainty import CrossvalidateResult, ModelsResult, RegionsResult, SocketOfModels, UncertaintyResult

R = TypeVar("R", bound=StoredResult)


class HasResults(Protocol):
    """A study: its ``results`` is the folder of its results."""

    @property
    def results(self) -> Path: ...


class OneFile(cached_property[R]):
    """An attribute of `StudyResults` that has one file."""

    def __init__(self, model: type[R]) -> None:
        super().__init__(lambda results: model.read(results.folder))
        self.model = model


class ManyFiles(cached_property[dict[str, R]]):
    """An attribute of `StudyResults` that has a file for each site or stage: a dictionary by their names."""

    def __init__(self, model: type[R]) -> None:
        super().__init__(lambda results: model.find_all(results.folder))
        self.model = model


class StudyResults:
    """The stored results of a study; an attribute is read from its file when it is first used.

    An attribute whose command was not run yet raises `limbfit.InputError`, which names the command. Those
    with several files (``stages``, ``simulate``, ``compare``) are dictionaries by stage or site.
    """

    run = OneFile(RunResult)
    stages = ManyFiles(StageStamp)
    segment = OneFile(SegmentResult)
    quality = OneFile(QualityResult)
    surfaces = OneFile(SurfacesResult)
    sites = OneFile(SitesResult)
    traces = OneFile(TracesResult)
    mesh = OneFile(MeshResult)
    sensors = OneFile(SensorsResult)
    calibration = OneFile(CalibrationResult)
    predict = OneFile(PredictResult)
    uncertainty = OneFile(UncertaintyResult)
    crossvalidate = OneFile(CrossvalidateResult)
    regions = OneFile(RegionsResult)
    sensitivity_c = OneFile(variants.StiffnessResult)
    sensitivity_kappa = OneFile(variants.VolumeResult)
    sensitivity_contact = OneFile(variants.FrictionResult)
    sensitivity_indenter = OneFile(variants.IndenterResult)
    sensitivity_mesh = OneFile(variants.RefinementResult)
    cube = OneFile(variants.CubeResult)
    models = OneFile(ModelsResult)
    models_socket = OneFile(SocketOfModels)
    socket = OneFile(SocketResult)
    socket_design = OneFile(SocketDesignResult)
    design = OneFile(DesignResult)
    protocol = OneFile(ProtocolResult)
    simulate = ManyFiles(SimulateResult)
    compare = ManyFiles(CompareResult)

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __repr__(self) -> str:
        stored = [name for name, model in MODELS.items() if any(self.folder.glob(model.FILE))]
        return f"StudyResults({str(self.folder)!r}: {', '.join(stored) or 'nothing is stored yet'})"

    def curves(self, stage: str, name: str) -> dict[str, Array]:
        """Return the columns (n,) of ``results/<stage>/<name>.csv`` by their heads, such as ``force_N``.
        Raises `InputError` where there is no such file; it names those that there are.
        """
        file = self.folder / stage / f"{name}.csv"
        if not file.is_file():
            there = ", ".join(sorted(one.stem for one in file.parent.glob("*.csv"))) or "none"
            raise InputError("no such curves", file=file, remedy=f"there are: {there}")
        return read_curves(file)


MODELS: dict[str, type[StoredResult]] = {  # of each stored result, by its attribute
    name: kind.model for name, kind in vars(StudyResults).items() if isinstance(kind, OneFile | ManyFiles)
}
ALL_MODELS = MODELS | {"population": PopulationResult}


def load_results(study: HasResults | str | Path) -> StudyResults:
    """Load the stored results, stale or not, of a study, of its file or of its folder.

    ``load_results(study).predict.sites[0].error_percent``, for example. Raises `InputError` where nothing is
    stored.
    """
    if isinstance(study, str | Path):
        study = Path(study).parent if Path(study).is_file() else Path(study)
    folder = study / "results" if isinstance(study, Path) else study.results
    if not folder.is_dir():
        raise InputError("nothing is stored there", file=folder, remedy="run limbfit run first")
    return StudyResults(folder)


def build_schema(result: str) -> dict[str, Any]:
    """Build the JSON schema of a stored result. Raises `InputError` for a name that no result has."""
    if result not in ALL_MODELS:
        raise InputError(f"no result is named {result!r}", remedy=f"use {', '.join(ALL_MODELS)}")
    return ALL_MODELS[result].model_json_schema()
