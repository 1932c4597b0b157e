"""Table 2 of the paper: largest force and error of every record, their means over sites, their residuals."""

from __future__ import annotations

from collections.abc import Iterable

from .formats import NOTHING, fixed, heading, numeric
from .page import Cell, Row, Table
from .store import Json, Results


def site_table(store: Results) -> Table:
    """Table 2: largest force and errors of each site, fitted sites marked."""
    head = (
        "Site",
        "Region",
        "Use",
        "Largest force (N)",
        "Depth (mm)",
        "Error, one material (%)",
        f"Error, {store.materials} (%)",
    )
    return Table(
        name="sites",
        caption="Table 2. Force error at every site: the mean absolute error over the trace divided by the "
        "largest measured force. Sites that the identification used are marked." + _of_records(store),
        head=head,
        rows=tuple(_site_row(store, row) for row in store.predicted),
        foot=tuple(_mean_rows(store)),
    )


def _of_records(store: Results) -> str:
    """What the rows are where a site has several records."""
    sites = {row["site"] for row in store.predicted}
    several = len(sites) < len(store.predicted)
    return (
        " A row is a record, named site-record; means are over sites, of the means of their records."
        if several
        else ""
    )


def _site_row(store: Results, row: Json) -> Row:
    fitted = bool(row.get("fitted"))
    depth = store.traces.get(row["record"], {}).get("depth_mm")
    return Row(
        (
            heading(str(row["record"])),
            Cell(str(row.get("region") or NOTHING)),
            Cell("fitted" if fitted else "held out"),
            numeric(fixed(row.get("peak_force_N"), 2)),
            numeric(fixed(depth, 2)),
            numeric(_error(row, "error_one_material_percent", "one_material")),
            numeric(_error(row, "error_percent", "force")),
        ),
        marked=fitted,
    )


def _error(row: Json, key: str, what: str) -> str:
    return "not predicted" if what in row.get("not_predicted", ()) else fixed(row.get(key))


def _mean_rows(store: Results) -> Iterable[Row]:
    for word, key in (("fitted", "fitted"), ("held out", "heldout")):
        chosen = [row for row in store.predicted if bool(row.get("fitted")) == (key == "fitted")]
        one = _by_site(chosen, "error_one_material_percent")
        if chosen:
            yield Row(
                (
                    heading(f"Mean, {word}"),
                    Cell(_number_of_sites(chosen)),
                    Cell(word),
                    numeric(""),
                    numeric(""),
                    numeric(fixed(sum(one) / len(one)) if one else NOTHING),
                    numeric(mean_and_deviation(store, key)),
                )
            )


def _by_site(rows: list[Json], key: str) -> list[float]:
    """A value of each site: the mean over its records that have one."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row.get(key) is not None:
            found.setdefault(row["site"], []).append(float(row[key]))
    return [sum(values) / len(values) for values in found.values()]


def mean_and_deviation(store: Results, which: str) -> str:
    """``4.5 ± 1.0``: stored mean and standard deviation of the errors at ``fitted`` or ``heldout`` sites."""
    mean = store.predict.get(f"mean_error_{which}_percent")
    deviation = store.predict.get(f"sd_error_{which}_percent")
    return fixed(mean) if deviation is None else f"{fixed(mean)} ± {fixed(deviation)}"


def _number_of_sites(rows: list[Json]) -> str:
    """How many, and how many of them the mean lacks."""
    sites = len({row["site"] for row in rows})
    lacking = sites - len(_by_site(rows, "error_percent"))
    return f"{sites} site{'s' if sites > 1 else ''}" + (f", without {lacking}" if lacking else "")


def observed_table(store: Results) -> Table | None:
    """What was seen beside the force of each record, and how far its prediction is off; None: nothing."""
    rows = tuple(_observed_row(row, one) for row in store.predicted for one in row.get("observed") or ())
    if not rows:
        return None
    caption = (
        "What was seen beside the force: compression of tissues by ultrasound through the indenter (mm), "
        "displacement of the skin around it (mm), speeds of shear waves under it (m/s). Errors are mean "
        "absolute ones in percent of the largest value."
    )
    head = ("Record", "Seen", "Use", "Compared", "Left out", "Largest", "Noise", "Unit", "Error (%)")
    return Table("observed", caption, head, rows)


def _observed_row(row: Json, one: Json) -> Row:
    left_out = ", ".join(f"{number} {why}" for why, number in (one.get("left_out") or {}).items())
    return Row(
        (
            heading(str(row["record"])),
            Cell(str(one["what"])),
            Cell("fitted" if row.get("fitted") else "held out"),
            Cell(str(one["compared"])),
            Cell(left_out or NOTHING),
            numeric(fixed(one["largest"], 2)),
            numeric(fixed(one["noise"], 3)),
            Cell(str(one["unit"])),
            numeric(fixed(one["error_percent"])),
        ),
        marked=bool(row.get("fitted")),
    )


def noise_and_misfit(sites: Json) -> str:
    """Standard deviations of each fitted record's noise and of the model's misfit, in words."""
    rows = [(name, one.get("noise_sd_N"), one.get("misfit_sd_N"), one) for name, one in sites.items()]
    return ", ".join(
        f"{name} {fixed(a, 3)} and {fixed(b, 3)} {one.get('unit', 'N')}" for name, a, b, one in rows
    )
