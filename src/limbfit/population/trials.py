"""What can be asked of a trial: make one, check, run and report it, open a person, make a rule robust."""

from pathlib import Path
from typing import Any

from ..errors import InputError, add_location
from ..pipeline.commands.check import check_study
from ..pipeline.commands.run import report_study
from ..pipeline.engine.context import Listener, Progress, ignore_progress
from ..pipeline.engine.store import write_result
from ..pipeline.limb.surfaces import read_given_anatomy
from ..results.population import PopulationResult, RobustRule
from ..study import load_study
from .answers import measure_precision, summarise_trial
from .people import People
from .report import write_report
from .robust import find_robust_rule
from .running import (
    DONE,
    FAILED,
    REJECTED,
    PersonJob,
    TrialStore,
    find_person_folder,
    import_pandas,
    list_done,
    run_jobs,
    run_people,
)
from .trial import FILE, Trial, load_trial

_BATCH = 8  # people between two looks at how well shares are known
_TRIED = 3  # people, before a trial is refused
_TEMPLATE = Path(__file__).with_name("population.toml")
PHANTOM_SHAPES = 'phantom = "transtibial"      # no download: every size of the synthetic limb varies'


def write_trial(
    folder: str | Path, *, model: str | Path | None = None, limbs: str | Path | None = None
) -> Path:
    """Write a ``population.toml`` into a folder, with its keys explained; the path of the file.

    ``model``, ``limbs``: a shape model, or a folder of limbs; by default limbs are the phantom's. Raises
    `InputError` where there is a trial already, or model or folder is not there.
    """
    folder = Path(folder)
    file = folder / FILE
    if file.exists():
        raise InputError("there is a trial already", file=file, remedy="give another folder, or edit it")
    shapes = PHANTOM_SHAPES
    for option, key, given in (("--model", "model", model), ("--limbs", "folder", limbs)):
        if given is not None:
            if not Path(given).exists():
                raise InputError("does not exist", file=given, place=option)
            shapes = f'{key} = "{Path(given).absolute().as_posix()}"'
    folder.mkdir(parents=True, exist_ok=True)
    text = _TEMPLATE.read_text(encoding="utf-8").replace(PHANTOM_SHAPES, shapes)
    file.write_text(text.replace('name = "trial"', f'name = "{folder.absolute().name}"', 1), encoding="utf-8")
    return file


def check_trial(path: str | Path) -> dict[str, Any]:
    """Build the first person who is not rejected, and check the study with every socket; nothing is solved.

    Raises `InputError` for shapes, tissues, keys or a rule that cannot be used; a limb that no rule fits.
    """
    trial = load_trial(path)
    import_pandas()
    people = People(trial)
    for number in range(1, _TRIED + 1):
        person = people.draw(number)
        folder = find_person_folder(trial, number)
        limb = people.build_limb(person, folder)
        try:
            for rule in trial.rules:
                study = people.write_study(person, rule, limb, folder / rule.name)
                people.check_limb(read_given_anatomy(study)[0])
                with add_location(place=f"rules.{rule.name}"):
                    check_study(study)
        except InputError as error:
            reason = error
            continue
        found = {"trial": str(trial.file), "person": number, "inputs": dict(person.inputs)}
        return found | {"rules": len(trial.rules)}
    what = f"none of the first {_TRIED} people can be simulated; the last one: {reason}"
    raise InputError(what, file=trial.file, remedy="change shapes, or the rule")


def run_population(
    path: str | Path,
    *,
    people: int | None = None,
    within_percent: float | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Simulate the people of a trial, and write its answers and the report. What is stored is not done again.

    ``people``: how many; by default as the trial says. ``within_percent``: end as soon as every share over a
    limit is known so well, either way. Returns what ``results/population.json`` holds, and ``report``. Raises
    `InputError` for a trial that cannot be used, or ``within_percent`` without limits; and `RunError` where
    hardly anybody remains, or another process runs the trial.
    """
    trial = load_trial(path)
    import_pandas()
    wanted = trial.population.people if people is None else people
    if wanted < 1:
        raise InputError(f"{wanted} people are too few", place="--people", remedy="give one or more")
    if within_percent is not None and not trial.limits:
        what, remedy = "the trial states no limit", "state [[limits]]"
        raise InputError(what, file=trial.file, place="limits", remedy=remedy)
    TrialStore(trial).drop_stale()
    if within_percent is None:
        run_people(trial, wanted, listener=listener)
    else:
        for count in [*range(_BATCH, wanted, _BATCH), wanted]:
            run_people(trial, count, listener=listener)
            reached = measure_precision(trial)
            listener(Progress("people", count, wanted, f"{count} people: shares within {reached:.1f} %"))
            if reached <= within_percent:
                break
    return report_population(path)


def report_population(path: str | Path) -> dict[str, Any]:
    """Write answers and report anew from what is stored; as `run_population`."""
    trial = load_trial(path)
    before = PopulationResult.find(trial.results)
    return _store_answers(trial, before.robust if before else None)


def _store_answers(trial: Trial, robust: RobustRule | None) -> dict[str, Any]:
    found = summarise_trial(trial, robust)
    write_result(trial.results / PopulationResult.FILE, found)
    return found.to_plain() | {"report": str(write_report(trial, found)), "folder": str(trial.results)}


def count_people(path: str | Path) -> dict[str, Any]:
    """How far a trial is: the people who wear every socket, how many are wanted, failed and were rejected."""
    trial = load_trial(path)
    rows = TrialStore(trial).read()
    lost = rows.drop_duplicates(["person", "rule"])
    seconds = rows[rows["quantity"] == "seconds"]["value"]
    return {
        "trial": str(trial.file),
        "people": len(list_done(rows, trial.rules)),
        "wanted": trial.population.people,
        "sockets": {
            rule.name: int((lost[lost["rule"] == rule.name]["state"] == DONE).sum()) for rule in trial.rules
        },
        "failed": int((lost["state"] == FAILED).sum()),
        "rejected": int(lost[lost["state"] == REJECTED]["person"].nunique()),
        "seconds_per_socket": float(seconds.mean()) if len(seconds) else None,
    }


def open_person(path: str | Path, number: int, *, listener: Listener = ignore_progress) -> dict[str, Any]:
    """The studies of a person, by rule, each with its report; simulated where they are not there yet.

    Raises `InputError` for a number below 1, or a person who was rejected.
    """
    trial = load_trial(path)
    if number < 1:
        raise InputError(f"nobody has the number {number}", remedy="count from 1")
    person = People(trial).draw(number)
    files = {rule.name: find_person_folder(trial, number, rule.name) / "study.toml" for rule in trial.rules}
    store = TrialStore(trial)
    there = [store.file(number, rule).is_file() and files[rule.name].is_file() for rule in trial.rules]
    if not all(there):
        run_jobs([PersonJob(trial, trial.rules, number)], 0, 1, listener)
    rows = store.read()
    state = rows[rows["person"] == number].drop_duplicates("rule").set_index("rule")
    if (state["state"] == REJECTED).any():
        raise InputError(f"person {number} was rejected: {state['text'].iloc[0]}", file=trial.file)
    studies = {name: str(file.parent) for name, file in files.items() if state["state"][name] == DONE}
    reports = {name: report_study(load_study(folder))["report"] for name, folder in studies.items()}
    return {"person": number, "inputs": dict(person.inputs), "studies": studies, "reports": reports}


def make_robust(
    path: str | Path, *, people: int = 40, fresh: int = 8, listener: Listener = ignore_progress
) -> dict[str, Any]:
    """Search the rule that lowers the 90th percentile of the worst pressure, and check it on fresh people.

    ``people``: how many, each with another rule within ``robust.ranges``, the surrogate is fitted to.
    ``fresh``: how many wear the socket of the rule that was found, and that of the first rule. Returns what
    ``results/population.json`` holds, and ``report``. Raises `InputError` where the trial states no
    ``[robust]``, or its keys are not those of the first rule.
    """
    trial = load_trial(path)
    run_people(trial, 2, listener=listener)  # the answers of the trial itself stand beside the rule
    return _store_answers(trial, find_robust_rule(trial, people, fresh, listener))
