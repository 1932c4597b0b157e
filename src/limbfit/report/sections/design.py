"""Which sites to test and which records to make: the best choices, and what they would determine."""

from collections.abc import Sequence

import numpy as np

from ...results.planning import DesignResult, ProtocolPlan, ProtocolResult, SiteDesign
from ..drawing.colours import INK, MUTED, ONE_MATERIAL, SIMULATED, THIRD
from ..drawing.plots import add_legend, make_figure, make_panels, set_log_scale, set_rows, styled
from ..formats import format_parameter
from ..page import Figure, Section, make_bullets
from ..store import Results
from ..words import make_prose, make_section, make_table

Designs = Sequence[SiteDesign | ProtocolPlan]
_STYLES = ((SIMULATED, "o"), (THIRD, "D"), (ONE_MATERIAL, "s"), (MUTED, "^"), (INK, "v"))
MAX_FACTOR = 100.0  # factor that is drawn
OWN = "the study's own"  # design


def make_design_section(store: Results, content: DesignResult) -> Section:
    """What the experiment ``design`` found."""
    return make_section(
        "design",
        make_prose("design", content=content),
        make_table("designs", content.designs, marked=lambda row: row.design == OWN, most=MAX_FACTOR),
        draw_expected_figure("designs", content.designs, "testing the sites of a design"),
        make_table("candidates", content.candidates, most=max(row.bits for row in content.candidates)),
        make_bullets(f"Left out: {text}." for text in content.left_out),
    )


@styled
def draw_expected_figure(name: str, designs: Designs, work: str) -> Figure:
    """Expected factors of the intervals by parameter; ``work``: what was done, in words."""
    names = list(designs[0].factor_95)
    drawing, (ax,) = make_panels(1, 1, 0.8 + 0.3 * len(names))
    for k, row in enumerate(designs):
        color, marker = _STYLES[k % len(_STYLES)]
        factors = np.minimum([row.factor_95[name] for name in names], MAX_FACTOR)
        at = np.arange(len(names)) + 0.16 * (k - (len(designs) - 1) / 2)
        ax.plot(factors, at, marker, color=color, ms=5, label=row.design)
    set_rows(ax, [format_parameter(name) for name in names])
    set_log_scale(ax, minor=True)
    ax.axvline(2, color=MUTED, lw=0.8, ls="--")
    ax.set_xlabel("Expected factor of the 95 % interval (–)")
    add_legend(drawing, ax, columns=2)
    return make_figure(drawing, f"{name}-figure", words="expected", work=work, most=MAX_FACTOR)


def make_protocol_section(store: Results, content: ProtocolResult) -> Section:
    """What the experiment ``protocol`` found."""
    rows = content.protocols
    return make_section(
        "protocol",
        make_prose("protocol", content=content),
        make_table("protocol-records", content.records),
        make_table("protocols", rows, marked=lambda row: row is rows[0], most=MAX_FACTOR),
        draw_expected_figure("protocols", rows, "the records of a protocol"),
        make_table("protocol-pressures", content.pressures, protocols=rows),
        make_bullets(f"{text}." for text in content.left_out),
    )
