"""What simulations say about themselves: single ones, those by FEBio too, and those of every site."""

from collections.abc import Sequence

from ...results.identification import RecordPrediction
from ...results.runs import SimulateResult
from ..drawing.colours import MEASURED, SIMULATED, TRUTH
from ..drawing.figures import draw_simulated_figure
from ..drawing.pictures import draw_field_figure
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..page import Bullets, Figure, Note, Section, make_bullets
from ..store import Results
from ..words import make_prose, make_section, make_table, write_words
from .methods import make_pair_table


def make_simulated_section(store: Results) -> Section:
    """Indentations that were simulated one by one."""
    sites = [row.site for row in store.simulated]
    return make_section(
        "simulated",
        _list_warnings(store.simulated),
        draw_simulated_figure(store),
        draw_field_figure(store, sites[:4], "simulate", "field-simulated"),
        make_table("simulated", store.simulated),
    )


def _list_warnings(rows: Sequence[SimulateResult | RecordPrediction]) -> Bullets | None:
    """The solver's warnings about the simulations of the sites; None where there are none."""
    return make_bullets(f"Site {row.site}: {text}" for row in rows for text in row.warnings)


def make_comparison_section(store: Results) -> Section:
    """Curves and differences of the sites that ``limbfit compare`` solved."""
    return make_section(
        "comparison",
        make_prose("comparison"),
        draw_compared_figure(store),
        make_table("compared", store.compared),
    )


@styled
def draw_compared_figure(store: Results) -> Figure | None:
    """Force by FEBio and by limbfit, a panel for each site where both were run."""
    found = store.with_curves("compare", store.compared)
    if not found:
        return None
    drawing, axes = make_panels(len(found), 3, 2.5)
    for ax, (row, curves) in zip(axes, found, strict=True):
        at = curves["time_s"]
        ax.plot(at, curves["febio_N"], "o", ms=3, mfc="none", color=MEASURED, label="FEBio")
        ax.plot(at, curves["limbfit_N"], color=SIMULATED, label="limbfit")
        ax.plot(at, curves["limbfit_matched_N"], "--", color=TRUTH, label="with FEBio's contact penalty")
        ax.set(title=f"Site {row.site}", xlabel="Time (s)", ylabel="Force (N)")
    add_legend(drawing, axes[0])
    return make_figure(drawing, "compared", sites=[row.site for row, _ in found])


def make_solver_section(store: Results) -> Section:
    """What the simulations say about themselves."""
    found = store.calibration
    facts = found and {
        "Objective": found.objective,
        "Forward simulations of the identification": found.forward_runs,
        "Of them with derivatives": found.forward_runs_with_sensitivities,
        "Corrections of the search by the whole meshes": write_words("corrections", rounds=found.corrections),
        "Starts": found.multistart and found.multistart.summary,
        "Linear solver": found.linear_solver,
        "Element": found.element,
    }
    known = {key: value for key, value in (facts or {}).items() if value not in (None, "")}
    failed = ", ".join(row.record for row in store.predicted if not row.completed)
    return make_section(
        "solver",
        Note(f"The simulation did not reach the end of the record at: {failed}.") if failed else None,
        _list_warnings(store.predicted),
        make_table("solver", store.predicted, marked="fitted"),
        make_pair_table("solver-facts", ("Fact", "Value"), known),
    )
