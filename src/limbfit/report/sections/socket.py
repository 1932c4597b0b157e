"""The socket in the report: pressure and shear by region and their causes, settling, balance, design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...results.socket import SocketDesignResult, SocketResult
from ..drawing.socket_pictures import (
    draw_inside_figure,
    draw_offset_figure,
    draw_pressure_figures,
    draw_settling_figure,
)
from ..formats import NOTHING, format_fixed, format_friction, format_symbol, label
from ..page import Block, Note, Prose, Row, Section, Table, make_section
from ..store import Json, Results
from ..tables import Column, make_row, make_table, to_numeric

# What counts as known, and how its change is headed.
KNOWN = {
    "liner.c_kPa": f"Change, liner {format_symbol('c')} 10 % larger",
    "friction": "Change, friction 10 % larger",
}
PAPERS = (
    "Measured pressures depend on sensor, socket and activity: see the cited papers, the review by Al-Fakih "
    "et al. (Sensors 2016, 16:1119), and for thresholds of pain by region Lee et al. (Arch Phys Med Rehabil "
    "2005, 86:641)."
)
ORIGINS = {
    "identified": "identified from this limb's records",
    "literature": "those of people (medians), not of this limb",
    "given": "given by hand",
}


def make_socket_section(store: Results, found: SocketResult) -> Section:
    """What the experiment ``socket`` found."""
    content = found.to_plain()
    loads = content["loads"]
    folder = store.folder / "socket"
    names = ["donning", *(load["name"] for load in loads)]
    held = [content["donning"], *loads]
    return make_section(
        "socket",
        "The limb in its socket",
        Note(
            "A simulation for research, not a medical device: it says what a rigid socket does to this model "
            "of the limb."
        ),
        Prose(_describe_shape(content)),
        (Note(f"The socket's file: {text}.") for text in content["socket"]["notes"]),
        Prose(_describe_loads(loads)),
        draw_pressure_figures(
            store, {name: folder / f"held-{i}.vtu" for i, name in enumerate(names)}, "socket"
        ),
        draw_settling_figure(content),
        _make_region_table(names, held, (content.get("samples") or {}).get("simulated", 0)),
        make_interval_table(held[-1], names[-1]),
        _describe_wear(content.get("worn_s")),
        make_published_blocks(content, held[-1], names[-1]),
        draw_inside_figure(store, names[-1], held[-1]["inside"], folder / f"held-{len(held) - 1}.vtu"),
        _make_strain_table(names, held),
        Prose(
            f"Sum of contact forces and moments against the stated load: within "
            f"{content['balance_percent']:.2g} % at every step. Pressures are those of contact, on the "
            "outside of the liner where there is one; a mean is the normal force over the area, a peak the "
            "largest mean over one face of the mesh, which grows as faces get smaller. The limb is at most "
            f"{content['penetration_mm']:.2f} mm in the wall."
        ),
        map(Note, [*content["warnings"], *content.get("outside_text", ())]),
    )


def _describe_shape(content: Json) -> str:
    shape, liner = content["socket"], content["socket"]["liner"]
    made = (
        f"rectified from the limb, {shape['reduction_percent']:g} % less in circumference"
        if shape["reduction_percent"] is not None
        else f"read from {shape['source']}"
    )
    areas = f", with {len(shape['areas'])} areas pressed in or relieved" if shape["areas"] else ""
    lined = f"a liner of {liner['thickness_mm']:g} mm" if liner["thickness_mm"] else "no liner"
    origin = ORIGINS.get(content["parameters_from"], content["parameters_from"])
    return (
        f"The socket is {made}{areas}: {shape['volume_cm3']:.0f} cm3, at most {shape['deepest_mm']:.1f} mm "
        f"inside the limb's unloaded surface. Contact is {format_friction(content['friction'])}; {lined}. "
        f"Tissues: {origin}."
    )


def _describe_loads(loads: list[Json]) -> str:
    if not loads:
        return "No load was stated: the socket is donned and held."
    words = []
    for load in loads:
        size = sum(value**2 for value in load["force_N"]) ** 0.5
        known = load["settling_interval_mm"]
        limits = "" if known is None else f" (95 %: {_format_interval(known)})"
        words.append(
            f"{load['name']}, {size:.0f} N: the limb settles by {load['settling_mm']:.1f} mm{limits}"
        )
    return "; ".join(words) + "."


def _make_region_table(names: list[str], held: list[Mapping[str, Any]], draws: int) -> Table:
    columns = (
        ("Region", "region"),
        ("Mean pressure (kPa)", "mean_kPa", 1),
        ("95 % (kPa)", lambda row: to_numeric(_format_interval(row["interval_kPa"]))),
        ("Mostly from", lambda row: to_numeric(_name_main_source(row["interval_from"]))),
        ("Peak (kPa)", "peak_kPa", 1),
        ("Mean shear (kPa)", "shear_kPa", 1),
        ("Peak shear (kPa)", "shear_peak_kPa", 1),
    )
    order = f"by derivatives and {draws} simulated draws" if draws else "to first order"
    caption = (
        "Pressure and shear by region of the limb, when donning and each load have been held. 95 %: from the "
        f"identified parameters' covariance, {order}; liner and friction count as known."
    )
    return _make_load_table("socket-regions", caption, columns, names, [one["regions"] for one in held])


def _format_interval(interval: list[float] | None) -> str:
    return NOTHING if interval is None else f"{format_fixed(interval[0])} to {format_fixed(interval[1])}"


def _name_main_source(shares: Mapping[str, float] | None) -> str:
    """The parameter that most of an interval comes from: ``muscle c 84 %``."""
    if not shares:
        return NOTHING
    name, percent = next(iter(shares.items()))
    return f"{label(name)} {format_fixed(percent, 0)} %"


def _make_load_table(
    name: str, caption: str, columns: Sequence[Column], loads: list[str], rows: list[list[Json]]
) -> Table:
    """A table in which the rows of each load stand below a marked row with its name."""
    body: list[Row] = []
    for load, own in zip(loads, rows, strict=True):
        body.append(make_row(load, *(to_numeric("") for _ in columns[1:]), marked=True))
        body += make_table(name, caption, columns, own).rows
    return Table(name, caption, tuple(column[0] for column in columns), tuple(body))


def _make_strain_table(names: list[str], held: list[Mapping[str, Any]]) -> Table:
    levels = list(held[0]["inside"][0]["sheared_mm3"])
    columns: tuple[Column, ...] = (
        ("Tissue", "tissue"),
        ("Shear: largest", "shear", 2),
        ("exceeded in 1 %", "shear_rare", 2),
        ("Compression: largest", "compression", 2),
        ("exceeded in 1 %", "compression_rare", 2),
        *((f"Sheared over {level} (cm3)", ("sheared_cm3", level), 2) for level in levels),
        ("Largest shear near", lambda row: to_numeric(row["near"] or NOTHING)),
    )
    rows = [[row | {"sheared_cm3": _to_cm3(row["sheared_mm3"])} for row in one["inside"]] for one in held]
    caption = (
        "Strain inside the limb, when donning and each load have been held. Shear: half the difference of "
        "the largest and the least principal Green-Lagrange strain, compression: the least with its sign "
        "turned, both of a whole element, and what 1 % of the tissue's volume exceeds. The largest grow as "
        "elements get smaller. No limit of harm is implied."
    )
    return _make_load_table("socket-inside", caption, columns, names, rows)


def _to_cm3(volumes_mm3: Mapping[str, float]) -> dict[str, float]:
    return {level: volume / 1000.0 for level, volume in volumes_mm3.items()}


def _describe_wear(worn_s: float | None) -> Prose | None:
    """For how long a load the intervals hold."""
    if worn_s is None:
        return None
    return Prose(
        f"Intervals count what relaxation may do until the socket has been worn for {worn_s:g} s, which no "
        "record shows (see Parameters); they hold the simulated values, too."
    )


def make_interval_table(held: Mapping[str, Any], title: str) -> Table | None:
    """How much of each interval goes with every identified parameter; what liner and friction change."""
    rows = [(row["region"], "kPa", "", row["mean_kPa"], row) for row in held["regions"]]
    if "settling_mm" in held:
        rows.append(("settling", "mm", "settling_", held["settling_mm"], held))
    if rows[0][-1]["interval_from"] is None:
        return None
    names = sorted(rows[0][-1]["interval_from"])
    known = [name for name in KNOWN if name in rows[0][-1]["change_kPa"]]
    heads = [*(f"{label(name)} (%)" for name in names), *(KNOWN[name] for name in known)]
    lines = []
    for name, unit, begin, value, row in rows:
        low, high = row[f"{begin}interval_{unit}"]
        cells = [f"{format_fixed(value)} {unit}", f"{format_fixed(max(value - low, high - value), 2)} {unit}"]
        cells += [format_fixed(row[f"{begin}interval_from"][one], 0) for one in names]
        changes = row[f"{begin}change_{unit}"]
        cells += [f"{format_fixed(changes[one], 2 if unit == 'mm' else 1)} {unit}" for one in known]
        lines.append(make_row(name, *map(to_numeric, cells)))
    caption = (
        f"What the intervals of means and settling come from, {title}: the share of the variance that would "
        "go if a parameter were known, to first order. Parameters are correlated, so that shares do not add "
        "up to 100 %. Liner and friction count as known; the last columns say what they change (friction "
        "with --samples)."
    )
    return Table("socket-intervals", caption, ("", "Value", "95 %, half", *heads), tuple(lines))


def make_published_blocks(content: Json, held: Mapping[str, Any], title: str) -> tuple[Block, ...]:
    """What others found over this limb's regions, if they studied such limbs, and the papers to read."""
    return (make_published_table(content, held, title), Prose(PAPERS)) if content["published"] else ()


def make_published_table(content: Json, held: Mapping[str, Any], title: str) -> Table:
    """What others found over the regions of this result, beside its pressures when a part has been held."""
    here = {row["region"]: row for row in held["regions"]}
    columns = (
        ("Region", "region"),
        ("Here: mean (kPa)", "mean_kPa", 1),
        ("Here: peak (kPa)", "peak_kPa", 1),
        ("Found by others", "found"),
        ("How", "method"),
        ("Source", "source"),
    )
    rows = [
        {**held, **here.get(name, {}), **one, "region": name}
        for name in dict.fromkeys(name for one in content["published"] for name in one["regions"])
        for one in content["published"]
        if name in one["regions"]
    ]
    caption = (
        f"Pressures of this simulation, {title}, and what others found over these regions. No limit and no "
        "verdict is implied."
    )
    return make_table("socket-published", caption, columns, rows)


def make_socket_design_section(store: Results, found: SocketDesignResult) -> Section:
    """What the experiment ``socket_design`` found."""
    content = found.to_plain()
    folder, designs = store.folder / "socket_design", content["designs"]
    names = [one["name"] for one in designs]
    last = len(designs[0]["simulation"]["loads"])  # donning is the first
    held = {name: folder / f"{name}-{last}.vtu" for name in names}
    optimisation = content["optimisation"] or {}
    trials = optimisation.get("trials", ())
    return make_section(
        "socket_design",
        "The design of a socket",
        Note("A simulation for research, not a medical device: no socket here has been worn."),
        Prose(_describe_design(content)),
        draw_offset_figure(store, {name: folder / f"{name}-face.vtp" for name in names}),
        Prose(_describe_design_loads(designs)),
        draw_pressure_figures(store, held, "socket-design"),
        _make_peak_table(designs, optimisation.get("limits_kPa", {})),
        Prose(_describe_gains(optimisation)) if optimisation else None,
        _make_trial_table(optimisation) if optimisation else None,
        (
            Note(f"Simulation {number} was not made: {trial['reason']}")
            for number, trial in enumerate(trials)
            if trial["reason"]
        ),
        Prose(_describe_print(content)),
        (Note(f"{one['name']}: {text}") for one in designs for text in one["simulation"]["warnings"]),
    )


def _describe_design(content: Json) -> str:
    target, control = content["target"], content["designs"][0]
    own = ", ".join(f"{name} {value:g} kPa" for name, value in target["regions"].items())
    origin = ORIGINS.get(content["parameters_from"], content["parameters_from"])
    return (
        f"The design is the shape that the limb takes under a pressure of {target['pressure_kPa']:g} kPa "
        f"({target['pressure']}{'; ' + own if own else ''}), which follows its surface. The control has the "
        f"same volume, {control['volume_cm3']:.0f} cm3, by a uniform reduction of every circumference by "
        f"{format_fixed(control['reduction_percent'], 2)} %. Brim, distal end, liner, friction and "
        "loads are alike. "
        f"Tissues: {origin}."
    )


def _describe_design_loads(designs: Sequence[Json]) -> str:
    words = []
    for one in designs:
        loads = one["simulation"]["loads"] or [one["simulation"]["donning"]]
        settled = f", settled by {loads[-1]['settling_mm']:.1f} mm" if "settling_mm" in loads[-1] else ""
        words.append(f"{one['name']}: {max(load['peak_kPa'] for load in loads):.0f} kPa at most{settled}")
    return "; ".join(words) + "."


def _make_peak_table(designs: Sequence[Json], limits: Mapping[str, float]) -> Table:
    peaks = [(f"{one['name'].capitalize()}, peak (kPa)", one["peaks_kPa"]) for one in designs]
    peaks += [("Limit (kPa)", limits)] if limits else []
    columns: tuple[Column, ...] = (
        ("Region", "region"),
        *((head, head, 1) for head, _ in peaks),
    )
    regions = designs[0]["peaks_kPa"]
    rows = [{"region": name, **{head: peak.get(name) for head, peak in peaks}} for name in regions]
    caption = (
        "Largest pressure over one face of the mesh in each region, over all loads, held. Means and shear: "
        "results/socket_design/regions.csv."
    )
    return make_table("socket-design-regions", caption, columns, rows)


def _describe_gains(optimisation: Json) -> str:
    words = [
        f"{one['region']}: {one['control_kPa']:.0f} kPa in the control, {one['design_kPa']:.0f} designed, "
        f"{one['optimised_kPa']:.0f} optimised ({one['change_percent']:+.0f} % against the control)"
        for one in optimisation["gains"]
    ]
    beyond = ", ".join(optimisation["beyond_limits"])
    return (
        f"In {len(optimisation['trials']) - 1} simulations of {optimisation['simulations']} allowed: "
        + "; ".join(words)
        + ". "
        + (f"Beyond its limit: {beyond}." if beyond else "All other regions stay within their limits.")
    )


def _make_trial_table(optimisation: Json) -> Table:
    names = optimisation["regions"]
    columns: tuple[Column, ...] = (
        ("Simulation", "name"),
        *((f"{name}, depth (mm)", ("depths_mm", name), 2) for name in names),
        *((f"{name}, peak (kPa)", ("peaks_kPa", name), 1) for name in names),
    )
    trials = enumerate(optimisation["trials"])
    rows = [trial | {"name": number or "the design"} for number, trial in trials]
    caption = "Simulated designs: depth over each named region beside the design's, positive into the limb."
    return make_table("socket-design-trials", caption, columns, rows)


def _describe_print(content: Json) -> str:
    measured = content["wall"]
    return (
        f"For printing: results/socket_design/socket.stl, the {measured['of']} with brim and adapter face, a "
        f"closed body of {measured['volume_cm3']:.0f} cm3. Its wall of {measured['stated_mm']:g} mm measures "
        f"{measured['least_mm']:.2f} mm at least and {measured['median_mm']:.2f} mm in the median, along the "
        "face's normals."
    )
