"""What looks wrong about records, names, units, axes and places, with the evidence."""

from __future__ import annotations

from ..formats import fixed, heading, number, numeric
from ..page import Bullets, Cell, Note, Prose, Row, Section, Table
from ..store import Json, Results
from ..tables import NOTHING

_LARGE = 4.0  # standardised errors from here on are marked


def doubts(store: Results) -> Section:
    """Flags, what speaks for each, and every site predicted without itself."""
    flags, left_out = store.predict.get("flags") or [], store.predict.get("left_out") or []
    if flags:
        words: Prose | Bullets = Bullets(tuple(_sentence(flag) for flag in flags))
    else:
        words = Prose(
            "Nothing looks wrong: units, names, axes and places of the records agree with one another, and "
            "every site is predicted from the others about as well as they are."
        )
    tables = (_flag_table(flags),) if flags else ()
    unknown = _not_looked_at(store)
    return Section(
        "doubts", "Records in doubt", (*unknown, words, *tables, *_left_out_tables(store, left_out))
    )


def _not_looked_at(store: Results) -> tuple[Note, ...]:
    """What failed, and so was not compared."""
    sites = [
        str(row["record"])
        for row in store.predicted
        if row.get("not_predicted", {}).keys() - {"one_material"}
    ]
    failed = [f"Sites not compared with the others: {', '.join(sites)}."] if sites else []
    failed += [f"Not simulated: {text}." for text in store.predict.get("failed") or ()]
    return (Note(" ".join(failed)),) if failed else ()


def _sentence(flag: Json) -> str:
    text = str(flag["text"])
    return text[:1].upper() + text[1:] + "."


def _flag_table(flags: list[Json]) -> Table:
    rows = tuple(
        Row(
            (
                heading(", ".join(flag["sites"]) or "all"),
                Cell(str(flag["kind"])),
                Cell(str(flag.get("found", NOTHING))),
                Cell(
                    "; ".join(f"{_words(name)} {number(value)}" for name, value in flag["evidence"].items())
                ),
                Cell(str(flag["cause"])),
            )
        )
        for flag in flags
    )
    head = ("Sites", "Kind", "Found", "Evidence", "Likely cause")
    return Table("flags", "What looks wrong, and the numbers that say so.", head, rows)


def _words(name: str) -> str:
    for unit, shown in (("_percent", " (%)"), ("_kPa", " (kPa)"), ("_mm", " (mm)"), ("_deg", " (°)")):
        if name.endswith(unit):
            return name.removesuffix(unit).replace("_", " ") + shown
    return name.replace("_", " ")


def _left_out_tables(store: Results, left_out: list[Json]) -> tuple[Table, ...]:
    if not left_out:
        return ()
    fitted = [name for site in store.fitted for name in (site, *store.records_of(site))]
    rows = tuple(
        Row(
            (
                heading(str(row["site"])),
                Cell("fitted" if row["site"] in fitted else "held out"),
                numeric(fixed(100 * row["error"])),
                numeric(fixed(100 * row["expected"])),
                numeric(fixed(row["standardised"])),
                numeric(fixed(row["ratio"], 2)),
                numeric(fixed(row["cook"], 2)),
            ),
            marked=row["standardised"] > _LARGE,
        )
        for row in left_out
    )
    head = (
        "Site",
        "Use",
        "Error without it (%)",
        "Of others (%)",
        "Standardised",
        "Measured over predicted force",
        "Cook's distance",
    )
    caption = (
        "Every site predicted from all others: root mean square error over the peak; that of the others when "
        "the site is left out; their ratio; the best factor from predicted to measured force; and how far "
        "the site moves the fit, against the misfit. Computed on the first-order expansion about the answer."
    )
    return (Table("left-out", caption, head, rows),)
