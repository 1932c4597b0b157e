"""Which records to make: the experiments `design` and `protocol`."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Matrix, Parameters, ResultPart, StoredResult


class ExpectedNoise(ResultPart):
    """What the force of a record is expected to be off by."""

    sensor_N: float = Field(description="Standard deviation of a reading.")
    misfit: float = Field(default=0.0, description="The model's own error over the largest force.")
    correlation: float = Field(default=0.9, description="Correlation of that error at neighbouring points.")
    bias_N: float = Field(default=0.0, description="Standard deviation of what shifts all points.")


class DesignSite(ResultPart):
    """A site of a design."""

    site: str = Field(description="Name of the site.")
    depth_mm: float = Field(description="Depth of the indentation.")


class SiteDesign(ResultPart):
    """A choice of sites."""

    design: str = Field(description="Name of the choice.")
    sites: Sequence[DesignSite] = Field(description="Its sites.")
    d_efficiency: float = Field(
        description="Efficiency for the volume of the confidence region; the best: 1."
    )
    a_efficiency: float = Field(description="Efficiency for the mean variance; the best: 1.")
    factor_95: Mapping[str, float] = Field(description="Factor of the 95 % interval of each parameter.")
    exhaustive: bool = Field(description="Whether every choice was compared.")


class DesignCandidate(DesignSite):
    """An indentation that may be made."""

    peak_force_N: float = Field(description="Largest force.")
    bits: float = Field(description="Information that it alone adds, in bits.")


class DesignResult(StoredResult):
    """Which sites to indent."""

    FILE: ClassVar = "design/design.json"
    COMMAND: ClassVar = "limbfit design"

    wanted: int = Field(description="Number of sites to choose.")
    designs: Sequence[SiteDesign] = Field(description="Each choice.")
    verdict: str = Field(description="In words.")
    candidates: Sequence[DesignCandidate] = Field(description="Each indentation that may be made.")
    left_out: Sequence[str] = Field(description="What was left out, and why.")
    parameters: Parameters = Field(description="The parameters of the tissues.")
    parameters_from: str = Field(description="Where these are from.")
    noise: ExpectedNoise = Field(description="What records are expected to be off by.")


class ProtocolRecord(ResultPart):
    """A record that may be made."""

    site: str = Field(description="Name of the site.")
    indenter: str = Field(description="Name of the indenter.")
    depth_mm: float = Field(description="Depth of the indentation.")
    speed_mm_s: float = Field(description="Speed of the indenter.")
    hold_s: float = Field(description="Duration of the hold.")
    seconds: float = Field(description="Time that it takes with rest, in s.")
    peak_force_N: float = Field(description="Largest force.")


class ProtocolPlan(ResultPart):
    """What to expect of a protocol."""

    design: str = Field(description="Name of the protocol.")
    records: int = Field(description="Number of its records.")
    minutes: float = Field(description="Time that it takes, in minutes.")
    factor_95: Mapping[str, float] = Field(description="Factor of the 95 % interval of each parameter.")
    worst_95: Mapping[str, float] = Field(description="The largest over all draws.")
    pressures_95: Mapping[str, float] = Field(description="The factor of each pressure of the socket.")
    determined: int = Field(description="Number of parameters within 25 %.")
    cost: float = Field(description="Value of the criterion.")


class ProtocolResult(StoredResult):
    """Which records a session should make."""

    FILE: ClassVar = "protocol/protocol.json"
    COMMAND: ClassVar = "limbfit design --protocol"

    minutes: float = Field(description="Length of the session, in minutes.")
    setup_s: float = Field(description="Time for each place of the device.")
    rest_s: float = Field(description="Rest after each record.")
    criterion: str = Field(description="`D` or `A`.")
    determine: Sequence[str] = Field(description="Parameters to be determined.")
    draws: Matrix = Field(description="Parameters of the tissues that were drawn, one row a draw.")
    records: Sequence[ProtocolRecord] = Field(description="The records of the protocol, in order.")
    pressures: Sequence[str] = Field(description="Pressures of the socket that count.")
    protocols: Sequence[ProtocolPlan] = Field(description="The protocol beside others.")
    verdict: str = Field(description="In words.")
    candidates: Sequence[ProtocolRecord] = Field(description="Each record that may be made.")
    left_out: Sequence[str] = Field(description="What was left out, and why.")
    parameters: Parameters = Field(description="The parameters of the tissues.")
    parameters_from: str = Field(description="Where these are from.")
    noise: ExpectedNoise = Field(description="What records are expected to be off by.")
    ultrasound_sd_mm: float | None = Field(description="Standard deviation of ultrasound; null: none.")
    surface_sd_mm: float | None = Field(description="Standard deviation of cameras; null: none.")
    shear_waves_sd_m_s: float | None = Field(description="Standard deviation of shear waves; null: none.")
