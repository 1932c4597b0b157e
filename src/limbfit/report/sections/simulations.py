"""What simulations say about themselves: single ones, those by FEBio too, and those of every site."""

from ..drawing.colours import MEASURED, SIMULATED, TRUTH
from ..drawing.figures import draw_simulated_figure
from ..drawing.pictures import draw_field_figure
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..formats import NOTHING
from ..page import Figure, Note, Section
from ..store import Results
from ..words import make_list, make_prose, make_section, make_table, write_columns
from .methods import make_pair_table


def make_simulated_section(store: Results) -> Section:
    """Indentations that were simulated one by one."""
    sites = [row.site for row in store.simulated]
    return make_section(
        "simulated",
        make_list("warnings of sites", rows=store.simulated),
        draw_simulated_figure(store),
        draw_field_figure(store, sites[:4], "simulate", "field-simulated"),
        make_table("simulated", store.simulated),
    )


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
    columns = write_columns("table solver-facts", found=found) if found else []
    known = {head: text for head, _, text, _ in columns if text not in ("", NOTHING)}
    failed = ", ".join(row.record for row in store.predicted if not row.completed)
    return make_section(
        "solver",
        Note(f"The simulation did not reach the end of the record at: {failed}.") if failed else None,
        make_list("warnings of sites", rows=store.predicted),
        make_table("solver", store.predicted, marked="fitted"),
        make_pair_table("solver-facts", ("Fact", "Value"), known),
    )
