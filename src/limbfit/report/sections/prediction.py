"""Fitted and held-out sites: forces, table 2 of the paper, and what was seen beside the force."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ...results.identification import RecordFit, RecordPrediction
from ..drawing import figures
from ..drawing.pictures import draw_field_figure
from ..formats import NOTHING, format_fixed, number
from ..page import Cell, Note, Prose, Row, Section, Table, make_section
from ..store import Json, Results
from ..tables import Column, make_row, make_table, to_numeric


def make_fit_section(store: Results) -> Section:
    """Force against time at the fitted sites."""
    rows = [row for row in store.predicted if row.fitted]
    return make_section(
        "fit",
        "Fitted sites",
        figures.draw_force_figure(store, rows, "time_s", "forces-fitted", 2),
        figures.draw_layer_figure(store, fitted=True),
        figures.draw_wave_figure(store, fitted=True),
        figures.draw_skin_figure(store, fitted=True),
        draw_field_figure(store, store.fitted[:4], "predict", "field"),
        otherwise="No simulated forces of fitted sites are stored yet.",
    )


def make_prediction_section(store: Results) -> Section:
    """Everything about the sites that were not used, and table 2."""
    rows = [row for row in store.predicted if not row.fitted]
    unseen = "Every site was fitted, so nothing tests the model on unseen data."
    return make_section(
        "prediction",
        "All sites, held-out sites",
        make_site_table(store) if store.predicted else None,
        make_quality_table(store),
        figures.draw_error_figure(store),
        figures.draw_force_figure(store, rows, "time_s", "forces-held-out", 3),
        figures.draw_force_figure(store, rows, "displacement_mm", "loops-held-out", 3),
        figures.draw_layer_figure(store, fitted=False),
        figures.draw_wave_figure(store, fitted=False),
        figures.draw_skin_figure(store, fitted=False),
        make_observed_table(store),
        Note(unseen) if store.predicted and not rows else None,
        otherwise="No predictions are stored yet.",
    )


def make_domain_section(store: Results) -> Section:
    """What predictions and the socket do to the tissue that no fitted record did."""
    predicted = [({"record": one.record}, one.outside_records) for one in store.predicted]
    socket = store.socket
    if socket is not None:
        states = [("donning", socket.donning), *((load.name, load) for load in socket.loads)]
        predicted += [({"record": f"socket, {name}"}, one.outside_records or ()) for name, one in states]
    rows = [head | row.to_plain() for head, outside in predicted for row in outside]
    told = (*(store.predict.outside_text if store.predict else ()), *(socket.outside_text if socket else ()))
    within = "Every prediction lies within what the fitted records did to the tissue."
    return make_section(
        "domain",
        "Where the answer ends",
        Prose(
            "Parameters are tested by what the records did to the tissue: how far they strained it, how "
            "fast, for how long, and where. A small error at held-out sites says nothing beyond that."
        ),
        map(Note, told),
        figures.draw_domain_figure(store),
        make_outside_table(rows) if rows else Note(within),
    )


def make_outside_table(rows: Iterable[Json]) -> Table:
    """Each quantity of a prediction that goes beyond the records, with both ranges."""
    caption = (
        "What goes beyond the fitted records. Strain and pressure: what 1 % of the volume near the load, or "
        "of the area, exceeds. Outside: the share of it, or else of the range, that is beyond the records."
    )
    columns = (
        ("Prediction", "record"),
        ("Quantity", "quantity"),
        ("Tissue", "tissue"),
        ("Unit", "unit"),
        ("Records", lambda row: to_numeric(_format_range(row["records"]))),
        ("Prediction", lambda row: to_numeric(_format_range(row["prediction"]))),
        ("Outside (%)", lambda row: to_numeric(format_fixed(100.0 * row["share"], 0))),
    )
    return make_table("outside-records", caption, columns, rows)


def _format_range(limits: Sequence[float]) -> str:
    low, high = (number(value, 2) for value in limits)
    return f"to {high}" if limits[0] == 0.0 else f"{low} to {high}"


def make_site_table(store: Results) -> Table:
    """Table 2: largest force and errors of each site, fitted sites marked."""
    several = len({row.site for row in store.predicted}) < len(store.predicted)
    records = " A row is a record, named site-record; means are over sites, of the means of their records."
    caption = (
        "Table 2. Force error at every site: the mean absolute error over the trace divided by the "
        f"largest measured force. Sites that the identification used are marked.{records if several else ''}"
    )
    columns = (
        ("Site", "record"),
        ("Region", "region"),
        ("Use", _name_use),
        ("Largest force (N)", "peak_force_N", 2),
        (
            "Depth (mm)",
            lambda row: to_numeric(format_fixed(getattr(store.traces.get(row.record), "depth_mm", None), 2)),
        ),
        (
            "Error, one material (%)",
            lambda row: _format_error(row, row.error_one_material_percent, "one_material"),
        ),
        (f"Error, {store.materials} (%)", lambda row: _format_error(row, row.error_percent, "force")),
    )
    foot = _make_mean_rows(store)
    return make_table("sites", caption, columns, store.predicted, marked="fitted", foot=foot)


def make_quality_table(store: Results) -> Table | None:
    """How well the model follows each record, by phase; None where it is not stored."""
    found = store.predict.fit_quality if store.predict else None
    if found is None or not found.records:
        return None
    caption = (
        f"Goodness of fit: {found.verdict}. Error: root mean square over the largest force, by phase, and "
        "how many times what noise, touch-down, mesh and site explain (about one where the model is right)."
    )

    def phase(name: str) -> Column:
        def cell(row: RecordFit) -> Cell:
            here = next((one for one in row.phases if one.phase == name), None)
            text = (
                f"{format_fixed(here.error_percent, 2)} ({format_fixed(here.times_noise, 1)})"
                if here
                else NOTHING
            )
            return to_numeric(text)

        return f"{name.capitalize()} (% (times))", cell

    columns: tuple[Column, ...] = (
        ("Record", "record"),
        ("Use", _name_use),
        *map(phase, ("loading", "hold", "unloading")),
        ("In the 95 % band (%)", lambda row: to_numeric(format_fixed(100 * row.inside_95, 0))),
        ("Verdict", lambda row: row.verdict or "follows"),
    )
    return make_table("fit-quality", caption, columns, found.records, marked="fitted")


def _name_use(row: RecordPrediction | RecordFit) -> str:
    return "fitted" if row.fitted else "held out"


def _format_error(row: RecordPrediction, error: float | None, what: str) -> object:
    return to_numeric("not predicted" if what in row.not_predicted else format_fixed(error))


def _make_mean_rows(store: Results) -> Iterable[Row]:
    for use, key in (("fitted", "fitted"), ("held out", "heldout")):
        chosen = [row for row in store.predicted if _name_use(row) == use]
        one = _average_by_site((row.site, row.error_one_material_percent) for row in chosen)
        if chosen:
            mean = to_numeric(format_fixed(sum(one) / len(one)) if one else NOTHING)
            cells = (_count_sites(chosen), use, to_numeric(""), to_numeric(""), mean)
            yield make_row(f"Mean, {use}", *cells, to_numeric(store.mean_error(key)))


def _average_by_site(errors: Iterable[tuple[str, float | None]]) -> list[float]:
    """A value of each site: the mean over its records that have one."""
    found: dict[str, list[float]] = {}
    for site, error in errors:
        if error is not None:
            found.setdefault(site, []).append(error)
    return [sum(values) / len(values) for values in found.values()]


def _count_sites(rows: Sequence[RecordPrediction]) -> str:
    """How many sites, and how many of them the mean lacks."""
    sites = len({row.site for row in rows})
    lacking = sites - len(_average_by_site((row.site, row.error_percent) for row in rows))
    return f"{sites} site{'s' if sites > 1 else ''}" + (f", without {lacking}" if lacking else "")


def make_observed_table(store: Results) -> Table | None:
    """What was seen beside the force of each record, and how far its prediction is off; None: nothing."""
    caption = (
        "What was seen beside the force: compression of tissues by ultrasound through the indenter (mm), "
        "displacement of the skin around it (mm), speeds of shear waves under it (m/s). Errors are mean "
        "absolute ones in percent of the largest value."
    )
    columns = (
        ("Record", "record"),
        ("Seen", "what"),
        ("Use", lambda row: "fitted" if row["fitted"] else "held out"),
        ("Compared", "compared"),
        ("Left out", lambda row: ", ".join(f"{n} {why}" for why, n in row["left_out"].items()) or NOTHING),
        ("Largest", "largest", 2),
        ("Noise", "noise", 3),
        ("Unit", "unit"),
        ("Error (%)", "error_percent", 1),
    )
    rows = [
        one.model_dump() | {"record": row.record, "fitted": row.fitted}
        for row in store.predicted
        for one in row.observed
    ]
    return make_table("observed", caption, columns, rows, marked="fitted") if rows else None
