"""The report of a trial: one page with the people, their pressures, limits, rules and drivers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..report.build import write_page
from ..report.drawing import pictures
from ..report.drawing.colours import SIMULATED
from ..report.drawing.plots import add_legend, choose_tissue_style, make_figure, make_panels, set_rows, styled
from ..report.formats import format_duration, format_fixed
from ..report.page import Figure, KeyNumber, Note, Page, Section, make_bullets
from ..report.words import make_prose, make_section, make_table, write_words
from ..results.population import WORST_PLACE, Driver, PopulationResult, Quantity
from ..web import build_patient_frame
from .people import People
from .running import FIELDS, WHOLE, TrialStore, find_person_folder, list_done
from .trial import Trial

_EXCEEDED = 95  # percentile of the people in the picture
_SHOWN = 12  # inputs in the drawing of the drivers


def write_report(trial: Trial, found: PopulationResult) -> Path:
    """Write the report of a trial's answers to ``results/report/report.html``; the path of the file."""
    page = Page(
        title=found.name,
        subtitle="A trial on virtual people",
        key_numbers=_list_key_numbers(found),
        summary=(Note(write_words("population note")),),
        sections=tuple(_list_sections(trial, found)),
        footer=write_words("population footer"),
    )
    return write_page(page, trial.results / "report")


def _list_key_numbers(found: PopulationResult) -> tuple[KeyNumber, ...]:
    worst = [
        KeyNumber(format_fixed(one.difference), "kPa", f"{one.rule} beside {one.beside}, worst region, mean")
        for one in found.differences
        if one.place == WORST_PLACE
    ]
    shares = [
        KeyNumber(format_fixed(one.share_percent, 0), "%", f"{one.rule}: {one.limit}") for one in found.shares
    ]
    time = KeyNumber(format_duration(found.seconds_per_person), "", "time of a person")
    return (KeyNumber(str(found.people), "", "people"), *worst, *shares, time)


def _list_sections(trial: Trial, found: PopulationResult) -> list[Section]:
    loads = [one.load for one in found.quantities]
    load = next((one for one in reversed(list(dict.fromkeys(loads))) if one != "donning"), loads[-1])
    under = [one for one in found.quantities if one.load == load]
    regional = [one for one in under if one.quantity == "mean_kPa"]
    robust = found.robust
    return [
        make_section(
            "population",
            make_prose("population people", found=found),
            make_bullets(f"Rejected: {text}." for text in found.rejected),
            make_bullets(f"Failed: {text}." for text in found.failed),
        ),
        make_section(
            "population-pressure",
            _draw_skin(trial, found, load),
            _draw_regions(regional, found.rules, load) if regional else None,
            make_table("population-quantities", under, folded=True, load=load),
        ),
        make_section("population-limits", make_table("population-limits", found.shares)),
        make_section("population-rules", make_table("population-differences", found.differences)),
        make_section(
            "population-drivers",
            _draw_drivers(found.drivers, found.rules) if found.drivers else None,
            make_table("population-surrogates", found.surrogates),
            map(Note, found.notes),
        ),
        make_section("population-robust", make_prose("population robust", robust=robust) if robust else None),
    ]


@pictures.silence_display_warning()
def _draw_skin(trial: Trial, found: PopulationResult, load: str) -> Figure | None:
    """The mean limb from four sides, a row for each rule; None where limbs do not correspond."""
    skin = People(trial).source.mean_skin
    numbers = list_done(TrialStore(trial).read(), trial.rules)
    if skin is None or not numbers:
        return None
    loads = list(dict.fromkeys(one.load for one in found.quantities))
    order = ["donning", *(one for one in loads if one != "donning")]
    fields = {}
    for rule in found.rules:
        folders = [find_person_folder(trial, number, rule) for number in numbers]
        files = [folder / "results" / "socket" / f"{FIELDS}.npy" for folder in folders]
        stored = [np.load(file)[order.index(load)] for file in files if file.is_file()]
        if stored:
            fields[rule] = np.percentile(stored, _EXCEEDED, axis=0)
    if not fields:
        return None
    surface = skin.to_pyvista()
    bar = ((0.0, max(float(field.max()) for field in fields.values())), "pressure (kPa)")
    views = pictures.make_side_views(build_patient_frame(None), surface)
    rows = []
    for rule, field in fields.items():
        shots = pictures.render_views(pictures.make_field_plotter(surface, field, bar[0]), views)
        rows.append(pictures.PictureRow(shots, [f"{rule}, {side}" for side in pictures.SIDES], bar))
    return pictures.make_picture_figure("population-skin", rows, load=load)


@styled
def _draw_regions(rows: Sequence[Quantity], rules: Sequence[str], load: str) -> Figure:
    places = list(dict.fromkeys(row.place for row in rows if row.place != WHOLE))
    drawing, (ax,) = make_panels(1, 1, 0.3 * len(places) * max(len(rules), 2) * 0.6 + 1.0)
    for i, rule in enumerate(rules):
        style = choose_tissue_style(i)
        own = {row.place: row for row in rows if row.rule == rule}
        shown = [(k, own[place]) for k, place in enumerate(places) if place in own]
        y = np.array([k for k, _ in shown]) + 0.22 * (i - 0.5 * (len(rules) - 1))
        ax.hlines(y, [row.p5 for _, row in shown], [row.p95 for _, row in shown], color=style["color"])
        median = [row.median for _, row in shown]
        ax.plot(median, y, ls="", marker=style["marker"], color=style["color"], label=rule)
    set_rows(ax, places)
    ax.set(xlabel="Mean pressure (kPa)")
    ax.set_xlim(left=0.0)
    add_legend(drawing, ax)
    return make_figure(drawing, "population-regions", load=load)


@styled
def _draw_drivers(drivers: Sequence[Driver], rules: Sequence[str]) -> Figure:
    names = list(dict.fromkeys(one.name for one in drivers))[:_SHOWN]
    drawing, axes = make_panels(len(rules), 2, 0.28 * len(names) + 0.8)
    for ax, rule in zip(axes, rules, strict=True):
        own = {one.name: one for one in drivers if one.rule == rule}
        totals = [own[name].total for name in names]
        ax.barh(range(len(names)), totals, xerr=[own[name].total_interval for name in names], color=SIMULATED)
        set_rows(ax, names)
        ax.set(xlabel="Total Sobol index", title=rule)
        ax.set_xlim(left=0.0)
    return make_figure(drawing, "population-drivers")
