"""What a study asks of its calibration: parameters with their bounds, stages, and when the search ends."""

from dataclasses import dataclass
from typing import Literal

from ...arrays import Array
from ...errors import StudyError, add_location
from ...identify.fit.calibration import CalibrationSettings
from ...identify.fit.parameters import (
    Grouping,
    Prior,
    SearchSpace,
    Unknowns,
    build_space,
    build_stage_groupings,
    constrain,
    group_by_kind,
)
from ...study import Study

COUNTS = ("no", "one", "two", "three", "four", "five", "six")


@dataclass(frozen=True)
class CalibrationProblem:
    """What a ``study`` asks of its calibration: the ``unknowns``, and which of them move together in each of
    the ``stages``, whose ``titles`` are in words.

    ``space`` is that of the last stage; ``is_moved`` says that the answer is what is most probable.
    """

    study: Study
    unknowns: Unknowns
    stages: tuple[Grouping, ...]
    titles: tuple[str, ...]
    settings: CalibrationSettings
    space: SearchSpace
    is_moved: bool


def check_fitted(study: Study) -> None:
    """Refuse a study that has nothing to identify parameters from, or no parameter to identify.

    Raises `StudyError` with the remedy.
    """
    if not study.fitted:
        remedy = "set fitted = true where there is a record, or stop before it: limbfit run --until mesh"
        raise StudyError("no site is fitted", file=study.file, place="sites", remedy=remedy)
    with add_location(file=study.file, place="calibration"):
        build_problem(study)


def build_problem(study: Study) -> CalibrationProblem:
    """The problem that a study states."""
    table, tissues = study.calibration, len(study.tissues)
    unknowns, stages = build_unknowns(study), build_groupings(study)
    one, several = "one material", f"{COUNTS[tissues] if tissues < len(COUNTS) else tissues} materials"
    is_one = stages[-1] == group_by_kind(unknowns.names)
    return CalibrationProblem(
        study=study,
        unknowns=unknowns,
        stages=stages,
        # What a study fixes or ties may leave nothing to a second stage.
        titles=(one, several) if len(stages) > 1 else (one if is_one else several,),
        settings=CalibrationSettings(
            objective=table.objective,
            relative_tolerance=table.relative_tolerance,
            max_iterations=table.max_iterations,
            stopping=table.stopping,
            force_error_percent=table.force_error_percent,
        ),
        space=build_space(unknowns, stages[-1]),
        is_moved=is_moved(study),
    )


def is_moved(study: Study) -> bool:
    """Whether the answer is what is most probable, and not the least squares.

    As the study states; else where a fitted site has more than one record of force. What the records' own
    doubts weigh decides then: errors of touch-down and site that one fit to everything would take for tissue.
    """
    table, records = study.calibration, study.records_at(*study.fitted)
    if table.answer is not None:
        return table.answer == "most probable"
    more = len(records) > len(study.fitted) or any(record.observed for record in records)
    return more and "paper" not in (table.objective, table.stopping)


def build_unknowns(study: Study) -> Unknowns:
    """The parameters of each tissue with the study's start and bounds."""

    def flat(which: Literal["start", "lower", "upper"]) -> Array:
        return study.vector({tissue: study.material.of(tissue, which) for tissue in study.tissues})

    names = tuple(f"{tissue}.{name}" for tissue, name in study.parameters)
    priors = tuple(Prior(name, p.median, p.factor) for name, p in study.priors.items())
    return Unknowns(names, flat("start"), flat("lower"), flat("upper"), priors)


def build_groupings(study: Study) -> tuple[Grouping, ...]:
    """Which parameters move together in each stage, as far as the study lets them move."""
    names = build_unknowns(study).names
    made = [
        constrain(one, names, study.fixed, study.calibration.tied) for one in build_stage_groupings(names)
    ]
    return tuple(dict.fromkeys(made))
