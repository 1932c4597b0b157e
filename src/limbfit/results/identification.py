"""The identified parameters and their predictions: what the stages `calibrate` and `predict` store."""

from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Interval, Intervals, Matrix, Parameters, ResultPart, StoredResult
from .limb import RecordFlag


class SimulationDoubt(ResultPart):
    """A doubt about a simulation that came to its end."""

    kind: str = Field(description="Kind of the doubt, such as `folded` or `sunk`.")
    text: str = Field(description="The doubt with its remedy, in a sentence.")
    count: int = Field(description="Number of elements (`folded`) or steps.")
    depth_mm: float = Field(description="Indentation where it is first seen.")
    share: float = Field(description="That over the largest indentation.")


class SearchDoubt(SimulationDoubt):
    """A doubt about a simulation of the search."""

    evaluation: int = Field(description="Number of the evaluation.")
    iterate: int | None = Field(description="Number of the accepted iterate; null for a trial.")
    site: str = Field(description="Name of the record.")
    parameters: Mapping[str, float] = Field(description="The parameters, by `tissue.key`.")


class SimulationDoubts(ResultPart):
    """The doubts about all simulations of the search and at its answer."""

    simulations: int = Field(description="Number of simulations of the search.")
    doubtful: int = Field(description="Number of them that have a doubt.")
    search: Sequence[SearchDoubt] = Field(description="Each doubt of the search.")
    answer: Mapping[str, Sequence[SimulationDoubt]] = Field(description="Doubts at the answer, by record.")


class SearchIteration(ResultPart):
    """An accepted iterate of the search."""

    iteration: int = Field(description="Number of the iterate in its stage, from 0.")
    parameters: Parameters = Field(description="The parameters.")
    starts: Sequence[Parameters] = Field(description="Parameters from which its simulations were started.")
    cost: float = Field(description="Value of the objective.")
    error_percent: float = Field(description="Mean error of the records, of their largest force.")
    error_percent_by_site: Mapping[str, float] = Field(description="Error of each record.")


class SearchStage(ResultPart):
    """A stage of the search: with one material, then with one for each tissue."""

    name: str = Field(description="Name of the stage, such as `two materials`.")
    start: Parameters = Field(description="Parameters at the start.")
    parameters: Parameters = Field(description="Parameters at the end.")
    cost: float = Field(description="Value of the objective at the end.")
    evaluations: int = Field(description="Number of evaluations of all records.")
    converged: bool = Field(description="Whether the search converged.")
    reason: str = Field(description="Why it ended, in words.")
    iterations: Sequence[SearchIteration] = Field(description="The accepted iterates.")


class ParameterBounds(ResultPart):
    """Bounds of the parameters."""

    lower: Parameters = Field(description="Lower bounds.")
    upper: Parameters = Field(description="Upper bounds.")


class LawParameter(ResultPart):
    """A parameter of a tissue's law."""

    name: str = Field(description="Name, without its unit.")
    start: float = Field(description="Where the search starts by default.")
    lower: float = Field(description="Lower bound by default.")
    upper: float = Field(description="Upper bound by default.")
    unit: str = Field(description="Unit; empty where it has none.")
    words: str = Field(description="What it is, in words.")


class StoredLaw(ResultPart):
    """The law of the tissues."""

    name: str = Field(description="Name of the law, as in `material.law`.")
    words: str = Field(description="What it is called.")
    energy: str = Field(description="Its formula.")
    parameters: Sequence[LawParameter] = Field(description="Its parameters.")
    relaxation_times_s: Sequence[float] = Field(default=(), description="Fixed relaxation times.")


class CorrelationMatrix(ResultPart):
    """Correlation of the logarithms of the parameters."""

    names: Sequence[str] = Field(description="Names of rows and columns, `tissue.key`.")
    matrix: Matrix = Field(description="The matrix.")


class StatedPrior(ResultPart):
    """A lognormal prior."""

    median: float = Field(description="Median, in the unit of the parameter.")
    factor: float = Field(description="Factor of one standard deviation.")
    source: str = Field(description="Where it is from.")


class PriorShares(ResultPart):
    """The priors that counted."""

    stated: Mapping[str, StatedPrior] = Field(description="The prior of each parameter that has one.")
    share: Mapping[str, float] = Field(description="Share of the variance of each logarithm from priors.")
    wider_without: Mapping[str, float] = Field(description="Factor by which intervals are wider without.")


class RecordResiduals(ResultPart):
    """What the residuals of a record are made of."""

    unit: str = Field(description="Unit of the compared values, in which the keys in N are too.")
    noise_sd_N: float = Field(description="Standard deviation of the noise of a reading.")
    noise_autocorrelation: float = Field(description="Correlation of the noise of neighbouring readings.")
    touch_down_sd_mm: float = Field(description="Standard deviation of the touch-down.")
    compared_noise_sd_N: float = Field(description="Standard deviation of noise and touch-down as compared.")
    misfit_sd_N: float = Field(description="Standard deviation of what the model cannot follow.")
    misfit_share: float = Field(description="That over the largest force.")
    mesh_share: float | None = Field(description="Error of the mesh over the largest force.")
    mesh_N: Sequence[float] | None = Field(description="Error of the mesh at the compared times.")
    site_share: float | None = Field(description="Deviation of the whole site over the largest force.")


class MeshMisfitSummary(ResultPart):
    """A misfit that the mesh alone would cause."""

    share: float = Field(description="Standard deviation over the largest force.")
    correlation: float = Field(description="Correlation length over the duration of the record.")


class ResidualsSummary(ResultPart):
    """What all residuals are made of."""

    sites: Mapping[str, RecordResiduals] = Field(description="Each fitted record.")
    site_factor: float | None = Field(description="Deviation of whole sites over the expected one.")
    site_freedom: float | None = Field(
        default=None, description="Degrees of freedom of Student's distribution of that deviation."
    )
    misfit_elsewhere: float = Field(description="Misfit expected elsewhere, over the largest force.")
    mesh_misfit: MeshMisfitSummary | None = Field(description="The part that the mesh may cause.")
    correlation: float = Field(description="Correlation length of the misfit over the record's duration.")
    known_scale: float = Field(description="Independent residuals that tell the size of the misfit.")
    effective_samples: float = Field(description="Number of independent residuals.")


class LongTermModulus(ResultPart):
    """Modulus of a tissue at a time after a step."""

    tissue: str = Field(description="Name of the tissue.")
    time_s: float = Field(description="Time after the step.")
    modulus_kPa: float = Field(description="Modulus.")
    interval_95: Interval = Field(description="Its 95 % interval, in kPa.")


class RelaxationPrior(ResultPart):
    """What is assumed of relaxation beyond the records."""

    slope: Interval = Field(description="Range of the power of time.")
    source: str = Field(description="Where it is from.")


class RelaxationBeyond(ResultPart):
    """What relaxation beyond the longest load of the records does to the moduli."""

    longest_s: float = Field(description="Duration of the longest load of the records.")
    own_weight: float = Field(description="Probability of the model's own terms.")
    durations_s: Sequence[float] = Field(description="Durations of a load.")
    shift_log: Matrix = Field(description="Shift of the logarithms of the parameters, by duration.")
    covariance_log: Sequence[Matrix] = Field(description="What is added to their covariance, by duration.")
    fall_log: Matrix = Field(description="How far below that they may lie at most, by duration.")


class RelaxationSummary(ResultPart):
    """What is known of relaxation beyond the records."""

    prefers: str = Field(description="Which law of relaxation the records prefer.")
    evidence: float = Field(description="Twice the logarithm of the evidence for a power of time.")
    tail_weight: float = Field(description="Probability of a modulus that goes on to fall after the records.")
    words: Sequence[str] = Field(description="All of it in sentences.")
    moduli: Sequence[LongTermModulus] = Field(description="Moduli at stated times.")
    prior: RelaxationPrior = Field(description="What is assumed beyond the records.")
    beyond: RelaxationBeyond = Field(description="What intervals count beyond the records.")


class CalibrationUncertainty(ResultPart):
    """How well the parameters are known, from the records of the fitted sites."""

    method: str = Field(description="How intervals were computed.")
    intervals_95: Intervals = Field(description="95 % interval of each parameter.")
    correlation: CorrelationMatrix = Field(description="Correlation of the parameters.")
    covariance_log: Matrix = Field(description="Covariance of their logarithms.")
    sampling_covariance_log: Matrix = Field(description="The part of it that other records would change.")
    verdict: Mapping[str, str] = Field(description="How well each parameter is determined, in words.")
    at_bound: Mapping[str, bool] = Field(description="Whether each parameter ended on a bound.")
    combinations: Sequence[str] = Field(description="Products of parameters, best known first.")
    most_probable: Parameters = Field(description="The most probable parameters.")
    priors: PriorShares | None = Field(description="The priors; null where none were stated.")
    residuals: ResidualsSummary = Field(description="What the residuals are made of.")
    minus_2_log_evidence: float = Field(description="Minus twice the log-evidence, to compare models by.")
    relaxation: RelaxationSummary | None = Field(
        description="Relaxation beyond the records; null for laws without Ogden's relaxation terms."
    )


class MeshCorrectionRound(ResultPart):
    """A correction of the search's coarse meshes by the whole ones."""

    stage: str = Field(description="Stage of the search, or `start`.")
    parameters: Parameters = Field(description="Parameters at which the meshes were compared.")
    scale_by_site: Mapping[str, float | None] = Field(description="Factor of the force, by record.")
    difference_percent_by_site: Mapping[str, float | None] = Field(description="Difference, of the largest.")
    change_percent_by_site: Mapping[str, float | None] = Field(description="Change from what was expected.")
    reason: str = Field(description="Why a record could not be corrected; empty where all could.")


class SearchStart(ResultPart):
    """What came of one start of the search."""

    start: Parameters = Field(description="Parameters at the start.")
    parameters: Parameters | None = Field(description="Parameters at the end; null where nothing came out.")
    cost: float | None = Field(description="Value of the objective.")
    evaluations: int = Field(description="Number of evaluations of all records.")
    converged: bool = Field(description="Whether the search converged.")
    reason: str = Field(description="Why it ended, in words.")
    same: bool = Field(description="Whether it is as good as the best, or ended in its place.")
    apart: float | None = Field(description="Largest ratio of a parameter to the best one's.")


class SearchStarts(ResultPart):
    """What came of all starts."""

    summary: str = Field(description="All of it in words.")
    reached: int = Field(description="Number of starts that ended at a fit as good as the best.")
    starts: Sequence[SearchStart] = Field(description="Each start.")


class ContactSummary(ResultPart):
    """Contact at the answer."""

    penalty_per_mm: float | None = Field(description="Penalty of contact over the tissue's stiffness.")
    sunk_steps: int | None = Field(description="Steps in which the indenter is too deep in the skin.")
    unbalanced_steps: int | None = Field(description="Steps in equilibrium to less than the tolerance.")
    search_penalty_per_mm: float | None = Field(description="Penalty on the mesh of the search.")
    penetration_mm: float = Field(description="How deep the indenter is in the skin at most.")
    from_rest_percent: float | None = Field(description="Difference of the force from rest, of the largest.")


class PressureRound(ResultPart):
    """One simulation of the socket in the identification, and the answer that followed."""

    parameters: Parameters = Field(description="The parameters of the simulation.")
    rms_kPa: float = Field(description="Root mean square of simulated minus measured pressures.")
    bias_kPa: float = Field(description="Mean of them.")
    scatter_kPa: float = Field(description="What the simulation lacks beyond the error of the sensors.")
    moved_sd: float = Field(description="How far the answer then moved all pressures, in deviations.")


class SocketPressures(ResultPart):
    """What pressures that sensors in a socket measured told of the parameters."""

    cells: int = Field(description="Number of cells that were compared.")
    settled: bool = Field(description="Whether the last answer moved the pressures by less than 0.3.")
    rounds: Sequence[PressureRound] = Field(description="Each simulation of the socket.")
    rows: Matrix = Field(description="Derivatives of deviations by the logarithms of all parameters.")
    target: Sequence[float] = Field(description="Deviations are rows times logarithms, less these.")
    share: Mapping[str, float] = Field(
        description="Share of the variance of each logarithm from pressures and priors."
    )
    wider_without: Mapping[str, float] = Field(
        description="Factor by which intervals are wider without pressures and priors."
    )


class CalibrationResult(StoredResult):
    """The identified parameters and how they were found."""

    FILE: ClassVar = "calibrate/calibration.json"

    stages: Sequence[SearchStage] = Field(description="The stages of the search; the last is the answer.")
    bounds: ParameterBounds = Field(description="Bounds of the parameters.")
    law: StoredLaw = Field(description="The law of the tissues.")
    objective: str = Field(description="The objective, as `calibration.objective`.")
    uncertainty: CalibrationUncertainty = Field(description="How well the parameters are known.")
    forward_runs: int = Field(description="Number of simulations.")
    forward_runs_with_sensitivities: int = Field(description="Number of those with derivatives.")
    linear_solver: str | None = Field(description="Name of the linear solver.")
    element: str | None = Field(description="Type of the cells.")
    corrections: Sequence[MeshCorrectionRound] = Field(description="Corrections by the whole meshes.")
    multistart: SearchStarts | None = Field(description="All starts; null where there is one.")
    warnings: Mapping[str, Sequence[str]] = Field(description="Warnings at the answer, by record.")
    contact: Mapping[str, ContactSummary] = Field(description="Contact at the answer, by record.")
    doubts: SimulationDoubts = Field(description="Doubts about the simulations.")
    socket_pressures: SocketPressures | None = Field(
        default=None, description="What measured pressures told; null where they do not count."
    )

    @property
    def parameters(self) -> Parameters:
        """The identified parameters: those of the last stage."""
        return self.stages[-1].parameters


class QuantityRange(ResultPart):
    """How far a quantity goes."""

    quantity: str = Field(description="The quantity, such as `shear strain`.")
    unit: str = Field(description="Its unit; empty where it has none.")
    low: float = Field(description="Lowest value.")
    high: float = Field(description="Highest value.")
    tissue: str | None = Field(description="Name of the tissue; null where it is of no one tissue.")


class RecordedExtents(ResultPart):
    """What the fitted records did to the tissue."""

    extents: Sequence[QuantityRange] = Field(description="The range of each quantity over all of them.")
    angles_deg: Sequence[float] = Field(description="Angles of the fitted sites about the limb's axis.")


class OutsideRecords(ResultPart):
    """A quantity of a prediction that goes beyond the fitted records."""

    quantity: str = Field(description="The quantity.")
    tissue: str | None = Field(description="Name of the tissue; null where it is of no one tissue.")
    unit: str = Field(description="Its unit; empty where it has none.")
    records: Interval = Field(description="Range of the fitted records.")
    prediction: Interval = Field(description="Range of the prediction.")
    share: float = Field(description="Share of the prediction that is outside.")


class ObservedError(ResultPart):
    """What was seen beside the force of a record, and its prediction."""

    kind: str = Field(description="`ultrasound`, `surface` or `shear waves`.")
    what: str = Field(description="What was seen: the tissue, the surface or the place.")
    name: str = Field(description="Name of its curves in `predict/<name>.csv`.")
    unit: str = Field(description="Unit of the values.")
    largest: float = Field(description="Largest value, in that unit.")
    noise: float = Field(description="Standard deviation of the compared values, in that unit.")
    sd: float = Field(description="Standard deviation of a reading, in that unit.")
    compared: str = Field(description="How many values are compared, in words.")
    thickness_mm: float | None = Field(default=None, description="Thickness of the tissue before touch-down.")
    left_out: Mapping[str, int] = Field(default={}, description="Points that are left out, by reason.")
    components: Sequence[str] = Field(default=(), description="What the components of a move are.")
    bias: float | None = Field(default=None, description="Error that all readings share, in that unit.")
    error_percent: float | None = Field(description="Mean error, of the largest value.")


class RecordPrediction(ResultPart):
    """A record beside its prediction."""

    site: str = Field(description="Name of the site.")
    record: str = Field(description="Name of the record; that of the site where it has one only.")
    control: str = Field(description="What the device was told: `displacement` or `force`.")
    region: str | None = Field(description="Region of the limb.")
    fitted: bool = Field(description="Whether parameters are identified from it.")
    peak_force_N: float = Field(description="Largest measured force.")
    error_percent: float | None = Field(description="Mean error, of the largest value; null: not predicted.")
    error_one_material_percent: float | None = Field(description="The same with one material.")
    penetration_mm: float = Field(description="How deep the indenter is in the skin at most.")
    completed: bool = Field(description="Whether the simulation came to its end.")
    reason: str = Field(description="Why it did not.")
    not_predicted: Mapping[str, str] = Field(description="What is not predicted, and why.")
    warnings: Sequence[str] = Field(description="What is doubtful or missing, in words.")
    doubts: Sequence[SimulationDoubt] = Field(description="Doubts about the simulation.")
    steps: int = Field(description="Number of steps.")
    element: str = Field(description="Type of the cells.")
    observed: Sequence[ObservedError] = Field(description="What was seen beside the force.")
    loading: Sequence[QuantityRange] = Field(description="What it does to the tissue.")
    outside_records: Sequence[OutsideRecords] = Field(description="What of it no fitted record did.")


def average_records(errors: Iterable[tuple[str, float | None]]) -> list[float]:
    """Average the errors of each site's records, given with its name; left out is a site that has none."""
    found: dict[str, list[float]] = {}
    for site, error in errors:
        if error is not None:
            found.setdefault(site, []).append(error)
    return [sum(values) / len(values) for values in found.values()]


class LeftOutRecord(ResultPart):
    """A record predicted without itself."""

    site: str = Field(description="Name of the record.")
    error: float = Field(description="Root mean square error over the largest force, measured or simulated.")
    expected: float = Field(description="That of the others when it is left out; 0.02 at least.")
    ratio: float = Field(description="Best factor from predicted to measured force.")
    cook: float = Field(description="Cook's distance: how much the record moves all forces.")
    standardised: float = Field(description="The error over the expected one.")


class PhaseFit(ResultPart):
    """How well the model follows a phase of a record."""

    phase: str = Field(description="`loading`, `hold` or `unloading`.")
    error_N: float = Field(description="Root mean square error (mm under a stated force).")
    error_percent: float = Field(description="That over the largest value.")
    bias_percent: float = Field(description="Mean error over the largest value.")
    times_noise: float = Field(description="That error over what noise, touch-down, mesh and site explain.")


class RecordFit(ResultPart):
    """How well the model follows a record."""

    record: str = Field(description="Name of the record.")
    fitted: bool = Field(description="Whether parameters are identified from it.")
    times_noise: float = Field(description="Error over what noise, touch-down, mesh and site explain.")
    autocorrelation: float = Field(description="Correlation of neighbouring residuals.")
    ljung_box_p: float = Field(description="Probability of so much of it by chance.")
    inside_95: float | None = Field(description="Share of the points in the 95 % band.")
    phases: Sequence[PhaseFit] = Field(description="Each phase.")
    verdict: str = Field(description="In words; empty where the model follows.")


class FitSummary(ResultPart):
    """How well the model follows the records."""

    verdict: str = Field(description="In words.")
    records: Sequence[RecordFit] = Field(description="Each record.")


class PredictResult(StoredResult):
    """The records beside their predictions."""

    FILE: ClassVar = "predict/predict.json"

    sites: Sequence[RecordPrediction] = Field(description="Each record.")
    mean_error_fitted_percent: float | None = Field(description="Mean error of the fitted sites.")
    sd_error_fitted_percent: float | None = Field(description="Its standard deviation over the sites.")
    mean_error_heldout_percent: float | None = Field(description="Mean error of the other sites.")
    sd_error_heldout_percent: float | None = Field(description="Its standard deviation over the sites.")
    recorded_range: RecordedExtents = Field(description="What the fitted records did to the tissue.")
    outside_text: Sequence[str] = Field(description="What predictions do that no fitted record did.")
    flags: Sequence[RecordFlag] = Field(description="Warnings about records.")
    left_out: Sequence[LeftOutRecord] = Field(description="Each record predicted without itself.")
    failed: Sequence[str] = Field(description="Simulations of these checks that failed, in words.")
    fit_quality: FitSummary = Field(description="How well the model follows the records.")

    def compare_held_out(self) -> tuple[list[float], list[float]]:
        """Errors with one material, and with several, of the held-out sites that both predict."""
        held = [row for row in self.sites if not row.fitted]
        known = [row for row in held if None not in (row.error_one_material_percent, row.error_percent)]
        one = average_records((row.site, row.error_one_material_percent) for row in known)
        return one, average_records((row.site, row.error_percent) for row in known)
