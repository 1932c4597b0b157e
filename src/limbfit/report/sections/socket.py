"""What a socket does to the limb: pressure and shear by region, settling, balance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..drawing.socket_pictures import inside_figure, pressure_figures, settling_figure
from ..formats import NOTHING, fixed, friction, heading, numeric
from ..page import Block, Note, Prose, Row, Section, Table
from ..store import Json, Results
from .socket_beside import interval_blocks, mostly, published_blocks

ORIGINS = {
    "identified": "identified from this limb's records",
    "literature": "those of people (medians), not of this limb",
    "given": "given by hand",
}


def socket_section(store: Results, content: Json) -> Section:
    """What the experiment ``socket`` found."""
    loads = content["loads"]
    folder = store.folder / "socket"
    names = ["donning", *(load["name"] for load in loads)]
    held = [content["donning"], *loads]
    blocks: list[Block] = [
        Note(
            "A simulation for research, not a medical device: it says what a rigid socket does to this model "
            "of the limb."
        ),
        Prose(_shape(content)),
        *(Note(f"The socket's file: {text}.") for text in content["socket"]["notes"]),
        Prose(_loads(loads)),
        *pressure_figures(store, {name: folder / f"held-{i}.vtu" for i, name in enumerate(names)}),
        settling_figure(content),
        _regions(names, held, (content.get("samples") or {}).get("simulated", 0)),
        *interval_blocks(held[-1], names[-1]),
        *published_blocks(content, held[-1], names[-1]),
        *inside_figure(store, names[-1], held[-1]["inside"], folder / f"held-{len(held) - 1}.vtu"),
        _inside(names, held),
        Prose(
            f"Sum of contact forces and moments against the stated load: within "
            f"{content['balance_percent']:.2g} % at every step. Pressures are those of contact, on the "
            "outside of the liner where there is one; a mean is the normal force over the area, a peak the "
            "largest mean over one face of the mesh, which grows as faces get smaller. The limb is at most "
            f"{content['penetration_mm']:.2f} mm in the wall."
        ),
        *(Note(text) for text in content["warnings"]),
    ]
    return Section("socket", "The limb in its socket", tuple(blocks))


def _shape(content: Json) -> str:
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
        f"inside the limb's unloaded surface. Contact is {friction(content['friction'])}; {lined}. "
        f"Tissues: {origin}."
    )


def _loads(loads: list[Json]) -> str:
    if not loads:
        return "No load was stated: the socket is donned and held."
    words = []
    for load in loads:
        size = sum(value**2 for value in load["force_N"]) ** 0.5
        known = load["settling_interval_mm"]
        limits = "" if known is None else f" (95 %: {fixed(known[0])} to {fixed(known[1])})"
        words.append(
            f"{load['name']}, {size:.0f} N: the limb settles by {load['settling_mm']:.1f} mm{limits}"
        )
    return "; ".join(words) + "."


def _regions(names: list[str], held: list[Mapping[str, Any]], draws: int) -> Table:
    head = (
        "Region",
        "Mean pressure (kPa)",
        "95 % (kPa)",
        "Mostly from",
        "Peak (kPa)",
        "Mean shear (kPa)",
        "Peak shear (kPa)",
    )
    rows = []
    for name, one in zip(names, held, strict=True):
        rows.append(Row((heading(name), *(numeric("") for _ in head[1:])), marked=True))
        for region in one["regions"]:
            known = region["interval_kPa"]
            interval = NOTHING if known is None else f"{fixed(known[0])} to {fixed(known[1])}"
            cells = [fixed(region["mean_kPa"]), interval, mostly(region["interval_from"])]
            cells += [fixed(region[key]) for key in ("peak_kPa", "shear_kPa", "shear_peak_kPa")]
            rows.append(Row((heading(region["region"]), *map(numeric, cells))))
    order = f"by derivatives and {draws} simulated draws" if draws else "to first order"
    caption = (
        "Pressure and shear by region of the limb, when donning and each load have been held. 95 %: from the "
        f"identified parameters' covariance, {order}; liner and friction count as known."
    )
    return Table("socket-regions", caption, head, tuple(rows))


def _inside(names: list[str], held: list[Mapping[str, Any]]) -> Table:
    levels = list(held[0]["inside"][0]["sheared_mm3"])
    head = (
        "Tissue",
        "Shear: largest",
        "exceeded in 1 %",
        "Compression: largest",
        "exceeded in 1 %",
        *(f"Sheared over {level} (cm3)" for level in levels),
        "Largest shear near",
    )
    rows = []
    for name, one in zip(names, held, strict=True):
        rows.append(Row((heading(name), *(numeric("") for _ in head[1:])), marked=True))
        for found in one["inside"]:
            strains = ("shear", "shear_rare", "compression", "compression_rare")
            cells = [fixed(found[key], 2) for key in strains]
            cells += [fixed(found["sheared_mm3"][level] / 1000.0, 2) for level in levels]
            row = (heading(found["tissue"]), *map(numeric, cells), numeric(found["near"] or NOTHING))
            rows.append(Row(row))
    caption = (
        "Strain inside the limb, when donning and each load have been held. Shear: half the difference of "
        "the largest and the least principal Green-Lagrange strain, compression: the least with its sign "
        "turned, both of a whole element, and what 1 % of the tissue's volume exceeds. The largest grow as "
        "elements get smaller. No limit of harm is implied."
    )
    return Table("socket-inside", caption, head, tuple(rows))
