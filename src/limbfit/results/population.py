"""The stored results of a trial on virtual people, and the figures of a shape model."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Interval, ResultPart, StoredResult

WORST_PLACE = "worst region"  # of a person: the region with the largest mean pressure under any load


class ShapeModelResult(ResultPart):
    """How good a shape model is."""

    limbs: int = Field(description="Number of limbs that it was made of.")
    bodies: Sequence[str] = Field(description="The bodies of a limb.")
    points: int = Field(description="Number of points of all bodies.")
    explained: Sequence[float] = Field(
        description="Share of the variance that the first modes hold together."
    )
    deviation_mm: Sequence[float] = Field(description="RMS move of the points by one deviation of each mode.")
    left_out_mm: Sequence[float] | None = Field(
        description="RMS distance of a limb from the others' model, by its number of modes; null: not people."
    )
    specificity_mm: float | None = Field(
        description="RMS distance of drawn shapes from the nearest limb; null: not made of people."
    )
    registration_rms_mm: float | None = Field(
        description="Largest RMS distance of a registered limb; null: they were in correspondence."
    )
    registration_p95_mm: float | None = Field(
        description="Distance that 5 % of its points exceed; null as above."
    )


class Quantity(ResultPart):
    """How a pressure, a shear or another quantity is distributed over the people."""

    rule: str = Field(description="The socket rule.")
    load: str = Field(description="`donning`, or the name of the load.")
    place: str = Field(description="Region, tissue, or `the limb`.")
    quantity: str = Field(description="What it is, with its unit.")
    people: int = Field(description="Number of people.")
    mean: float = Field(description="Mean.")
    deviation: float = Field(description="Standard deviation.")
    p5: float = Field(description="What 5 % of the people are below.")
    median: float = Field(description="Median.")
    p95: float = Field(description="What 5 % of the people are above.")
    p90_interval: Interval = Field(description="Bootstrap 95 % interval of the 90th percentile.")


class ShareOver(ResultPart):
    """How many people are over a stated limit."""

    rule: str = Field(description="The socket rule.")
    limit: str = Field(description="The limit in words.")
    people: int = Field(description="Number of people.")
    share_percent: float = Field(description="Share of the people that are over it.")
    interval_percent: Interval = Field(description="95 % interval of the share.")


class RuleDifference(ResultPart):
    """How two rules differ on the same people."""

    rule: str = Field(description="The rule.")
    beside: str = Field(description="The rule that it is compared with.")
    load: str = Field(description="`donning`, or the name of the load.")
    place: str = Field(description="Region, or `worst region`.")
    quantity: str = Field(description="What it is, with its unit.")
    people: int = Field(description="Number of people with both.")
    difference: float = Field(description="Mean difference.")
    interval: Interval = Field(description="Bootstrap 95 % interval of the mean difference.")
    lower_percent: float = Field(description="Share of the people for whom the first is lower.")


class Driver(ResultPart):
    """How much of the spread of the worst regional pressure an input is the cause of."""

    rule: str = Field(description="The socket rule.")
    name: str = Field(description="The input.")
    first: float = Field(description="Sobol index of first order on the surrogate.")
    total: float = Field(description="Total Sobol index on the surrogate.")
    total_interval: float = Field(description="Half width of its 95 % interval.")


class SurrogateFit(ResultPart):
    """How well the surrogate predicts people that it was not fitted to."""

    rule: str = Field(description="The socket rule.")
    people: int = Field(description="Number of people that it was fitted to.")
    error_kPa: float = Field(description="RMS error at people left out of the fit.")
    explained: float = Field(description="Share of the variance at people left out of the fit.")


class RobustRule(ResultPart):
    """The rule that lowers the 90th percentile of the worst regional pressure."""

    keys: Mapping[str, float] = Field(description="What was chosen, by key.")
    predicted_p90_kPa: float = Field(description="The percentile on the surrogate.")
    checked_people: int = Field(description="Number of fresh people that were simulated.")
    checked_p90_kPa: float = Field(description="The percentile of fresh people with the rule.")
    beside_p90_kPa: float = Field(description="That of the same people with the trial's first rule.")
    difference_kPa: float = Field(description="Mean difference of the worst pressure on the same people.")
    interval_kPa: Interval = Field(description="Bootstrap 95 % interval of that.")
    surrogate_error_kPa: float = Field(description="RMS error of the surrogate at the fresh people.")


class PopulationResult(StoredResult):
    """A trial on virtual people."""

    FILE: ClassVar = "population.json"
    COMMAND: ClassVar = "limbfit population run"

    name: str = Field(description="Name of the trial.")
    rules: Sequence[str] = Field(description="The socket rules.")
    people: int = Field(description="Number of people who wear every rule's socket.")
    rejected: Sequence[str] = Field(description="Why other drawn people were rejected.")
    failed: Sequence[str] = Field(description="Simulations that failed, and why.")
    seconds_per_person: float = Field(description="Mean time of all sockets of a person, in s.")
    seconds_per_socket: float = Field(description="Mean time of one socket in it, in s.")
    quantities: Sequence[Quantity] = Field(description="Distributions.")
    shares: Sequence[ShareOver] = Field(description="Shares of people over the stated limits.")
    differences: Sequence[RuleDifference] = Field(description="Differences of rules on the same people.")
    drivers: Sequence[Driver] = Field(description="What the worst regional pressure depends on.")
    surrogates: Sequence[SurrogateFit] = Field(description="How good the surrogates are.")
    worst: Mapping[str, int] = Field(description="The person with the largest worst pressure, by rule.")
    median: Mapping[str, int] = Field(description="The person in the middle, by rule.")
    notes: Sequence[str] = Field(description="What could not be said, and why.")
    robust: RobustRule | None = Field(default=None, description="A rule made robust.")
