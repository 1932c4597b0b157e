"""The records as they are used: what the stage `traces` stores; and what warnings about records say."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import ResultPart, StoredResult


class RecordPhase(ResultPart):
    """What the indenter does for a time."""

    kind: str = Field(description="`approach`, `load`, `hold` or `unload`.")
    start_s: float = Field(description="Start, in the time of the record.")
    end_s: float = Field(description="End, in the time of the record.")
    start_mm: float = Field(description="Displacement from touch-down at the start.")
    end_mm: float = Field(description="Displacement from touch-down at the end.")
    rate_mm_s: float = Field(description="Mean speed; negative on the way out.")


class RecordRemark(ResultPart):
    """What reading a record warns of."""

    kind: str = Field(description="Kind of the warning.")
    what: str = Field(description="What is wrong, in words.")
    cause: str = Field(description="Likely cause.")
    remedy: str = Field(description="What can be done about it.")
    evidence: Mapping[str, float] = Field(description="Numbers that show it, by name with unit.")


class RecordFlag(RecordRemark):
    """A warning about records."""

    sites: Sequence[str] = Field(description="The records that it is about; none: all.")
    text: str = Field(description="The whole warning in a sentence.")
    found: str = Field(description="`in the record`, or `against the model`.")


class LayerRecord(ResultPart):
    """A tissue as ultrasound showed it under the indenter."""

    thickness_mm: float = Field(description="Thickness before touch-down.")
    compression_mm: float = Field(description="Largest compression.")
    before: int = Field(description="Readings before touch-down.")
    sd_mm: float = Field(description="Standard deviation of a reading.")
    compared: bool = Field(description="Whether it moves enough to be compared.")


class SurfaceRecord(ResultPart):
    """The skin around the indenter as cameras showed it."""

    points: int = Field(description="Number of points.")
    frames: int = Field(description="Number of frames in contact.")
    displacement_mm: float = Field(description="Largest displacement.")
    sd_mm: float = Field(description="Standard deviation of a reading.")
    compared: bool = Field(description="Whether it moves enough to be compared.")


class WaveRecord(ResultPart):
    """Shear waves at a place under the indenter."""

    name: str = Field(description="Name of the place: tissue and depth.")
    tissue: str = Field(description="Name of the tissue.")
    depth_mm: float | None = Field(description="Depth under the skin.")
    readings: int = Field(description="Number of readings.")
    from_m_s: float = Field(description="Lowest speed.")
    to_m_s: float = Field(description="Highest speed.")


class TraceFacts(ResultPart):
    """A record as it is used; times are those of the file where nothing else is said."""

    site: str = Field(description="Name of the site.")
    control: str = Field(description="What the device was told: `displacement` or `force`.")
    touch_down_s: float = Field(description="Time of touch-down.")
    touch_down_mm: float = Field(description="Displacement in the file at touch-down.")
    touch_down_uncertainty_mm: float = Field(description="Standard deviation of the touch-down.")
    peak_s: float = Field(description="Time of the largest force.")
    peak_force_N: float = Field(description="Largest force.")
    depth_mm: float = Field(description="Largest displacement from touch-down.")
    noise_N: float = Field(description="Standard deviation of the force's noise.")
    speed_load_mm_s: float = Field(description="Speed of loading.")
    speed_unload_mm_s: float | None = Field(description="Speed of unloading; null where it does not unload.")
    phases: Sequence[RecordPhase] = Field(description="The phases of the record.")
    phases_in_words: str = Field(description="The phases in words.")
    knots_s: Sequence[float] = Field(description="Times from touch-down of the simulated history.")
    knots_mm: Sequence[float] = Field(description="Displacement from touch-down at these times.")
    knots_N: Sequence[float] | None = Field(description="Force at these times, where it is stated.")
    remarks: Sequence[RecordRemark] = Field(description="What reading the record warns of.")
    layers: Mapping[str, LayerRecord] = Field(default={}, description="Tissues seen by ultrasound.")
    surface: SurfaceRecord | None = Field(default=None, description="The skin seen by cameras.")
    waves: Sequence[WaveRecord] = Field(default=(), description="Shear waves under the indenter.")


class TracesResult(StoredResult):
    """The records, regularised and counted from touch-down."""

    FILE: ClassVar = "traces/traces.json"

    sites: Mapping[str, TraceFacts] = Field(description="Each record, by its name.")
