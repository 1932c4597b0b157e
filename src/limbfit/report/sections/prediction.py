"""Fitted and held-out sites: forces, table 2 of the paper, and what was seen beside the force."""

from collections.abc import Iterable, Sequence

from ...results.identification import RecordPrediction, average_records
from ..drawing import figures
from ..drawing.pictures import draw_field_figure
from ..formats import NOTHING, format_fixed
from ..page import Note, Row, Section, Table
from ..store import Results
from ..words import make_prose, make_row, make_section, make_table, to_numeric, write_words


def make_fit_section(store: Results) -> Section:
    """Force against time at the fitted sites."""
    rows = [row for row in store.predicted if row.fitted]
    return make_section(
        "fit",
        figures.draw_force_figure(store, rows, "time_s", "forces-fitted", 2),
        figures.draw_layer_figure(store, fitted=True),
        figures.draw_wave_figure(store, fitted=True),
        figures.draw_skin_figure(store, fitted=True),
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
        figures.draw_layer_figure(store, fitted=False),
        figures.draw_wave_figure(store, fitted=False),
        figures.draw_skin_figure(store, fitted=False),
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
    foot = _make_mean_rows(store)
    return make_table("sites", store.predicted, marked="fitted", foot=foot, several=several, store=store)


def _make_mean_rows(store: Results) -> Iterable[Row]:
    for fitted, use, key in ((True, "fitted", "fitted"), (False, "held out", "heldout")):
        chosen = [row for row in store.predicted if row.fitted == fitted]
        one = average_records((row.site, row.error_one_material_percent) for row in chosen)
        if chosen:
            mean = to_numeric(format_fixed(sum(one) / len(one)) if one else NOTHING)
            cells = (_count_sites(chosen), use, to_numeric(""), to_numeric(""), mean)
            yield make_row(f"Mean, {use}", *cells, to_numeric(store.mean_error(key)))


def _count_sites(rows: Sequence[RecordPrediction]) -> str:
    """How many sites, and how many of them the mean lacks."""
    sites = len({row.site for row in rows})
    lacking = sites - len(average_records((row.site, row.error_percent) for row in rows))
    return f"{sites} site{'s' if sites > 1 else ''}" + (f", without {lacking}" if lacking else "")


def make_observed_table(store: Results) -> Table | None:
    """What was seen beside the force of each record, and how far its prediction is off; None: nothing."""
    rows = [(row, one) for row in store.predicted for one in row.observed]
    return make_table("observed", rows, marked=lambda row: row[0].fitted)
