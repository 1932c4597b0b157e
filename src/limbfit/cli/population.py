"""``limbfit population``: a trial on virtual people."""

from pathlib import Path
from typing import Annotated, Any

import typer

import limbfit

from ..errors import InputError
from ..results.population import WORST_PLACE, PopulationResult
from . import console
from .console import AsJson, Column
from .runs import add_execution_options

app = typer.Typer(
    help="A trial on virtual people: which socket serves most limbs.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
TrialPath = Annotated[Path, typer.Argument(help="population.toml or its folder", show_default=False)]
LEAST_SHARE = 0.01  # a driver with less is not printed


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(help="a new folder, or one without a trial", show_default=False)],
    phantom: Annotated[
        bool, typer.Option("--phantom", help="limbs of the phantom (the default): nothing is downloaded")
    ] = False,
    model: Annotated[Path | None, typer.Option(help="limbs of a shape model (limbfit shapes model)")] = None,
    limbs: Annotated[
        Path | None, typer.Option(help="the limbs of a folder: a file or a folder of bodies for each")
    ] = None,
) -> None:
    """Write a population.toml with its keys explained."""
    if phantom + (model is not None) + (limbs is not None) > 1:
        raise InputError("give one of --phantom, --model and --limbs", place="--phantom")
    console.print_line(f"written to {limbfit.write_trial(folder, model=model, limbs=limbs)}")


@app.command()
def check(trial: TrialPath, as_json: AsJson = False) -> None:
    """Build one person with every socket, without solving anything."""

    def show(found: dict[str, Any]) -> None:
        inputs = ", ".join(f"{name} {value:.3g}" for name, value in found["inputs"].items())
        console.print_line(f"person {found['person']} can wear every socket: {inputs}")

    console.print_result(limbfit.check_trial(trial), show, as_json)


def run(
    trial: TrialPath,
    people: Annotated[int | None, typer.Option(help="how many; default: the trial's", min=1)] = None,
    within: Annotated[
        float | None,
        typer.Option(help="end as soon as every share over a limit is known so well, +- percent", min=0.5),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate the people, and write answers and report; go on where a run was ended."""
    found = console.call_with_progress(limbfit.run_population, trial, people=people, within_percent=within)
    console.print_result(found, _show_stored, as_json)


@app.command()
def status(trial: TrialPath, as_json: AsJson = False) -> None:
    """Say how many people are done, failed or were rejected."""

    def show(found: dict[str, Any]) -> None:
        seconds = found["seconds_per_socket"]
        time = "" if seconds is None else f", {seconds:.0f} s a socket"
        console.print_line(
            f"{found['people']} of {found['wanted']} people wear every socket{time}; {found['failed']} "
            f"simulations failed, {found['rejected']} limbs were rejected"
        )

    console.print_result(limbfit.count_people(trial), show, as_json)


@app.command()
def report(trial: TrialPath, as_json: AsJson = False) -> None:
    """Write answers and report anew from what is stored."""
    console.print_result(limbfit.report_population(trial), _show_stored, as_json)


def person(
    trial: TrialPath,
    number: Annotated[int, typer.Argument(help="of the person", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """Open a person as ordinary studies, one for each rule, with reports; simulate who is not there."""
    found = console.call_with_progress(limbfit.open_person, trial, number)

    def show(found: dict[str, Any]) -> None:
        for rule, study in found["studies"].items():
            console.print_line(f"{rule}: limbfit studio {study!r}; report: {found['reports'][rule]}")

    console.print_result(found, show, as_json)


def robust(
    trial: TrialPath,
    people: Annotated[int, typer.Option(help="for the surrogate, each with another rule", min=12)] = 40,
    fresh: Annotated[int, typer.Option(help="on whom the rule is checked by simulation", min=2)] = 8,
    as_json: AsJson = False,
) -> None:
    """Search the rule that lowers the 90th percentile of the worst pressure, and check it on fresh people."""
    found = console.call_with_progress(limbfit.make_robust, trial, people=people, fresh=fresh)
    console.print_result(found, _show_stored, as_json)


def _show_stored(content: dict[str, Any]) -> None:
    own = {key: value for key, value in content.items() if key not in ("report", "folder")}
    show_population(PopulationResult.model_validate(own))
    console.print_line(f"stored in {content['folder']}; report: {content['report']}")


def show_population(found: PopulationResult) -> None:
    """How many people, and the answers: shares over limits, differences of rules, what drives them."""
    console.print_line(
        f"{found.people} people, {len(found.rejected)} limbs rejected, {len(found.failed)} simulations "
        f"failed; {found.seconds_per_person:.0f} s a person, {found.seconds_per_socket:.0f} s a socket"
    )
    if found.shares:
        columns: dict[str, Column] = {
            "rule": "rule",
            "over the limit": "limit",
            "share (%)": ("share_percent", ".0f"),
            "95 % (%)": lambda row: console.format_ends(row.interval_percent, ".0f"),
        }
        console.print_table(found.shares, columns)
    worst = [one for one in found.differences if one.place == WORST_PLACE]
    if worst:
        columns = {
            "rule": lambda row: f"{row.rule} - {row.beside}",
            "place": "place",
            "mean difference (kPa)": ("difference", ".1f"),
            "95 % (kPa)": lambda row: console.format_ends(row.interval, ".1f"),
            "lower for (%)": ("lower_percent", ".0f"),
        }
        console.print_table(worst, columns)
    if found.drivers:
        columns = {
            "rule": "rule",
            "driver": "name",
            "first": ("first", ".2f"),
            "total": lambda row: f"{row.total:.2f} +- {row.total_interval:.2f}",
        }
        console.print_table([one for one in found.drivers if one.total > LEAST_SHARE], columns)
    for one in found.surrogates:
        console.print_line(
            f"surrogate of {one.rule}: {one.error_kPa:.1f} kPa RMS at people left out, "
            f"{100 * one.explained:.0f} % of the variance"
        )
    if found.robust is not None:
        made, keys = found.robust, ", ".join(f"{key} {value:.2f}" for key, value in found.robust.keys.items())
        console.print_line(
            f"robust rule: {keys}; {made.checked_people} fresh people: 90th percentile of the worst pressure "
            f"{made.checked_p90_kPa:.1f} kPa ({made.predicted_p90_kPa:.1f} predicted), with {found.rules[0]} "
            f"{made.beside_p90_kPa:.1f}; mean difference {made.difference_kPa:.1f} kPa (95 %: "
            f"{console.format_ends(made.interval_kPa, '.1f')})"
        )
    console.print_warnings(found.notes)


for verb in (run, person, robust):
    app.command()(add_execution_options(verb))
