"""The commands of the socket: its load on the limb, and its design."""

from collections.abc import Mapping
from typing import Annotated, Any

from typer import Option, Typer
from typer.core import TyperGroup

import limbfit

from ..errors import InputError
from ..laws import split_key
from ..results.socket import SocketDesignResult, SocketLoad, SocketResult
from ..results.uncertainty import SocketOfModels
from . import console
from .commands import StudyPath, call_on_study
from .console import AsJson, Column
from .runs import add_execution_options


class WithDefault(TyperGroup):
    """A group whose first command runs where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        names = self.list_commands(ctx)
        if not ctx.resilient_parsing and not (args and args[0] in (*names, "--help")):
            args = [names[0], *args]
        return super().parse_args(ctx, args)


app = Typer(
    help="Put a socket on the limb and load it (fit, the default), or design one.",
    cls=WithDefault,
    rich_markup_mode=None,
)
Parameters = Annotated[str | None, Option(help="parameters of each tissue; default: identified, or people's")]
Literature = Annotated[bool, Option("--literature", help="tissues of people, even if some were identified")]


def fit(
    study: StudyPath,
    parameters: Parameters = None,
    literature: Literature = False,
    samples: Annotated[int | None, Option(help="draws of parameters to simulate as well", min=2)] = None,
    models: Annotated[bool, Option("--models", help="with those of limbfit uncertainty --models")] = False,
    as_json: AsJson = False,
) -> None:
    """Put a socket on the limb and load it: pressure and shear by region, settling, the report."""
    _check_choice(parameters, literature)
    if models:
        if parameters is not None or literature or samples:
            remedy = "leave out --parameters, --literature and --samples"
            raise InputError("models have parameters of their own", place="--models", remedy=remedy)
        result = call_on_study(study, limbfit.fit_socket_of_models)
        console.print_stored(result, "models_socket", show_socket_models, as_json)
        return
    options = {"parameters": parameters, "literature": literature, "samples": samples or 0}
    result = call_on_study(study, limbfit.fit_socket, **options)
    result["report"] = call_on_study(study, limbfit.report_study)["report"]
    console.print_stored(result, "socket", show_socket, as_json)


def show_socket_models(found: SocketOfModels) -> None:
    """The mean pressure of each region by every model, and the interval of all, for donning and each load."""
    columns: dict[str, Column] = {"region, mean (kPa)": "region"}
    for number, model in enumerate(found.models):
        head = f"{model.words}, {100 * model.weight:.0f} %"
        columns[head] = lambda row, number=number: f"{row.mean_kPa[number]:.1f}"  # type: ignore[misc]
    columns["95 % by all models"] = lambda row: console.format_ends(row.interval_kPa, ".1f")
    for load in found.loads:
        console.print_line(f"{load.name}:")
        console.print_table(load.regions, columns)


def show_socket(found: SocketResult) -> None:
    """A table for donning and each load."""
    for note in found.socket.notes:
        console.print_line(f"socket: {note}")
    for name, state in found.states.items():
        settled = ""
        if isinstance(state, SocketLoad):
            settled = f", settled by {state.settling_mm:.1f} mm"
            if state.settling_interval_mm is not None:
                interval = console.format_ends(state.settling_interval_mm, ".1f")
                cause = _format_main_cause(state.settling_interval_from)
                settled += f" (95 %: {interval}, mostly from {cause})"
        area = f"in touch over {state.contact_area_mm2 / 100:.0f} cm2"
        console.print_line(f"{name}: {state.peak_kPa:.0f} kPa at most, {area}{settled}")
        console.print_table(state.regions, LOAD_COLUMNS)
    if found.samples:
        words = "".join(f"; another failed: {reason}" for reason in found.samples.failed)
        console.print_line(f"95 %: by derivatives and {found.samples.simulated} simulated draws{words}")
    if found.worn_s:
        console.print_line(
            f"95 %: with what relaxation may do until the socket has been worn for {found.worn_s:g} s"
        )
    for row in (row for row in found.agreement if row.region == "all"):
        ends = console.format_ends(row.limits_kPa, ".1f")
        limits = f" (95 % limits of agreement {ends})" if ends else ""
        inside = f"{row.within_percent:.0f} % of {row.cells} cells within error and interval"
        console.print_line(f"{row.load}: model minus measured {row.bias_kPa:.1f} kPa{limits}; {inside}")
    balance = f"contact balances the loads within {found.balance_percent:.2g} %"
    console.print_line(f"tissues: {found.parameters_from}; {balance}; not a medical device")
    console.print_warnings(found.outside_text)


def _format_main_cause(shares: Mapping[str, float] | None) -> str:
    """The parameter that most of an interval comes from: ``muscle c 84 %``."""
    if not shares:
        return ""
    name, percent = next(iter(shares.items()))
    return f"{split_key(name)[0].replace('.', ' ')} {percent:.0f} %"


LOAD_COLUMNS: dict[str, Column] = {
    "region": "region",
    "mean (kPa)": ("mean_kPa", ".1f"),
    "95 % (kPa)": lambda row: console.format_ends(row.interval_kPa, ".1f"),
    "mostly from": lambda row: _format_main_cause(row.interval_from),
    "peak (kPa)": ("peak_kPa", ".1f"),
    "shear (kPa)": ("shear_kPa", ".1f"),
}


def design(
    study: StudyPath,
    optimise: Annotated[str, Option(help="regions, by commas, whose peaks are to be lowered further")] = "",
    simulations: Annotated[int | None, Option(help="of --optimise, at most; default: 6", min=1)] = None,
    parameters: Parameters = None,
    literature: Literature = False,
    as_json: AsJson = False,
) -> None:
    """Design a socket from a target pressure, for printing; load it beside a uniformly reduced one."""
    _check_choice(parameters, literature)
    regions = [name.strip() for name in optimise.split(",") if name.strip()]
    if not regions:
        console.refuse_idle_options({"simulations": simulations}, "without --optimise")
    result = call_on_study(
        study,
        limbfit.design_socket,
        optimise=regions,
        simulations=6 if simulations is None else simulations,
        parameters=parameters,
        literature=literature,
    )
    console.print_stored(result, "socket_design", show_design, as_json)


def show_design(found: SocketDesignResult) -> None:
    """Peaks of all regions in each design."""
    designs, optimisation, wall = found.designs, found.optimisation, found.wall
    columns: dict[str, Column] = {}
    for design in designs:
        low, high = design.offset_mm
        reduced = design.reduction_percent
        around = f", {reduced:.2f} % less around" if reduced is not None else ""
        volume = f"{design.name}: {design.volume_cm3:.0f} cm3"
        console.print_line(f"{volume}, {low:.1f} to {high:.1f} mm from the unloaded limb{around}")
        columns[design.name] = (design.name, ".0f")
    starred = optimisation.regions if optimisation else ()
    rows = [
        {"region": f"{name} *" if name in starred else name}
        | {design.name: design.peaks_kPa.get(name) for design in designs}
        for name in designs[0].peaks_kPa
    ]
    console.print_table(rows, {"region, peak (kPa)": "region", **columns}, dash="")
    if optimisation:
        beyond = f"beyond its limit: {', '.join(optimisation.beyond_limits)}"
        rest = beyond if optimisation.beyond_limits else "all others within their limits"
        console.print_line(f"* optimised in {len(optimisation.trials) - 1} simulations; {rest}")
    thickness = f"{wall.stated_mm:g} mm, measured {wall.least_mm:.2f} mm at least"
    console.print_line(f"socket.stl: the {wall.of} with a wall of {thickness}; not a medical device")
    if found.shop:
        console.print_line(f"for the shop, in shop: {', '.join(found.shop.files)}")
        console.print_warnings(found.shop.left_out)


def _check_choice(parameters: str | None, literature: bool) -> None:
    if parameters is not None and literature:
        raise InputError("give either --parameters or --literature", place="--literature")


for verb in (fit, design):
    app.command()(add_execution_options(verb))
