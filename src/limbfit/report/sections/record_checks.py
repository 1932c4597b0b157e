"""What looks wrong about records, names, units, axes and places, with the evidence."""

from __future__ import annotations

from collections.abc import Sequence

from ...results.identification import LeftOutRecord
from ...results.records import RecordFlag
from ..formats import format_fixed, number
from ..page import Note, Prose, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import make_table, to_numeric

MARKED_ERROR = 4.0  # standardised errors from here on are marked


def make_record_check_section(store: Results) -> Section:
    """Flags, what speaks for each, and every site predicted without itself."""
    flags, left_out = (store.predict.flags, store.predict.left_out) if store.predict else ((), ())
    nothing = Prose(
        "Nothing looks wrong: units, names, axes and places of the records agree with one another, and "
        "every site is predicted from the others about as well as they are."
    )
    return make_section(
        "doubts",
        "Records in doubt",
        _list_failures(store),
        make_bullets(f"{flag.text[:1].upper()}{flag.text[1:]}." for flag in flags) or nothing,
        _make_flag_table(flags) if flags else None,
        _make_left_out_table(store, left_out) if left_out else None,
    )


def _list_failures(store: Results) -> Note | None:
    """What failed, and so was not compared."""
    sites = [row.record for row in store.predicted if row.not_predicted.keys() - {"one_material"}]
    failed = [f"Sites not compared with the others: {', '.join(sites)}."] if sites else []
    failed += [f"Not simulated: {text}." for text in (store.predict.failed if store.predict else ())]
    return Note(" ".join(failed)) if failed else None


def _make_flag_table(flags: Sequence[RecordFlag]) -> Table:
    columns = (
        ("Sites", lambda flag: ", ".join(flag.sites) or "all"),
        ("Kind", "kind"),
        ("Found", "found"),
        (
            "Evidence",
            lambda flag: "; ".join(f"{_format_words(k)} {number(v)}" for k, v in flag.evidence.items()),
        ),
        ("Likely cause", "cause"),
    )
    return make_table("flags", "What looks wrong, and the numbers that say so.", columns, flags)


def _format_words(name: str) -> str:
    for unit, shown in (("_percent", " (%)"), ("_kPa", " (kPa)"), ("_mm", " (mm)"), ("_deg", " (°)")):
        if name.endswith(unit):
            return name.removesuffix(unit).replace("_", " ") + shown
    return name.replace("_", " ")


def _make_left_out_table(store: Results, left_out: Sequence[LeftOutRecord]) -> Table:
    fitted = [name for site in store.fitted for name in (site, *store.records_of(site))]
    columns = (
        ("Site", "site"),
        ("Use", lambda row: "fitted" if row.site in fitted else "held out"),
        ("Error without it (%)", lambda row: to_numeric(format_fixed(100 * row.error))),
        ("Of others (%)", lambda row: to_numeric(format_fixed(100 * row.expected))),
        ("Standardised", "standardised", 1),
        ("Measured over predicted force", "ratio", 2),
        ("Cook's distance", "cook", 2),
    )
    caption = (
        "Every site predicted from all others: root mean square error over the peak; that of the others when "
        "the site is left out; their ratio; the best factor from predicted to measured force; and how far "
        "the site moves the fit, against the misfit. Computed on the first-order expansion about the answer."
    )
    return make_table(
        "left-out", caption, columns, left_out, marked=lambda row: row.standardised > MARKED_ERROR
    )
