"""Stored results as tables: parameters (the paper's table 1), sites (table 2), and the facts beside them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from .formats import NOTHING, duration, fixed, heading, number, numeric, symbol, unit_of, vector
from .page import Cell, Row, Table
from .store import Json, Results

PAPER_TISSUES = {"skin": "Skin–adipose", "muscle": "Muscle"}  # where fat is no tissue of its own


def interval(store: Results, tissue: str, name: str) -> list[float] | None:
    """The stored 95 % interval of a parameter."""
    uncertainty = store.calibration.get("uncertainty") or {}
    limits = (uncertainty.get("intervals_95") or {}).get(tissue, {}).get(name)
    return limits if limits and None not in limits else None


def verdict(store: Results, tissue: str, name: str) -> str:
    """What the identification says about a parameter: ``determined`` or the contrary, in its own words."""
    uncertainty = store.calibration.get("uncertainty") or {}
    key = f"{tissue}.{name}"
    word = str((uncertainty.get("verdict") or {}).get(key, NOTHING))
    return f"{word}; at its bound" if (uncertainty.get("at_bound") or {}).get(key) else word


def parameter_words(store: Results, name: str) -> str:
    """A parameter's symbol and what it is."""
    words = {parameter.key: parameter.words for parameter in store.law.parameters}
    return ", ".join(part for part in (symbol(name), words.get(name, "")) if part)


def tissue_name(store: Results, tissue: str) -> str:
    """A tissue as the head of a row; the two of the paper as the paper names them."""
    if store.tissues == tuple(PAPER_TISSUES):
        return PAPER_TISSUES[tissue]
    return tissue.replace("_", " ").capitalize()


def _limits(limits: list[float] | None) -> str:
    return f"{number(limits[0])} to {number(limits[1])}" if limits else NOTHING


def parameter_table(store: Results) -> Table:
    """Table 1: start, value after each stage, interval, verdict, and the truth where it is known."""
    stages = store.stages
    head = ["Tissue", "Parameter", "Unit", "Start"]
    head += [f"{str(stage['name']).capitalize()}" for stage in stages]
    head += ["95 % interval", "Verdict"] + (["Truth"] if store.truth else [])
    return Table(
        name="parameters",
        caption="Table 1. Constitutive parameters before and after each stage of the identification. "
        "The interval and the verdict belong to the last stage.",
        head=tuple(head),
        rows=tuple(
            _parameter_row(store, tissue, name) for tissue in store.tissues for name in store.law.keys
        ),
    )


def _parameter_row(store: Results, tissue: str, name: str) -> Row:
    stages = store.stages
    values = [stages[0].get("start", {}), *(stage.get("parameters", {}) for stage in stages)]
    cells = [
        heading(tissue_name(store, tissue)),
        Cell(parameter_words(store, name)),
        Cell(unit_of(name)),
    ]
    cells += [numeric(number(tissues.get(tissue, {}).get(name))) for tissues in values]
    cells += [numeric(_limits(interval(store, tissue, name))), Cell(verdict(store, tissue, name))]
    if store.truth:
        cells.append(numeric(number(store.truth.get("parameters", {}).get(tissue, {}).get(name))))
    return Row(tuple(cells))


def correlation_table(store: Results) -> Table | None:
    """The correlation of every pair of parameters, coloured."""
    correlation = (store.calibration.get("uncertainty") or {}).get("correlation") or {}
    names, matrix = correlation.get("names"), correlation.get("matrix")
    if not names or not matrix:
        return None
    short = tuple(_short(str(name)) for name in names)
    rows = tuple(
        Row((heading(label), *(Cell(fixed(value, 2), number=True, shade=_shade(value)) for value in values)))
        for label, values in zip(short, matrix, strict=True)
    )
    return Table(
        name="correlation",
        caption="Correlation of the identified parameters. Near ±1 the data determine only a "
        "combination of the two.",
        head=("", *short),
        rows=rows,
    )


def _shade(value: Any) -> float | None:
    return max(-1.0, min(1.0, float(value))) if isinstance(value, int | float) and value == value else None


def _short(name: str) -> str:
    tissue, _, parameter = name.partition(".")
    return f"{tissue} {symbol(parameter)}" if parameter else name


def place_table(store: Results) -> Table:
    """Where each site lies, and on what evidence."""
    rows = tuple(_place_row(row) for row in store.sites)
    head = ("Site", "Region", "Position, LPS (mm)", "Axis into the limb", "Off the skin (mm)", "Marker")
    return Table("places", "Indentation sites in patient coordinates (LPS).", head, rows)


def _place_row(row: Json) -> Row:
    marker = row.get("marker")
    evidence = "position given in the study"
    if marker:
        evidence = (
            f"{fixed(marker.get('height_mm'))} mm high, "
            f"{fixed(marker.get('distance_to_hint_mm'))} mm from the hint"
        )
    axis = ", ".join(fixed(value, 3) for value in row.get("axis") or ()) or NOTHING
    cells = (
        heading(str(row["site"])),
        Cell(str(row.get("region") or NOTHING)),
        numeric(vector(row.get("position_mm"))),
        numeric(axis),
        numeric(fixed(row.get("off_skin_mm"), 2)),
        Cell(evidence),
    )
    return Row(cells, bool(row.get("fitted")))


def volume_table(store: Results) -> Table | None:
    """Volumes from the label map and inside the surfaces."""
    labels = store.segment.get("volumes_cm3") or {}
    bones, regions = (store.surfaces.get(kind) or {} for kind in ("bones", "regions"))
    bodies = {"skin": store.surfaces.get("skin"), **bones, **regions}
    closed = {name: body["volume_mm3"] / 1000 for name, body in bodies.items() if body}
    names = list(dict.fromkeys([*labels, *closed]))
    if not names:
        return None
    rows = tuple(
        Row((heading(str(name)), numeric(fixed(labels.get(name))), numeric(fixed(closed.get(name)))))
        for name in names
    )
    head = ("Structure", "Label map (cm³)", "Inside the surface (cm³)")
    return Table("volumes", "Volumes of the segmented structures and of the smooth surfaces.", head, rows)


def mesh_table(store: Results) -> Table:
    """Size and quality of every site's mesh, and what the bone policy trimmed."""
    head = (
        "Site",
        "Element",
        "Nodes",
        "Elements",
        "Smallest dihedral (°)",
        "Layers (mm)",
        "Bone trimmed (mm³)",
        "Time",
    )
    rows = tuple(_mesh_row(site, facts, site in store.fitted) for site, facts in store.mesh.items())
    caption = "Meshes. Layers are the mean ± standard deviation of their thickness, outermost first."
    return Table("meshes", caption, head, rows)


def _mesh_row(site: str, facts: Json, marked: bool) -> Row:
    trimmed = [bone.get("volume_mm3", 0.0) for bone in (facts.get("trimmed_bone") or {}).values()]
    cells = (
        heading(site),
        Cell(str(facts.get("element", NOTHING))),
        numeric(_count(facts.get("nodes"))),
        numeric(_count(facts.get("cells"))),
        numeric(fixed(facts.get("min_dihedral_deg"))),
        numeric(_layers(facts)),
        numeric(fixed(sum(trimmed), 0)),
        numeric(duration(facts.get("seconds"))),
    )
    return Row(cells, marked)


def _layers(facts: Json) -> str:
    """Thickness of the layer, or of each by its name."""
    each = facts.get("layer_thickness_mm") or {}
    if len(each) < 2:
        return f"{fixed(facts.get('layer_mean_mm'), 2)} ± {fixed(facts.get('layer_std_mm'), 2)}"
    return ", ".join(
        f"{name} {fixed(values.get('mean'), 2)} ± {fixed(values.get('std'), 2)}"
        for name, values in each.items()
    )


def _count(value: Any) -> str:
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else NOTHING


def solver_table(store: Results) -> Table:
    """How each prediction went: steps, penetration, and the reason where one stopped early."""
    rows = tuple(
        Row(
            (
                heading(str(row["record"])),
                Cell(str(row.get("element", NOTHING))),
                numeric(_count(row.get("steps"))),
                numeric(fixed(row.get("penetration_mm"), 3)),
                Cell("yes" if row.get("completed") else f"no: {row.get('reason') or 'reason not stored'}"),
                Cell(
                    "; ".join(
                        f"{k.replace('_', ' ')}: {why}" for k, why in row.get("not_predicted", {}).items()
                    )
                ),
            ),
            bool(row.get("fitted")),
        )
        for row in store.predicted
    )
    head = ("Site", "Element", "Steps", "Largest penetration (mm)", "Completed", "Not predicted")
    return Table("solver", "The simulation of each site with the identified parameters.", head, rows)


def simulated_table(store: Results) -> Table:
    """Indentations that were simulated one by one."""
    rows = tuple(
        Row(
            (
                heading(str(row["site"])),
                numeric(fixed(row.get("depth_mm"), 2)),
                numeric(fixed(row.get("peak_force_N"), 2)),
                numeric(fixed(row.get("penetration_mm"), 3)),
                Cell(str(row.get("parameters_from", NOTHING))),
                Cell("yes" if row.get("completed") else f"no: {row.get('reason') or 'reason not stored'}"),
            )
        )
        for row in store.simulated
    )
    head = ("Site", "Depth (mm)", "Largest force (N)", "Largest penetration (mm)", "Parameters", "Completed")
    return Table("simulated", "Indentations simulated one by one.", head, rows)


def iteration_table(store: Results, stage: Json) -> Table:
    """Every accepted iterate of one identification stage."""
    iterations = stage.get("iterations") or []
    known = tuple(stage.get("parameters", ()))
    tissues = known if stage.get("name") != "one material" else known[:1]
    columns = [(tissue, name) for tissue in tissues for name in store.law.keys]
    heads = [
        f"{tissue + ' ' if len(tissues) > 1 else ''}{symbol(name)}{_unit(name)}" for tissue, name in columns
    ]
    rows = tuple(
        Row(
            (
                heading(str(step.get("iteration"))),
                numeric(number(step.get("cost"), 4)),
                numeric(fixed(step.get("error_percent"), 2)),
                *(numeric(number(step.get("parameters", {}).get(t, {}).get(name))) for t, name in columns),
            )
        )
        for step in iterations
    )
    name = str(stage.get("name"))
    return Table(
        name=f"iterations-{name.replace(' ', '-')}",
        caption=f"Iterations of the stage “{name}”.",
        head=("Iteration", "Objective", "Error (%)", *heads),
        rows=rows,
        folded=True,
    )


def _unit(name: str) -> str:
    return f" ({unit_of(name)})" if unit_of(name) != NOTHING else ""


def timing_table(store: Results) -> Table:
    """How long each stage took, with bars."""
    seconds = {name: facts.get("seconds") for name, facts in (store.run.get("stages") or {}).items()}
    known = {name: value for name, value in seconds.items() if isinstance(value, int | float)}
    longest = max([*known.values(), 1e-9])
    finished = {name: _moment(facts.get("finished")) for name, facts in store.run["stages"].items()}
    rows = tuple(
        Row((heading(name), numeric(duration(value), share=value / longest), Cell(finished[name])))
        for name, value in known.items()
    )
    total = Row((heading("Total"), numeric(duration(sum(known.values()))), Cell("")))
    caption = "How long each stage took."
    return Table("timing", caption, ("Stage", "Time", "Finished"), rows, (total,))


def _moment(text: Any) -> str:
    """An ISO time as people read it: date, hour, minute."""
    return str(text)[:16].replace("T", " ") if text else NOTHING


def pair_table(name: str, caption: str, head: tuple[str, str], pairs: Mapping[str, Any]) -> Table:
    """Two columns: a key and its value; long ones are folded away on the screen."""
    rows = tuple(Row((heading(str(key)), Cell(str(value)))) for key, value in pairs.items())
    return Table(name, caption, head, rows, folded=len(rows) > 12)


def flatten(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Nested tables as ``table.key`` pairs; the entries of a list of sites go by the site's name."""
    if isinstance(settings, Mapping):
        items: Iterable[tuple[Any, Any]] = settings.items()
    elif isinstance(settings, list) and settings and all(isinstance(one, Mapping) for one in settings):
        items = ((one.get("name", i), one) for i, one in enumerate(settings))
    else:
        return {prefix: _plain(settings)}
    flat: dict[str, Any] = {}
    for key, value in items:
        flat |= flatten(value, f"{prefix}.{key}" if prefix else str(key))
    return flat


def _plain(value: Any) -> str:
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(str(one) for one in value) if isinstance(value, list) else str(value)
