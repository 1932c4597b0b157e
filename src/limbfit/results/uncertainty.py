"""How far to trust the answer: the experiments `uncertainty`, `crossvalidate`, `regions`; other models."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Interval, Intervals, Matrix, Parameters, ResultPart, StoredResult
from .identification import CorrelationMatrix, ResidualsSummary


class ParameterUncertainty(ResultPart):
    """A parameter by every method; values and intervals are in its unit."""

    name: str = Field(description="Name, `tissue.key`.")
    calibrated: float = Field(description="Identified value.")
    median: float = Field(description="Median of the posterior.")
    linearised_95: Interval = Field(description="95 % interval of the calibration.")
    posterior_95: Interval = Field(description="95 % interval of the posterior.")
    profile_95: Interval | None = Field(description="95 % interval of the profile; null where it has none.")
    profile_verdict: str | None = Field(description="What the profile says, in words.")
    profile_extrapolated: tuple[bool, bool] | None = Field(description="Whether each end is beyond the runs.")
    with_sources_95: Interval = Field(description="95 % interval with all sources counted.")
    verdict: str = Field(description="How well it is determined with all sources, in words.")


class ParameterCombination(ResultPart):
    """A product of powers of parameters: a principal axis of the posterior."""

    text: str = Field(description="The product.")
    weights: Sequence[float] = Field(description="Power of each parameter.")
    linearised_factor_95: float = Field(description="Factor of the 95 % interval of the calibration.")
    posterior_factor_95: float = Field(description="Factor of the 95 % interval of the posterior.")
    with_sources_factor_95: float = Field(description="That factor with all sources counted.")
    verdict: str = Field(description="How well it is determined, in words.")


class EmulatorRound(ResultPart):
    """The emulator after a round of simulations."""

    runs: int = Field(description="Number of its simulations.")
    error_percent: Sequence[float] = Field(description="Expected error of each record.")
    loo_percent: Sequence[float] = Field(description="Error of each record when a run is left out.")
    new_percent: Sequence[float] = Field(description="Error of each record at the round's runs.")
    outside: float = Field(description="Share of the posterior outside its runs.")


class EmulatorSummary(ResultPart):
    """The emulator that the posterior was sampled with."""

    runs: int = Field(description="Number of its simulations.")
    needed_percent: Sequence[float] = Field(description="Error that it has to come below, by record.")
    good_enough: bool = Field(description="Whether it came below.")
    rounds: Sequence[EmulatorRound] = Field(description="Each round.")
    lower: Sequence[float] = Field(description="Lowest value of each parameter in its runs.")
    upper: Sequence[float] = Field(description="Highest value of each parameter in its runs.")
    kernel_length: float = Field(description="Length of its kernel, in logarithms of parameters.")
    nugget: float = Field(description="Variance that it does not follow, over its own.")


class PosteriorSummary(ResultPart):
    """The posterior of the parameters."""

    median: Mapping[str, float] = Field(description="Median of each parameter.")
    intervals_95: Mapping[str, Interval] = Field(description="95 % interval of each parameter.")
    covariance_log: Matrix = Field(description="Covariance of the logarithms.")
    misfit_factor: tuple[float, float, float] = Field(
        description="Quantiles 2.5, 50 and 97.5 % of the misfit's size over the calibration's."
    )
    acceptance: float = Field(description="Share of accepted steps of the sampler.")
    autocorrelation_steps: float = Field(description="Steps after which draws are independent.")
    independent_draws: float = Field(description="Number of independent draws.")
    long_enough: bool = Field(description="Whether the chain is long enough for its autocorrelation.")


class LikelihoodProfile(ResultPart):
    """The profile likelihood of a parameter."""

    values: Sequence[float] = Field(description="Values of the parameter.")
    rise: Sequence[float] = Field(description="Rise of minus twice the log-likelihood there.")
    threshold: float = Field(description="Rise that ends the 95 % interval.")
    interval_95: Interval = Field(description="The 95 % interval.")
    closed: tuple[bool, bool] = Field(description="Whether each end is inside the bounds.")
    extrapolated: Sequence[bool] = Field(description="Whether each value is beyond the emulator's runs.")
    ends_extrapolated: tuple[bool, bool] = Field(description="Whether each end is beyond them.")
    verdict: str = Field(description="In words.")


class ProfileCheck(ResultPart):
    """The ends of a profile by the emulator and by the solver."""

    name: str = Field(description="Name of the parameter.")
    why: str = Field(description="Why this profile was checked.")
    emulated: Interval = Field(description="Rise at the ends by the emulator.")
    solved: tuple[float | None, float | None] = Field(description="By the solver; null where it failed.")
    extrapolated: tuple[bool, bool] = Field(description="Whether each end is beyond the emulator's runs.")

    @property
    def largest_difference(self) -> float | None:
        """The largest difference at the ends that were simulated; None if neither was."""
        found = [abs(a - b) for a, b in zip(self.emulated, self.solved) if b is not None]
        return max(found, default=None)


class ModelEvidence(ResultPart):
    """A model on the records."""

    name: str = Field(description="Name of the model.")
    parameters: int = Field(description="Number of its free parameters, the misfit's size included.")
    minus_2_log: float = Field(description="Minus twice the log-likelihood.")
    effective_samples: float = Field(description="Number of independent residuals.")
    misfit_factor: float = Field(description="Size of the misfit over the calibration's.")
    minus_2_log_evidence: float = Field(description="Minus twice the logarithm of the evidence.")


class EvidenceComparison(ResultPart):
    """One material against one for each tissue."""

    first: ModelEvidence = Field(description="The first model.")
    second: ModelEvidence = Field(description="The second model.")
    heldout: Mapping[str, float] = Field(description="Errors of both at held-out sites; empty without any.")
    better: str = Field(description="Name of the model that is supported; empty where neither is.")
    verdict: str = Field(description="In words.")


class SourceEffect(ResultPart):
    """What a source of uncertainty changes."""

    source: str = Field(description="The source.")
    change: str = Field(description="By how much it was changed.")
    shared: bool = Field(description="Whether the change is the same at all sites.")
    counted: bool = Field(description="Whether it counts in the intervals with sources.")
    failed: Sequence[str] = Field(description="Records whose simulation failed.")
    force_percent: Mapping[str, float] = Field(description="Change of the force, by record.")
    parameters_percent: Mapping[str, float] = Field(description="Change of each parameter.")


class IntervalParts(ResultPart):
    """The 95 % interval of a record; null where it is not predicted. Shares are of the largest force."""

    site: str = Field(description="Name of the site.")
    record: str = Field(description="Name of the record.")
    fitted: bool = Field(description="Whether parameters are identified from it.")
    reason: str = Field(description="Why it is not predicted; empty where it is.")
    inside_percent: float | None = Field(description="Share of the record inside the interval.")
    half_width_percent: float | None = Field(description="Half the width of the interval.")
    parameters_sd_percent: float | None = Field(description="Standard deviation by the parameters.")
    sources_sd_percent: float | None = Field(description="Standard deviation by the sources.")
    site_sd_percent: float | None = Field(description="Standard deviation by the site's own stiffness.")
    noise_sd_percent: float | None = Field(description="Standard deviation by noise.")
    misfit_sd_percent: float | None = Field(description="Standard deviation by the misfit.")


class IntervalSummary(ResultPart):
    """The 95 % intervals of all records."""

    sites: Sequence[IntervalParts] = Field(description="Each record.")
    coverage_fitted_percent: float | None = Field(description="Mean share inside of the fitted records.")
    coverage_heldout_percent: float | None = Field(description="Mean share inside of the other records.")


class UncertaintyResult(StoredResult):
    """Posterior, profiles, evidence and further sources."""

    FILE: ClassVar = "uncertainty/uncertainty.json"
    COMMAND: ClassVar = "limbfit uncertainty"

    parameters: Sequence[ParameterUncertainty] = Field(description="Each parameter.")
    combinations: Sequence[ParameterCombination] = Field(description="Products of parameters.")
    correlation: CorrelationMatrix = Field(description="Correlation of the posterior.")
    covariance_log: Matrix = Field(description="Covariance of the logarithms of the posterior.")
    covariance_sources_log: Matrix = Field(description="Covariance by all counted sources.")
    residuals: ResidualsSummary = Field(description="What the residuals are made of.")
    emulator: EmulatorSummary = Field(description="The emulator.")
    posterior: PosteriorSummary = Field(description="The posterior.")
    profiles: Mapping[str, LikelihoodProfile] = Field(description="The profile of each parameter.")
    checks: Sequence[ProfileCheck] = Field(description="Profiles whose ends the solver checked.")
    evidence: EvidenceComparison | None = Field(description="One material or several; null for one tissue.")
    sources: Sequence[SourceEffect] = Field(description="Each further source.")
    predictions: IntervalSummary = Field(description="The intervals of the records.")
    verdict: Sequence[str] = Field(description="The answer in sentences.")


class FoldFit(ResultPart):
    """A fit to a choice of sites."""

    label: str = Field(description="The region that was left out; empty for another choice.")
    fitted: Sequence[str] = Field(description="The fitted sites.")
    parameters: Mapping[str, float] = Field(description="Its parameters, by `tissue.key`.")
    errors_percent: Mapping[str, float] = Field(description="Error of each site.")
    mean_error_fitted_percent: float = Field(description="Mean error of the fitted sites.")
    mean_error_heldout_percent: float | None = Field(description="Mean error of the others; null: none.")
    converged: bool = Field(description="Whether the search converged.")
    at_limit: Sequence[str] = Field(description="Parameters that ended on a bound.")


class OwnFold(FoldFit):
    """The study's own choice among the others."""

    share_better: float | None = Field(description="Share of choices with less held-out error; null: none.")
    median_percent: float = Field(description="Median of the held-out errors.")
    low_percent: float = Field(description="Their lower quantile.")
    high_percent: float = Field(description="Their upper quantile.")


class HeldoutSite(ResultPart):
    """A site over all choices that left it out."""

    site: str = Field(description="Name of the site.")
    region: str | None = Field(description="Region of the limb.")
    fitted: bool = Field(description="Whether the study fits it.")
    left_out_of: int = Field(description="Number of choices that left it out.")
    mean_percent: float | None = Field(description="Mean error when it is left out.")
    sd_percent: float | None = Field(description="Its standard deviation.")
    own_percent: float = Field(description="Its error with the study's own choice.")


class FoldCheck(ResultPart):
    """A fit's optimum simulated by the solver."""

    round: int = Field(description="Round of the check, from 1.")
    fitted: Sequence[str] = Field(description="The fitted sites.")
    heldout_emulated_percent: float = Field(description="Held-out error by the emulator.")
    heldout_solved_percent: float = Field(description="Held-out error by the solver.")
    emulator_error_percent: float = Field(description="Mean error of the emulator there.")
    emulator_error_largest_percent: float = Field(description="Its largest error.")


class FoldEmulator(ResultPart):
    """The emulator that all fits share."""

    runs: int = Field(description="Number of its simulations.")
    loo_percent: float = Field(description="Its median error when a run is left out.")
    checks: Sequence[FoldCheck] = Field(description="Its error at some fits.")


class CrossvalidateResult(StoredResult):
    """Held-out errors over choices of the fitted sites."""

    FILE: ClassVar = "crossvalidate/crossvalidate.json"
    COMMAND: ClassVar = "limbfit crossvalidate"

    fitted_sites: int = Field(description="Number of fitted sites.")
    choices: int = Field(description="Number of choices.")
    choices_possible: int = Field(description="Number of possible choices.")
    own: OwnFold = Field(description="The study's own choice.")
    sites: Sequence[HeldoutSite] = Field(description="Each site.")
    regions: Sequence[FoldFit] = Field(description="Fits without a whole region.")
    folds: Sequence[FoldFit] = Field(description="All choices.")
    at_limit_share: float = Field(description="Share of choices with a parameter on a bound.")
    emulator: FoldEmulator = Field(description="The emulator.")


class WholeLimbFit(ResultPart):
    """The fit to the whole limb."""

    name: str = Field(description="Name of the stage of the search.")
    start: Parameters = Field(description="Parameters at its start.")
    parameters: Parameters = Field(description="The identified parameters.")
    fitted_sites: Sequence[str] = Field(description="The fitted sites.")


class RegionFitted(ResultPart):
    """The fit to a region of the limb."""

    region: str = Field(description="Name of the region.")
    sites: Sequence[str] = Field(description="Its recorded sites.")
    fitted_sites: Sequence[str] = Field(description="Those that are fitted.")
    parameters: Parameters = Field(description="Its parameters.")
    intervals_95: Intervals = Field(description="95 % interval of each.")
    verdict: Mapping[str, str] = Field(description="How well each is determined, in words.")
    evaluations: int = Field(description="Number of evaluations of all its records.")
    converged: bool = Field(description="Whether the search converged.")
    reason: str = Field(description="Why it ended, in words.")
    own_error_percent: float | None = Field(description="Mean error with its own parameters.")
    whole_error_percent: float | None = Field(description="Mean error with the whole limb's.")
    own_error_percent_by_site: Mapping[str, float | None] = Field(description="The first by record.")
    whole_error_percent_by_site: Mapping[str, float | None] = Field(description="The second by record.")


class RegionsResult(StoredResult):
    """Parameters of each region beside those of the whole limb."""

    FILE: ClassVar = "regions/regions.json"
    COMMAND: ClassVar = "limbfit regions"

    sites_used: str = Field(description="Which sites of a region are fitted: `all` or `fitted`.")
    left_out: Sequence[str] = Field(description="What no region's model is judged on, in words.")
    whole: WholeLimbFit = Field(description="The fit to the whole limb.")
    regions: Sequence[RegionFitted] = Field(description="Each region.")
    mean_own_error_percent: float | None = Field(description="Mean error with the regions' parameters.")
    mean_whole_error_percent: float | None = Field(description="Mean error with the whole limb's.")


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
