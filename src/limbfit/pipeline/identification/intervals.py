"""What the records tell of the identified parameters: intervals, and the answer that is most probable."""

from collections.abc import Sequence

from ...arrays import Array
from ...identify.fit.calibration import Calibration, move_answer
from ...identify.uncertainty.intervals import EvaluationStore, count_further_evaluations, sample_uncertainty
from ...identify.uncertainty.uncertainty import LINEARISED, Uncertainty, estimate_uncertainty
from ..records.deviations import estimate_site_deviation, estimate_site_noise
from ..records.records import SiteRecord
from .fine_meshes import FineMeshCorrection
from .problem import CalibrationProblem
from .record_simulator import RecordSimulator, Responses

ONLY_LINEARISED = "too few simulations completed near the answer: its intervals are linearised, too narrow"
NOT_MOVED = "what is most probable cannot be simulated, and the least squares are the answer"


def estimate_linearised(
    problem: CalibrationProblem,
    records: Sequence[SiteRecord],
    parameters: Array,
    correction: FineMeshCorrection,
) -> Uncertainty:
    """What fitted records tell about ``parameters`` (p,), at which the correction was made."""
    study, responses = problem.study, correction.responses
    pairs = list(zip(records, responses, strict=True))
    noise = [estimate_site_noise(study, record, response.force_N) for record, response in pairs]
    off = [estimate_site_deviation(study, record, response, parameters) for record, response in pairs]
    measured = [record.measured for record in records]
    return estimate_uncertainty(
        parameters,
        responses,
        measured,
        problem.unknowns,
        noise,
        problem.stages[-1],
        problem.settings,
        correction.mesh_N,
        off,
    )


def sample_intervals(
    problem: CalibrationProblem,
    simulator: RecordSimulator,
    found: Calibration,
    correction: FineMeshCorrection,
    moves: bool = True,
) -> tuple[Calibration, Uncertainty]:
    """The answer, which ``moves`` to what is most probable where that is wanted, and what is known of it.

    Sampled on what was simulated near it and a little more, less what the correction took;
    linearised, and the answer stays, where that cannot be for simulations that fail.
    """
    records = simulator.records
    known = estimate_linearised(problem, records.own, found.parameters, correction)
    evaluations = EvaluationStore()
    for point, run in zip(simulator.store.points, simulator.store.responses, strict=True):
        evaluations.add(point, correction.as_fine(list(run)))

    def simulate(parameters: Array) -> Responses:
        simulator.report("a further evaluation, for the intervals")
        return correction.as_fine(simulator.search(parameters))

    further = count_further_evaluations(records.simulations, correction.simulations)
    about = known, evaluations, simulate, further
    moves = moves and problem.is_moved
    sampled = sample_uncertainty(*about, move_answer=moves)
    if sampled.method == LINEARISED:
        simulator.report(f"warning: {ONLY_LINEARISED}")
    if not moves or sampled.method == LINEARISED:
        return found, sampled
    responses = simulate(sampled.parameters)
    answer = move_answer(found, sampled.parameters, records.measured, responses, problem.unknowns)
    if isinstance(answer, Calibration):
        return answer, sampled
    simulator.report(f"warning: {NOT_MOVED}: {answer}")
    return found, sample_uncertainty(*about, move_answer=False)
