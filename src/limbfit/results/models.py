"""Other models of the same records, weighed, and what predictions and sockets owe to the choice."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Interval, Parameters, ResultPart, StoredResult


class ModelWeight(ResultPart):
    """A model, and how likely the fitted records make it."""

    model: str = Field(description="Its name in `--models`; the study's own model comes first.")
    words: str = Field(description="What it is.")
    weight: float = Field(description="Its probability; all are alike before the records are seen.")


class CalibratedModel(ModelWeight):
    """A model that was calibrated on the fitted records."""

    evidence: float = Field(description="2 ln B against the study's own model; positive: preferred to it.")
    error_fitted_percent: float | None = Field(description="Mean error at fitted sites.")
    error_heldout_percent: float | None = Field(description="Mean error at held-out sites; null: none.")
    parameters: Parameters = Field(description="Its identified parameters.")


class MixedPrediction(ResultPart):
    """A record's largest value, predicted by the study's own model and by all."""

    site: str = Field(description="Name of the site.")
    record: str = Field(description="Name of the record.")
    fitted: bool = Field(description="Whether the record was fitted.")
    unit: str = Field(description="Unit of the values: `N` or `mm`.")
    peak: float = Field(description="The largest measured value.")
    own_interval_95: Interval = Field(description="95 % interval there, by the study's own model.")
    interval_95: Interval = Field(description="95 % interval there, by all models.")
    sd_between_models: float = Field(description="Standard deviation between the models there.")
    inside_percent: float = Field(description="Measured values inside the band of all models.")


class ModelsResult(StoredResult):
    """Other models of the same records."""

    FILE: ClassVar = "models/models.json"
    COMMAND: ClassVar = "limbfit uncertainty --models"

    models: Sequence[CalibratedModel] = Field(description="The models, the study's own first.")
    records: Sequence[MixedPrediction] = Field(description="The records that every model predicts.")
    left_out: Mapping[str, str] = Field(description="Models that the study cannot have, and why.")


class MixedPressure(ResultPart):
    """The mean pressure of a region, by each model and by all."""

    region: str = Field(description="Name of the region.")
    mean_kPa: Sequence[float] = Field(description="Mean pressure by each of the models, in their order.")
    interval_kPa: Interval = Field(description="95 % interval by all models.")


class MixedLoad(ResultPart):
    """Donning or a load."""

    name: str = Field(description="Its name.")
    regions: Sequence[MixedPressure] = Field(description="The regions.")


class SocketOfModels(StoredResult):
    """The study's socket on the limb, with every model that counts."""

    FILE: ClassVar = "models/socket.json"
    COMMAND: ClassVar = "limbfit socket --models"

    models: Sequence[ModelWeight] = Field(description="The models, the study's own first if it counts.")
    loads: Sequence[MixedLoad] = Field(description="Donning, then each load.")
