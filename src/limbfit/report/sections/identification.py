"""Parameters (table 1 of the paper), what determines them, how they were found; all sites (table 2)."""

from typing import Any

from ...results.identification import CorrelationMatrix, SearchStage, average_records
from ..drawing import figures
from ..drawing.interactive import draw_convergence_curves
from ..drawing.pictures import draw_field_figure
from ..formats import format_fixed, format_parameter
from ..page import Cell, Note, Section, Table, make_bullets
from ..store import Results
from ..words import make_list, make_prose, make_row, make_section, make_table, write_words

EQUAL_PERCENT = 0.01  # of the largest force: what the tolerance of an equilibrium leaves


def make_parameter_section(store: Results) -> Section:
    """Table 1, intervals and correlations."""
    known = store.uncertainty
    if known is None:
        return make_section("parameters")
    truth, relaxation, priors = store.truth.get("parameters", {}), known.relaxation, known.priors
    pressures = store.calibration and store.calibration.socket_pressures
    return make_section(
        "parameters",
        make_table("parameters", store.parameters, store=store, known=known, truth=truth),
        figures.draw_interval_figure(store),
        make_correlation_table(known.correlation),
        make_prose("relaxation", found=relaxation) if relaxation else None,
        make_table("moduli", relaxation.moduli, store=store) if relaxation else None,
        make_prose("priors", found=priors) if priors else None,
        make_table("priors", store.parameters, store=store, found=priors) if priors else None,
        make_prose("socket pressures", found=pressures) if pressures else None,
        make_prose("combinations", found=known),
        make_list("list of combinations", found=known, store=store),
        make_prose("residuals", found=known.residuals),
    )


def make_correlation_table(correlation: CorrelationMatrix) -> Table:
    """The correlation of every pair of parameters, coloured."""
    heads = [format_parameter(name) for name in correlation.names]
    pairs = zip(heads, correlation.matrix, strict=True)
    rows = []
    for head, values in pairs:
        cells = [Cell(format_fixed(r, 2), number=True, shade=max(-1.0, min(1.0, r))) for r in values]
        rows.append(make_row(head, *cells))
    return Table("correlation", write_words("table correlation"), ("", *heads), tuple(rows))


def make_convergence_section(store: Results) -> Section:
    """How the identification went."""
    found = store.calibration
    return make_section(
        "convergence",
        make_bullets(write_words("end of a stage", stage=stage) for stage in store.stages),
        figures.draw_convergence_figure(store),
        draw_convergence_curves(store),
        make_list("doubts", calibration=found, equal_percent=EQUAL_PERCENT) if found else None,
        make_table("doubtful-simulations", found.doubts.search, folded=True) if found else None,
        (make_iteration_table(store, stage) for stage in store.stages if stage.iterations),
    )


def make_iteration_table(store: Results, stage: SearchStage) -> Table | None:
    """Every accepted iterate of one identification stage."""
    known = tuple(stage.parameters)
    alike = all(values == stage.parameters[known[0]] for values in stage.parameters.values())
    tissues = known[:1] if alike else known  # one material, unless the study fixes a tissue's own value
    name = f"iterations-{stage.name.replace(' ', '-')}"
    facts: dict[str, Any] = {"stage": stage, "tissues": tissues, "store": store}
    return make_table(name, stage.iterations, folded=True, words="iterations", **facts)


def make_fit_section(store: Results) -> Section:
    """Force against time at the fitted sites."""
    rows = [row for row in store.predicted if row.fitted]
    return make_section(
        "fit",
        figures.draw_force_figure(store, rows, "time_s", "forces-fitted", 2),
        figures.draw_seen_figures(store, fitted=True),
        draw_field_figure(store, store.fitted[:4], "predict", "field"),
    )


def make_prediction_section(store: Results) -> Section:
    """Everything about the sites that were not used, and table 2."""
    rows = [row for row in store.predicted if not row.fitted]
    quality = store.predict.fit_quality if store.predict else None
    judged = quality.records if quality else ()
    return make_section(
        "prediction",
        make_site_table(store),
        make_table("fit-quality", judged, marked="fitted", found=quality, compared=store.compared_quantity),
        figures.draw_error_figure(store),
        figures.draw_force_figure(store, rows, "time_s", "forces-held-out", 3),
        figures.draw_force_figure(store, rows, "displacement_mm", "loops-held-out", 3),
        figures.draw_seen_figures(store, fitted=False),
        make_observed_table(store),
        Note(write_words("unseen")) if store.predicted and not rows else None,
    )


def make_domain_section(store: Results) -> Section:
    """What predictions and the socket do to the tissue that no fitted record did."""
    predicted = [(one.record, one.outside_records) for one in store.predicted]
    sentences = list(store.predict.outside_text) if store.predict else []
    socket = store.socket
    if socket is not None:
        states = socket.states.items()
        predicted += [(f"socket, {name}", state.outside_records or ()) for name, state in states]
        sentences += socket.outside_text
    rows = [(record, row) for record, outside in predicted for row in outside]
    return make_section(
        "domain",
        make_prose("domain"),
        map(Note, sentences),
        figures.draw_domain_figure(store),
        make_table("outside-records", rows) or Note(write_words("within")),
    )


def make_site_table(store: Results) -> Table | None:
    """Table 2: largest force and errors of each site, fitted sites marked."""
    several = len({row.site for row in store.predicted}) < len(store.predicted)
    means = []
    for use, fitted in (("fitted", True), ("held out", False)):
        if chosen := [row for row in store.predicted if row.fitted == fitted]:
            one = average_records((row.site, row.error_one_material_percent) for row in chosen)
            means.append((use, chosen, one, average_records((row.site, row.error_percent) for row in chosen)))
    last = make_table("site-means", means, store=store)
    foot = last.rows if last else ()
    return make_table("sites", store.predicted, marked="fitted", foot=foot, several=several, store=store)


def make_observed_table(store: Results) -> Table | None:
    """What was seen beside the force of each record, and how far its prediction is off; None: nothing."""
    rows = [(row, one) for row in store.predicted for one in row.observed]
    return make_table("observed", rows, marked=lambda row: row[0].fitted)
