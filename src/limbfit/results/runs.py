"""What was done, with what and when: `run.json`, `stage.json`, and what single commands store."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pydantic import ConfigDict, Field

from .base import Parameters, ResultPart, StoredResult
from .identification import CalibrationResult, OutsideRecords


class StudyName(ResultPart):
    """What the study is called."""

    name: str = Field(description="Name of the study.")
    description: str = Field(description="Its description.")
    extensions: Sequence[str] = Field(description="Digests of its files that register laws and shapes.")


class MachineFacts(ResultPart):
    """The machine, without names."""

    cores: int | None = Field(description="Number of cores.")
    python: str = Field(description="Version of Python.")
    system: str = Field(description="Operating system.")
    processor: str = Field(description="Type of processor.")
    memory_GB: float | None = Field(default=None, description="Memory, where the system says so.")


class StageRecord(ResultPart):
    """When a stage was done."""

    seconds: float = Field(description="Time that it took, in s.")
    finished: str = Field(description="When it was finished, UTC.")
    key: str = Field(description="Digest of all that it depends on.")


class ExperimentRecord(ResultPart):
    """When an experiment was done."""

    state: str = Field(description="`done` or `stale`.")
    seconds: float | None = Field(description="Time that it took, in s.")
    finished: str | None = Field(description="When it was finished, UTC; null for a stale one.")
    options: Mapping[str, Any] = Field(description="Its options.")
    key: str = Field(description="Digest of all that it would depend on now.")


class RunResult(StoredResult):
    """What the results were made with."""

    FILE: ClassVar = "run.json"

    limbfit: str = Field(description="Version of limbfit.")
    study: StudyName = Field(description="What the study is called.")
    settings: Mapping[str, Any] = Field(description="Every setting; digests in place of paths.")
    versions: Mapping[str, str] = Field(description="Versions of the libraries.")
    machine: MachineFacts = Field(description="The machine.")
    inputs: Mapping[str, str] = Field(description="SHA-256 of each input, by its key in the study.")
    stages: Mapping[str, StageRecord] = Field(description="Each stage that is done.")
    experiments: Mapping[str, ExperimentRecord] = Field(description="Each experiment that is done or stale.")


class StageParts(ResultPart):
    """Digests of what a stage's key is made of."""

    settings: Mapping[str, str] = Field(description="Digest of each setting.")
    inputs: Mapping[str, str] = Field(description="Digest of each input.")
    code: Mapping[str, str] = Field(description="Digest of each file of code.")
    stages: Mapping[str, str] = Field(description="Key of each stage below.")


class StageStamp(StoredResult):
    """The stamp of a stage or experiment that is done; one of an extension may have keys of its own."""

    model_config = ConfigDict(extra="allow")

    FILE: ClassVar = "*/stage.json"

    stage: str = Field(description="Name of the stage or experiment.")
    key: str = Field(description="Digest of all that it depends on.")
    seconds: float = Field(description="Time that it took, in s, over all attempts.")
    finished: str = Field(description="When it was finished, UTC.")
    parts: StageParts | None = Field(default=None, description="What the key is made of.")
    options: Mapping[str, Any] = Field(default={}, description="The options of an experiment.")
    runs: int | None = Field(default=None, description="Number of simulations of the emulator.")


class SimulateResult(StoredResult):
    """An indentation that `limbfit simulate` solved."""

    FILE: ClassVar = "simulate/*.json"
    COMMAND: ClassVar = "limbfit simulate"

    site: str = Field(description="Name of the record or site.")
    solver: str = Field(description="`limbfit`, or FEBio with its version.")
    parameters: Parameters = Field(description="The parameters of the tissues.")
    parameters_from: str = Field(description="Where these are from.")
    peak_force_N: float = Field(description="Largest force.")
    depth_mm: float = Field(description="Largest displacement.")
    penetration_mm: float | None = Field(description="How deep the indenter is in the skin at most.")
    completed: bool = Field(description="Whether the simulation came to its end.")
    reason: str = Field(description="Why it did not.")
    warnings: Sequence[str] = Field(description="What is doubtful, in words.")
    element: str = Field(description="Type of the cells.")
    unknowns: int = Field(description="Number of unknowns.")
    outside_records: Sequence[OutsideRecords] | None = Field(description="What of it no fitted record did.")
    outside_text: Sequence[str] = Field(description="That in words.")
    curve: str = Field(description="File of the curve, beside this one.")
    fields: str | None = Field(description="File of the fields, beside this one.")
    animation: str | None = Field(description="File of the animation, beside this one.")


class SolverRun(ResultPart):
    """A simulation by one program."""

    completed: bool = Field(description="Whether the simulation came to its end.")
    reason: str = Field(description="Why it did not.")
    peak_force_N: float = Field(description="Largest force.")
    steps: int = Field(description="Number of steps.")
    seconds: float | None = Field(description="Time that it took, in s; null where it is not known.")


class FebioSimulation(SolverRun):
    """The simulation by FEBio."""

    version: str = Field(description="FEBio with its version.")
    penalty: float | None = Field(description="Penalty over FEBio's automatic one; null: explicit.")


class CurveDifference(ResultPart):
    """limbfit's force less FEBio's, of FEBio's largest; null where FEBio has no force."""

    max_percent: float | None = Field(description="Largest difference.")
    mean_percent: float | None = Field(description="Mean difference.")
    peak_percent: float | None = Field(description="Difference of the largest forces.")


class LimbfitSimulation(SolverRun):
    """A simulation by limbfit."""

    penetration_mm: float = Field(description="How deep the indenter is in the skin at most.")
    difference: CurveDifference = Field(description="Difference from FEBio.")


class CurveFiles(ResultPart):
    """Files of a comparison."""

    csv: str = Field(description="The curves.")
    png: str = Field(description="The picture.")


class CompareResult(StoredResult):
    """An indentation by limbfit and by FEBio."""

    FILE: ClassVar = "compare/*.json"
    COMMAND: ClassVar = "limbfit compare"

    site: str = Field(description="Name of the record or site.")
    parameters: Parameters = Field(description="The parameters of the tissues.")
    parameters_from: str = Field(description="Where these are from.")
    element: str = Field(description="Type of the cells.")
    unknowns: int = Field(description="Number of unknowns.")
    febio: FebioSimulation = Field(description="FEBio.")
    limbfit: LimbfitSimulation = Field(description="limbfit, as it is used.")
    limbfit_matched: LimbfitSimulation = Field(description="limbfit with FEBio's steps and penalty.")
    febio_log: str | None = Field(description="FEBio's table of forces, where it was given.")
    files: CurveFiles = Field(description="Files of the comparison.")


def is_current(row: SimulateResult | CompareResult, calibration: CalibrationResult | None) -> bool:
    """False where it was simulated with identified parameters, and others (or none) are identified now."""
    if row.parameters_from != "identified":
        return True
    return calibration is not None and row.parameters == calibration.parameters
