"""Which records to make in a session, and what they would determine."""

from __future__ import annotations

from ..formats import fixed, heading, label, numeric
from ..page import Block, Bullets, Cell, Prose, Row, Section, Table
from ..store import Json, Results
from .design import expected_figure, factor

SEEN = {
    "ultrasound_sd_mm": "Ultrasound through the indenter reads every tissue's thickness to {:g} mm",
    "surface_sd_mm": "Cameras read the displacement of the skin around the indenter to {:g} mm",
    "shear_waves_sd_m_s": "Elastography reads the speed of shear waves in every tissue to {:g} m/s",
}


def protocol_section(store: Results, content: Json) -> Section:
    """What the experiment ``protocol`` found."""
    draws = len(content["draws"])
    meaning = {"D": "the smallest joint region of confidence", "A": "the smallest sum of variances"}
    wanted = ", ".join(map(label, content["determine"]))
    if content.get("pressures"):
        wanted = "the logarithms of the mean pressures of the socket's regions"
    words = Prose(
        f"The records that fit into {fixed(content['minutes'], 0)} min and have, on average over {draws} "
        f"tissues that the limb may have, {meaning[content['criterion']]} for "
        f"{wanted}. The first of the tissues is the "
        f"{content['parameters_from']}. Every site with another indenter takes {content['setup_s']:g} s to "
        f"prepare, every record {content['rest_s']:g} s of rest. In short: {content['verdict']}."
    )
    seen = [said.format(content[key]) for key, said in SEEN.items() if content.get(key) is not None]
    if seen:
        told = ", ".join(seen)
        words = Prose(f"{words.text} {told}, but for the plain ramps and the protocol by force alone.")
    figure = expected_figure("protocols", content["protocols"], "the records of a protocol")
    blocks: list[Block] = [words, _records(content), _protocols(content), figure]
    if content.get("pressures"):
        blocks.append(_pressures(content))
    if content["left_out"]:
        blocks.append(Bullets(tuple(f"{text}." for text in content["left_out"])))
    return Section("protocol", "Which records to make", tuple(blocks))


def _records(content: Json) -> Table:
    keys = (("depth_mm", 1), ("speed_mm_s", 2), ("hold_s", 0), ("peak_force_N", 1))
    rows = tuple(
        Row((heading(row["site"]), Cell(row["indenter"]), *(numeric(fixed(row[k], n)) for k, n in keys)))
        for row in content["records"]
    )
    head = ("Site", "Indenter", "Depth (mm)", "Speed (mm/s)", "Hold (s)", "Largest force (N)")
    return Table("protocol-records", "The designed protocol; forces at the first tissue.", head, rows)


def _protocols(content: Json) -> Table:
    names = list(content["protocols"][0]["factor_95"])
    rows = tuple(
        Row(
            (
                heading(row["design"]),
                numeric(str(row["records"])),
                numeric(fixed(row["minutes"], 0)),
                numeric(str(row["determined"])),
                *(numeric(factor(row["factor_95"][name])) for name in names),
            ),
            marked=k == 0,
        )
        for k, row in enumerate(content["protocols"])
    )
    head = ("Protocol", "Records", "Minutes", "Determined within 25 %", *map(label, names))
    caption = (
        "What each protocol would determine: for each parameter the factor f of the 95 % interval to be "
        "expected (value / f to value × f), the middle one of the tissues. The rows below the first "
        "do without one ingredient, in the same time."
    )
    return Table("protocols", caption, head, rows)


def _pressures(content: Json) -> Table:
    rows = tuple(
        Row(
            (
                heading(name),
                *(numeric(fixed(100.0 * (row["pressures_95"][name] - 1.0))) for row in content["protocols"]),
            )
        )
        for name in content["pressures"]
    )
    head = ("Load, region", *(f"{row['design']} (± %)" for row in content["protocols"]))
    caption = (
        "The 95 % interval to be expected of each mean pressure, by the tissue alone: to first order, with "
        "the derivatives that the socket's simulation stored."
    )
    return Table("protocol-pressures", caption, head, rows)
