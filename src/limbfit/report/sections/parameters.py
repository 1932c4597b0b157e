"""The identified parameters: table 1 of the paper, intervals, correlations, priors, what determines them."""

from __future__ import annotations

from typing import Any

from ..drawing.figures import draw_interval_figure
from ..formats import NOTHING, format_fixed, format_limits, get_unit, label, number
from ..page import Block, Bullets, Cell, Note, Prose, Section, Table, make_section
from ..store import Json, Results
from ..tables import Column, make_row, make_table, to_numeric


def make_parameter_section(store: Results) -> Section:
    """Table 1, intervals and correlations."""
    found = store.stages
    none = Note("No uncertainty is stored, so the table has no intervals.")
    section = make_section(
        "parameters",
        "Parameters",
        make_parameter_table(store) if found else None,
        draw_interval_figure(store),
        make_correlation_table(store) if found else None,
        otherwise="No parameters have been identified yet.",
    )
    return make_section(
        section.name,
        section.title,
        section.blocks,
        none if found and not store.uncertainty else None,
        describe_relaxation(store),
        describe_priors(store),
        _describe_combinations(store),
        _describe_residuals(store),
    )


def make_parameter_columns(store: Results) -> tuple[Column, ...]:
    """The first columns of a table whose rows are parameters as ``(tissue, key)``."""
    return (
        ("Tissue", lambda row: store.describe_tissue(row[0])),
        ("Parameter", lambda row: store.describe_parameter(row[1])),
        ("Unit", lambda row: get_unit(row[1])),
    )


def make_value_column(head: str, tissues: Json) -> Column:
    """The values of parameters by tissue and key."""
    return head, lambda row: to_numeric(number(tissues.get(row[0], {}).get(row[1])))


def make_parameter_table(store: Results) -> Table:
    """Table 1: start, value after each stage, interval, verdict, and the truth where it is known."""
    columns = (
        *make_parameter_columns(store),
        make_value_column("Start", store.stages[0].get("start", {})),
        *(make_value_column(one["name"].capitalize(), one.get("parameters", {})) for one in store.stages),
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
    key = f"{tissue}.{name}"
    word = str((store.uncertainty.get("verdict") or {}).get(key, NOTHING))
    return f"{word}; at its bound" if (store.uncertainty.get("at_bound") or {}).get(key) else word


def make_correlation_table(store: Results) -> Table | None:
    """The correlation of every pair of parameters, coloured."""
    correlation = store.uncertainty.get("correlation") or {}
    names, matrix = correlation.get("names"), correlation.get("matrix")
    if not names or not matrix:
        return None
    heads = [label(str(name)) for name in names]
    rows = [make_row(head, *map(_shade_cell, values)) for head, values in zip(heads, matrix, strict=True)]
    caption = (
        "Correlation of the identified parameters. Near ±1 the data determine only a combination of the two."
    )
    return Table("correlation", caption, ("", *heads), tuple(rows))


def _shade_cell(value: Any) -> Cell:
    known = isinstance(value, int | float) and value == value
    return Cell(
        format_fixed(value, 2), number=True, shade=max(-1.0, min(1.0, float(value))) if known else None
    )


def describe_relaxation(store: Results) -> tuple[Block, ...]:
    """What the records tell of relaxation, and the modulus of each tissue at several times after a step."""
    found = store.uncertainty.get("relaxation")
    if not found:
        return ()
    first = str(found["words"][0])
    longest, (low, high) = found["beyond"]["longest_s"], found["prior"]["slope"]
    lead = (
        f"{first[0].upper()}{first[1:]}. No record shows the modulus that longer loads see: after "
        f"{longest:.0f} s it falls as a power of time, whose slope is between {low:g} and {high:g} "
        f"({found['prior']['source']})."
    )
    columns: tuple[Column, ...] = (
        ("Tissue", lambda row: store.describe_tissue(row["tissue"])),
        ("After a step (s)", lambda row: to_numeric(number(row["time_s"]))),
        ("Modulus (kPa)", lambda row: to_numeric(number(row["modulus_kPa"]))),
        ("95 % interval", lambda row: to_numeric(format_limits(row["interval_95"]))),
    )
    caption = "Modulus of each tissue after a step of strain: of the model, and what the records leave open."
    return Prose(lead), make_table("moduli", caption, columns, found["moduli"])


def describe_priors(store: Results) -> tuple[Block, ...]:
    """Each parameter's prior, how much of its variance priors cause, and its interval without them."""
    found = store.uncertainty.get("priors")
    if not found:
        return ()
    stated, nothing = found["stated"], {"median": None, "factor": None}
    sources = list(dict.fromkeys(one["source"] for one in stated.values()))
    caption = (
        "What was known beforehand, and how much of each interval comes from it: the share of the "
        "variance of its logarithm that the priors' own deviations cause (the rest is that of records and "
        "bounds), and how many times as wide the interval would be without any prior. By linear theory. The "
        "factor is one standard deviation either way."
    )

    def share(row: tuple[str, str]) -> Cell:
        value = float(found["share"][".".join(row)])
        return to_numeric(format_fixed(100 * value, 0), share=min(value, 1.0))

    columns = (
        *make_parameter_columns(store),
        ("Prior", lambda row: to_numeric(number(stated.get(".".join(row), nothing)["median"]))),
        ("Factor", lambda row: to_numeric(format_fixed(stated.get(".".join(row), nothing)["factor"], 2))),
        ("From priors (%)", share),
        (
            "Wider without",
            lambda row: to_numeric(f"{format_fixed(found['wider_without']['.'.join(row)], 2)} times"),
        ),
    )
    table = make_table("priors", caption, columns, store.parameters)
    return Prose(f"Lognormal priors count beside the records. Source: {'; '.join(sources)}."), table


def _describe_combinations(store: Results) -> tuple[Block, ...]:
    """What the data determine of several parameters together, best determined first."""
    sentences = [str(sentence) for sentence in store.uncertainty.get("combinations") or ()]
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


def _describe_residuals(store: Results) -> Prose | None:
    """What the intervals rest on: noise, misfit of the model, errors of meshes and surfaces, by site."""
    found = store.uncertainty.get("residuals") or {}
    rows = found.get("sites") or {}
    if not rows:
        return None
    meshes, own = (
        ", ".join(
            f"{name} {format_fixed(100 * site[share], 1)} %"
            for name, site in rows.items()
            if site.get(share) is not None
        )
        for share in ("mesh_share", "site_share")
    )
    text = (
        "The intervals rest on two kinds of residuals at the fitted sites, standard deviations of the noise "
        f"as recorded and of the smooth misfit of the model: {describe_residuals(rows)}. "
        f"A misfit lasts about {format_fixed(100 * found['correlation'], 0)} % of a record. "
    )
    if meshes:
        text += f"The error of the meshes is added, in percent of the largest force: {meshes}."
    else:
        text += "The error of the meshes is not in them: no other mesh was simulated."
    if own:
        text += (
            " So is what tissue and surfaces make a site as a whole stiffer or softer, root mean square over "
            f"the record: {own}; {format_fixed(found['site_factor'], 1)} times what its thickness "
            "lets expect."
        )
    return Prose(text)


def describe_residuals(sites: Json) -> str:
    """Standard deviations of each fitted record's noise and of the model's misfit, in words."""
    return ", ".join(
        f"{name} {format_fixed(one.get('noise_sd_N'), 3)} and {format_fixed(one.get('misfit_sd_N'), 3)} "
        f"{one.get('unit', 'N')}"
        for name, one in sites.items()
    )
