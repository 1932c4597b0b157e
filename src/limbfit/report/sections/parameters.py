"""The identified parameters: table 1 of the paper, intervals, correlations, priors, what determines them."""

from __future__ import annotations

from collections.abc import Mapping

from ...results.base import Parameters
from ...results.identification import CorrelationMatrix, RecordResiduals, ResidualsSummary
from ..drawing.figures import draw_interval_figure
from ..formats import format_fixed, format_limits, get_unit, label, number
from ..page import Block, Bullets, Cell, Prose, Section, Table, make_section
from ..store import Results
from ..tables import Column, make_row, make_table, to_numeric


def make_parameter_section(store: Results) -> Section:
    """Table 1, intervals and correlations."""
    title, none = "Parameters", "No parameters have been identified yet."
    known = store.uncertainty
    if known is None:
        return make_section("parameters", title, otherwise=none)
    return make_section(
        "parameters",
        title,
        make_parameter_table(store),
        draw_interval_figure(store),
        make_correlation_table(known.correlation),
        describe_relaxation(store),
        describe_priors(store),
        _describe_combinations(store),
        _describe_residuals(known.residuals),
        otherwise=none,
    )


def make_parameter_columns(store: Results) -> tuple[Column, ...]:
    """The first columns of a table whose rows are parameters as ``(tissue, key)``."""
    return (
        ("Tissue", lambda row: store.describe_tissue(row[0])),
        ("Parameter", lambda row: store.describe_parameter(row[1])),
        ("Unit", lambda row: get_unit(row[1])),
    )


def make_value_column(head: str, tissues: Parameters) -> Column:
    """The values of parameters by tissue and key."""
    return head, lambda row: to_numeric(number(tissues.get(row[0], {}).get(row[1])))


def make_parameter_table(store: Results) -> Table:
    """Table 1: start, value after each stage, interval, verdict, and the truth where it is known."""
    columns = (
        *make_parameter_columns(store),
        make_value_column("Start", store.stages[0].start),
        *(make_value_column(one.name.capitalize(), one.parameters) for one in store.stages),
        ("95 % interval", lambda row: to_numeric(format_limits(store.interval(*row)))),
        ("Verdict", lambda row: _read_verdict(store, *row)),
        *((make_value_column("Truth", store.truth.get("parameters", {})),) if store.truth else ()),
    )
    caption = (
        "Table 1. Constitutive parameters before and after each stage of the identification. "
        "The interval and the verdict belong to the last stage."
    )
    return make_table("parameters", caption, columns, store.parameters)


def _read_verdict(store: Results, tissue: str, name: str) -> str:
    """What the identification says about a parameter: ``determined`` or the contrary, in its own words."""
    assert store.uncertainty is not None
    key = f"{tissue}.{name}"
    word = store.uncertainty.verdict[key]
    return f"{word}; at its bound" if store.uncertainty.at_bound[key] else word


def make_correlation_table(correlation: CorrelationMatrix) -> Table:
    """The correlation of every pair of parameters, coloured."""
    heads = [label(name) for name in correlation.names]
    pairs = zip(heads, correlation.matrix, strict=True)
    rows = [make_row(head, *map(_shade_cell, values)) for head, values in pairs]
    caption = (
        "Correlation of the identified parameters. Near ±1 the data determine only a combination of the two."
    )
    return Table("correlation", caption, ("", *heads), tuple(rows))


def _shade_cell(value: float) -> Cell:
    return Cell(format_fixed(value, 2), number=True, shade=max(-1.0, min(1.0, value)))


def describe_relaxation(store: Results) -> tuple[Block, ...]:
    """What the records tell of relaxation, and the modulus of each tissue at several times after a step."""
    found = store.uncertainty.relaxation if store.uncertainty else None
    if found is None:
        return ()
    first = found.words[0]
    longest, (low, high) = found.beyond.longest_s, found.prior.slope
    lead = (
        f"{first[0].upper()}{first[1:]}. No record shows the modulus that longer loads see: after "
        f"{longest:.0f} s it falls as a power of time, whose slope is between {low:g} and {high:g} "
        f"({found.prior.source})."
    )
    columns: tuple[Column, ...] = (
        ("Tissue", lambda row: store.describe_tissue(row.tissue)),
        ("After a step (s)", lambda row: to_numeric(number(row.time_s))),
        ("Modulus (kPa)", lambda row: to_numeric(number(row.modulus_kPa))),
        ("95 % interval", lambda row: to_numeric(format_limits(row.interval_95))),
    )
    caption = "Modulus of each tissue after a step of strain: of the model, and what the records leave open."
    return Prose(lead), make_table("moduli", caption, columns, found.moduli)


def describe_priors(store: Results) -> tuple[Block, ...]:
    """Each parameter's prior, how much of its variance priors cause, and its interval without them."""
    found = store.uncertainty.priors if store.uncertainty else None
    if found is None:
        return ()
    stated = found.stated
    sources = list(dict.fromkeys(one.source for one in stated.values()))
    caption = (
        "What was known beforehand, and how much of each interval comes from it: the share of the "
        "variance of its logarithm that the priors' own deviations cause (the rest is that of records and "
        "bounds), and how many times as wide the interval would be without any prior. By linear theory. The "
        "factor is one standard deviation either way."
    )

    def read_prior(row: tuple[str, str], key: str) -> float | None:
        return getattr(stated.get(".".join(row)), key, None)

    def share(row: tuple[str, str]) -> Cell:
        value = found.share[".".join(row)]
        return to_numeric(format_fixed(100 * value, 0), share=min(value, 1.0))

    columns = (
        *make_parameter_columns(store),
        ("Prior", lambda row: to_numeric(number(read_prior(row, "median")))),
        ("Factor", lambda row: to_numeric(format_fixed(read_prior(row, "factor"), 2))),
        ("From priors (%)", share),
        (
            "Wider without",
            lambda row: to_numeric(f"{format_fixed(found.wider_without['.'.join(row)], 2)} times"),
        ),
    )
    table = make_table("priors", caption, columns, store.parameters)
    return Prose(f"Lognormal priors count beside the records. Source: {'; '.join(sources)}."), table


def _describe_combinations(store: Results) -> tuple[Block, ...]:
    """What the data determine of several parameters together, best determined first."""
    sentences = list(store.uncertainty.combinations) if store.uncertainty else []
    if not sentences:
        return ()
    for name in map(".".join, store.parameters):
        sentences = [sentence.replace(name, label(name)) for sentence in sentences]
    lead = (
        "Products of powers of the parameters, the best determined by the data first. They and the intervals "
        "are those of the records alone, sampled on what the calibration simulated; limbfit uncertainty adds "
        "geometry, contact and mesh."
    )
    return Prose(lead), Bullets(tuple(sentences))


def _describe_residuals(found: ResidualsSummary) -> Prose | None:
    """What the intervals rest on: noise, misfit of the model, errors of meshes and surfaces, by site."""
    rows = found.sites
    if not rows:
        return None
    meshes, own = (
        ", ".join(
            f"{name} {format_fixed(100 * share, 1)} %" for name, share in shares.items() if share is not None
        )
        for shares in (
            {name: row.mesh_share for name, row in rows.items()},
            {name: row.site_share for name, row in rows.items()},
        )
    )
    text = (
        "The intervals rest on two kinds of residuals at the fitted sites, standard deviations of the noise "
        f"as recorded and of the smooth misfit of the model: {describe_residuals(rows)}. "
        f"A misfit lasts about {format_fixed(100 * found.correlation, 0)} % of a record. "
    )
    if meshes:
        text += f"The error of the meshes is added, in percent of the largest force: {meshes}."
    else:
        text += "The error of the meshes is not in them: no other mesh was simulated."
    if own:
        text += (
            " So is what tissue and surfaces make a site as a whole stiffer or softer, root mean square over "
            f"the record: {own}; {format_fixed(found.site_factor, 1)} times what its thickness "
            "lets expect."
        )
    return Prose(text)


def describe_residuals(sites: Mapping[str, RecordResiduals]) -> str:
    """Standard deviations of each fitted record's noise and of the model's misfit, in words."""
    return ", ".join(
        f"{name} {format_fixed(one.noise_sd_N, 3)} and {format_fixed(one.misfit_sd_N, 3)} {one.unit}"
        for name, one in sites.items()
    )
