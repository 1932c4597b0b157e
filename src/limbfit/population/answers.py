"""What a trial says: distributions, shares over limits, differences of rules, and what drives them.

The *worst* of a person is the largest mean pressure of any region under any load. Bootstrap intervals
resample people; that of a share is Wilson's, since a bootstrap of nobody has no width.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from ..arrays import Array
from ..errors import InputError
from ..extensions import import_extra
from ..results.population import (
    WORST_PLACE,
    Driver,
    PopulationResult,
    Quantity,
    RobustRule,
    RuleDifference,
    ShareOver,
    SurrogateFit,
)
from .people import People
from .running import DONE, FAILED, INPUT, REJECTED, WHOLE, TrialStore, list_done
from .trial import LimitTable, Trial

WORST_QUANTITY, ANY_LOAD = "mean_kPa", "any load"
LEAST_PEOPLE = 16  # for a surrogate: with fewer, its error at people left out says nothing
FOLDS = 8
_DRAWS = 2000  # of a bootstrap
_SOBOL = 512  # base samples of the indices


def summarise_trial(trial: Trial, robust: RobustRule | None = None) -> PopulationResult:
    """All answers of the people who are stored. Raises `InputError` where there are none."""
    rows = TrialStore(trial).read()
    numbers = list_done(rows, trial.rules)
    if not numbers:
        raise InputError("nobody was simulated yet", file=trial.file, remedy="limbfit population run first")
    table = build_table(rows, numbers)
    lost = rows[rows["state"] != DONE].drop_duplicates(["person", "rule"])
    names = [rule.name for rule in trial.rules]
    worst = {name: find_worst(table[name]) for name in names}
    seconds = rows[rows["person"].isin(numbers) & (rows["quantity"] == "seconds")]["value"]
    surrogates, drivers, notes = _find_drivers(trial, rows, numbers, worst)
    ranked = {name: [table.index[i] for i in np.argsort(one)] for name, one in worst.items()}
    return PopulationResult(
        name=trial.population.name,
        rules=names,
        people=len(numbers),
        rejected=_list_reasons(lost[(lost["state"] == REJECTED) & (lost["rule"] == names[0])]),
        failed=_list_reasons(lost[lost["state"] == FAILED]),
        seconds_per_person=float(seconds.mean() * len(names)),
        seconds_per_socket=float(seconds.mean()),
        quantities=[_describe(key, column.to_numpy()) for key, column in table.items()],
        shares=[measure_share(table[name], name, limit) for name in names for limit in trial.limits],
        differences=_compare_rules(table, names, worst),
        drivers=drivers,
        surrogates=surrogates,
        worst={name: int(order[-1]) for name, order in ranked.items()},
        median={name: int(order[len(order) // 2]) for name, order in ranked.items()},
        notes=notes,
        robust=robust,
    )


def build_table(rows: Any, numbers: Sequence[int]) -> Any:
    """The values of the people of these numbers, by rule, load, place and quantity, from stored rows."""
    values = rows[rows["person"].isin(numbers) & (rows["load"] != "")]
    return values.pivot_table(index="person", columns=["rule", "load", "place", "quantity"], values="value")


def _list_reasons(lost: Any) -> list[str]:
    return [f"person {row.person}, {row.rule}: {row.text}" for row in lost.itertuples()]


def _describe(key: tuple[str, str, str, str], column: Array) -> Quantity:
    values = column[np.isfinite(column)]
    rule, load, place, quantity = key
    return Quantity(
        rule=rule,
        load=load,
        place=place,
        quantity=quantity,
        people=len(values),
        mean=values.mean(),
        deviation=values.std(ddof=1) if len(values) > 1 else 0.0,
        p5=np.percentile(values, 5),
        median=np.median(values),
        p95=np.percentile(values, 95),
        p90_interval=resample_interval(values, lambda drawn: np.percentile(drawn, 90, axis=-1)),
    )


def resample_interval(values: Array, statistic: Any) -> tuple[float, float]:
    """The 95 % interval of a statistic of the last axis, by resampling values (n,)."""
    drawn = np.random.default_rng(0).integers(len(values), size=(_DRAWS, len(values)))
    low, high = np.percentile(statistic(values[drawn]), [2.5, 97.5])
    return float(low), float(high)


def find_worst(table: Any) -> Array:
    """The largest regional mean pressure of each person (n,), kPa, by the columns load, place, quantity."""
    regional = table.xs(WORST_QUANTITY, axis=1, level="quantity").drop(columns=WHOLE, level="place")
    return np.asarray(regional.max(axis=1))


def measure_share(table: Any, rule: str, limit: LimitTable) -> ShareOver:
    """The share of people over a limit, by the columns load, place, quantity of a rule."""
    chosen = table.xs((limit.region, limit.quantity), axis=1, level=("place", "quantity"))
    chosen = chosen if limit.load is None else chosen[[limit.load]]
    over = int((chosen.max(axis=1) > limit.kPa).sum())
    interval = binomtest(over, len(chosen)).proportion_ci(method="wilson")
    return ShareOver(
        rule=rule,
        limit=limit.words,
        people=len(chosen),
        share_percent=100.0 * over / len(chosen),
        interval_percent=(100.0 * interval.low, 100.0 * interval.high),
    )


def _compare_rules(table: Any, names: Sequence[str], worst: dict[str, Array]) -> list[RuleDifference]:
    """Every rule beside the first, person by person."""
    first, found = names[0], []
    for name in names[1:]:
        both = [key for key in table[name].columns if key in table[first].columns]
        keys = [key for key in both if key[2] in ("mean_kPa", "peak_kPa")]
        pairs = {key: (table[name][key] - table[first][key]).to_numpy() for key in keys}
        pairs = {(ANY_LOAD, WORST_PLACE, WORST_QUANTITY): worst[name] - worst[first]} | pairs
        for (load, place, quantity), pair in pairs.items():
            here = pair[np.isfinite(pair)]
            found.append(
                RuleDifference(
                    rule=name,
                    beside=first,
                    load=load,
                    place=place,
                    quantity=quantity,
                    people=len(here),
                    difference=here.mean(),
                    interval=resample_interval(here, lambda drawn: drawn.mean(axis=-1)),
                    lower_percent=100.0 * (here < 0.0).mean(),
                )
            )
    return found


def fit_surrogate(inputs: Array, outputs: Array) -> Any:
    """A Gaussian process of outputs (n,) over inputs (n, d), with a length for each input and noise."""
    names = ("gaussian_process", "gaussian_process.kernels", "pipeline", "preprocessing")
    learn, kernels, pipeline, scaling = (import_extra(f"sklearn.{name}", "population") for name in names)
    smooth = kernels.RBF(np.full(inputs.shape[1], 3.0), (0.3, 1e3))
    kernel = kernels.ConstantKernel(1.0) * smooth + kernels.WhiteKernel(1e-2, (1e-5, 1.0))
    process = learn.GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=2, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the length of an input that does not matter ends at its bound
        return pipeline.make_pipeline(scaling.StandardScaler(), process).fit(inputs, outputs)


def predict_left_out(inputs: Array, outputs: Array) -> Array:
    """What surrogates that have not seen them predict of the outputs (n,), in `FOLDS` folds."""
    fold = np.arange(len(outputs)) % min(FOLDS, len(outputs))
    predicted = np.zeros(len(outputs))
    for one in np.unique(fold):
        fitted = fit_surrogate(inputs[fold != one], outputs[fold != one])
        predicted[fold == one] = fitted.predict(inputs[fold == one])
    return predicted


def _find_drivers(
    trial: Trial, rows: Any, numbers: Sequence[int], worst: dict[str, Array]
) -> tuple[list[SurrogateFit], list[Driver], list[str]]:
    """Surrogates of the worst pressure by rule, and Sobol indices of the inputs on each."""
    count = len(numbers)
    if count < LEAST_PEOPLE:
        return [], [], [f"what drives the pressures is said from {LEAST_PEOPLE} people on; there are {count}"]
    analyse = import_extra("SALib.analyze.sobol", "population")
    sample = import_extra("SALib.sample.sobol", "population")
    people, notes = People(trial), list[str]()
    names = list(people.names)
    is_first = rows["rule"] == trial.rules[0].name
    given = rows[(rows["place"] == INPUT) & rows["person"].isin(numbers) & is_first]
    columns = given.pivot_table(index="person", columns="quantity", values="value")[names]
    inputs = people.to_features(columns.to_numpy())
    surrogates, drivers = list[SurrogateFit](), list[Driver]()
    # Indices are over what people have: their quantiles, which are independent as they were drawn.
    problem = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
    drawn = sample.sample(problem, _SOBOL, calc_second_order=False, seed=0)
    placed = np.column_stack([np.quantile(column, u) for column, u in zip(inputs.T, drawn.T, strict=True)])
    for rule, outputs in worst.items():
        error = predict_left_out(inputs, outputs) - outputs
        explained = 1.0 - float((error**2).sum() / ((outputs - outputs.mean()) ** 2).sum())
        rms = float(np.sqrt((error**2).mean()))
        surrogates.append(SurrogateFit(rule=rule, people=count, error_kPa=rms, explained=explained))
        if explained < 0.5:
            notes.append(
                f"{rule}: the surrogate explains {100 * max(explained, 0):.0f} % of the variance at people "
                "left out; what it says of drivers is doubtful, and more people would help"
            )
        predicted = fit_surrogate(inputs, outputs).predict(placed)
        found = analyse.analyze(problem, predicted, calc_second_order=False, seed=0)
        drivers += [
            Driver(
                rule=rule,
                name=name,
                first=found["S1"][i],
                total=found["ST"][i],
                total_interval=found["ST_conf"][i],
            )
            for i, name in enumerate(names)
        ]
    return surrogates, sorted(drivers, key=lambda one: -one.total), notes


def measure_precision(trial: Trial) -> float:
    """Half the width, in percent, of the widest interval of a share over a limit of a trial that has one."""
    rows = TrialStore(trial).read()
    table = build_table(rows, list_done(rows, trial.rules))
    shares = [measure_share(table[rule.name], rule.name, one) for rule in trial.rules for one in trial.limits]
    return max(0.5 * (one.interval_percent[1] - one.interval_percent[0]) for one in shares)
