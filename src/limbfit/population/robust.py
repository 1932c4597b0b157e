"""A rule made robust: what it may change is drawn along with the people, and a surrogate of both is searched.

The aim is the 90th percentile, over the people, of the worst regional pressure. The rule that the surrogate
prefers is simulated for fresh people, beside the trial's first rule.
"""

from collections.abc import Sequence
from copy import deepcopy

import numpy as np
from scipy.optimize import differential_evolution
from scipy.stats import qmc

from ..arrays import Array
from ..errors import InputError, RunError
from ..pipeline.engine.context import Listener
from ..results.population import RobustRule
from .answers import build_table, find_worst, fit_surrogate, resample_interval
from .people import People
from .running import DONE, FIRST_APART, PersonJob, TrialStore, run_jobs, run_people
from .trial import RuleTable, Trial

PERCENTILE = 90
NAME = "robust"
LEAST_PEOPLE = 12  # for the surrogate
_SEARCHED = 256  # people over which the percentile is predicted


def find_robust_rule(trial: Trial, people: int, fresh: int, listener: Listener) -> RobustRule:
    """Fit the surrogate to ``people``, search it, and check what it prefers on so many ``fresh`` ones.

    Raises `InputError` where the trial states no ``[robust]``, or keys that the first rule does not have; and
    `RunError` where too few people could be simulated.
    """
    if trial.robust is None:
        raise InputError("the trial does not say what may change", file=trial.file, place="robust.ranges")
    if people < LEAST_PEOPLE or fresh < 2:
        what, remedy = f"{people} and {fresh} people are too few", f"give {LEAST_PEOPLE} and 2 or more"
        raise InputError(what, remedy=remedy)
    keys = list(trial.robust.ranges)
    low, high = np.array(list(trial.robust.ranges.values())).T
    change_rule(trial, keys, low)  # refuses keys of areas that are not there
    sequence = qmc.Sobol(len(keys), seed=trial.population.seed)
    drawn = low + (high - low) * sequence.random_base2(people.bit_length())[:people]
    rules = [change_rule(trial, keys, values, f"{NAME} {i}") for i, values in enumerate(drawn, 1)]
    jobs = [PersonJob(trial, (rule,), FIRST_APART + i) for i, rule in enumerate(rules)]
    run_jobs(jobs, 0, people, listener)
    source, store = People(trial), TrialStore(trial)
    inputs, outputs = [], []

    def draw_features(number: int) -> Array:
        return source.to_features(np.array(list(source.draw(number).inputs.values())))

    for job, values in zip(jobs, drawn, strict=True):
        rows = store.read(job.rules)
        rows = rows[(rows["person"] == job.number) & (rows["state"] == DONE)]
        if len(rows):
            inputs.append([*draw_features(job.number), *values])
            outputs.append(find_worst(build_table(rows, [job.number])[job.rules[0].name])[0])
    if len(outputs) < LEAST_PEOPLE:
        raise RunError(f"{trial.file}: only {len(outputs)} of {people} people could be simulated")
    surrogate = fit_surrogate(np.array(inputs), np.array(outputs))
    everybody = np.array([draw_features(number) for number in range(1, _SEARCHED + 1)])

    def predict_percentile(values: Array) -> float:
        rows = np.hstack([everybody, np.tile(values, (len(everybody), 1))])
        return float(np.percentile(surrogate.predict(rows), PERCENTILE))

    found = differential_evolution(predict_percentile, list(zip(low, high)), maxiter=20, popsize=8, seed=0)
    chosen = change_rule(trial, keys, found.x)
    pair, first = (trial.rules[0], chosen), FIRST_APART + people
    numbers = run_people(trial, fresh, rules=pair, first=first, listener=listener)
    table = build_table(store.read(pair), numbers)
    before, after = (find_worst(table[rule.name]) for rule in pair)
    seen = np.array([[*draw_features(number), *found.x] for number in numbers])
    return RobustRule(
        keys=dict(zip(keys, map(float, found.x), strict=True)),
        predicted_p90_kPa=float(found.fun),
        checked_people=len(numbers),
        checked_p90_kPa=float(np.percentile(after, PERCENTILE)),
        beside_p90_kPa=float(np.percentile(before, PERCENTILE)),
        difference_kPa=float((after - before).mean()),
        interval_kPa=resample_interval(after - before, lambda drawn: drawn.mean(axis=-1)),
        surrogate_error_kPa=float(np.sqrt(((surrogate.predict(seen) - after) ** 2).mean())),
    )


def change_rule(trial: Trial, keys: Sequence[str], values: Array, name: str = NAME) -> RuleTable:
    """The trial's first rule with other values of some keys.

    Raises `InputError` for the depth of an area that the rule does not have.
    """
    socket = deepcopy(trial.rules[0].socket)
    for key, value in zip(keys, map(float, values), strict=True):
        if key == "reduction_percent":
            socket[key] = value
            continue
        place = key.removesuffix(" depth_mm")
        area = next((one for one in socket.get("areas", ()) if one.get("name") == place), None)
        if area is None:
            what = f"the rule {trial.rules[0].name!r} has no area {place!r}"
            remedy = "name one of rules.socket.areas"
            raise InputError(what, file=trial.file, place="robust.ranges", remedy=remedy)
        area["depth_mm"] = value
    return RuleTable(name=name, socket=socket)
