"""A socket designed from pressures, beside its control: offsets, pressures, regions, how it was optimised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..drawing.socket_pictures import offset_figure, pressure_figures
from ..formats import NOTHING, fixed, heading, numeric
from ..page import Block, Note, Prose, Row, Section, Table
from ..store import Json, Results
from .socket import ORIGINS


def socket_design_section(store: Results, content: Json) -> Section:
    """What the experiment ``socket_design`` found."""
    folder, designs = store.folder / "socket_design", content["designs"]
    names = [one["name"] for one in designs]
    last = len(designs[0]["simulation"]["loads"])  # donning is the first
    optimisation = content["optimisation"]
    offset = offset_figure(store, {name: folder / f"{name}-face.vtp" for name in names})
    blocks: list[Block] = [
        Note("A simulation for research, not a medical device: no socket here has been worn."),
        Prose(_made(content)),
        *([] if offset is None else [offset]),
        Prose(_loaded(designs)),
        *pressure_figures(store, {name: folder / f"{name}-{last}.vtu" for name in names}, "socket-design"),
        _regions(designs, (optimisation or {}).get("limits_kPa", {})),
    ]
    if optimisation is not None:
        blocks += [Prose(_gained(optimisation)), _trials(optimisation)]
        blocks += [
            Note(f"Simulation {number} was not made: {trial['reason']}")
            for number, trial in enumerate(optimisation["trials"])
            if trial["reason"]
        ]
    blocks.append(Prose(_printed(content)))
    blocks += [Note(f"{one['name']}: {text}") for one in designs for text in one["simulation"]["warnings"]]
    return Section("socket_design", "The design of a socket", tuple(blocks))


def _made(content: Json) -> str:
    target, control = content["target"], content["designs"][0]
    own = ", ".join(f"{name} {value:g} kPa" for name, value in target["regions"].items())
    origin = ORIGINS.get(content["parameters_from"], content["parameters_from"])
    return (
        f"The design is the shape that the limb takes under a pressure of {target['pressure_kPa']:g} kPa "
        f"({target['pressure']}{'; ' + own if own else ''}), which follows its surface. The control has the "
        f"same volume, {control['volume_cm3']:.0f} cm3, by a uniform reduction of every circumference by "
        f"{fixed(control['reduction_percent'], 2)} %. Brim, distal end, liner, friction and loads are alike. "
        f"Tissues: {origin}."
    )


def _loaded(designs: Sequence[Json]) -> str:
    words = []
    for one in designs:
        loads = one["simulation"]["loads"] or [one["simulation"]["donning"]]
        settled = f", settled by {loads[-1]['settling_mm']:.1f} mm" if "settling_mm" in loads[-1] else ""
        words.append(f"{one['name']}: {max(load['peak_kPa'] for load in loads):.0f} kPa at most{settled}")
    return "; ".join(words) + "."


def _regions(designs: Sequence[Json], limits: Mapping[str, float]) -> Table:
    head = ["Region", *(f"{one['name'].capitalize()}, peak (kPa)" for one in designs)]
    if limits:
        head.append("Limit (kPa)")
    rows = []
    for name in designs[0]["peaks_kPa"]:
        cells = [one["peaks_kPa"].get(name) for one in designs]
        cells += [limits.get(name)] if limits else []
        rows.append(Row((heading(name), *(numeric(NOTHING if c is None else fixed(c)) for c in cells))))
    caption = (
        "Largest pressure over one face of the mesh in each region, over all loads, held. Means and shear: "
        "results/socket_design/regions.csv."
    )
    return Table("socket-design-regions", caption, tuple(head), tuple(rows))


def _gained(optimisation: Json) -> str:
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


def _trials(optimisation: Json) -> Table:
    names = optimisation["regions"]
    head = (
        "Simulation",
        *(f"{name}, depth (mm)" for name in names),
        *(f"{name}, peak (kPa)" for name in names),
    )
    rows = []
    for number, trial in enumerate(optimisation["trials"]):
        peaks = trial["peaks_kPa"] or {}
        depths = [fixed(trial["depths_mm"][name], 2) for name in names]
        cells = [*depths, *(fixed(peaks.get(name)) for name in names)]
        rows.append(Row((heading(str(number) if number else "the design"), *map(numeric, cells))))
    caption = "Simulated designs: depth over each named region beside the design's, positive into the limb."
    return Table("socket-design-trials", caption, head, tuple(rows))


def _printed(content: Json) -> str:
    measured = content["wall"]
    return (
        f"For printing: results/socket_design/socket.stl, the {measured['of']} with brim and adapter face, a "
        f"closed body of {measured['volume_cm3']:.0f} cm3. Its wall of {measured['stated_mm']:g} mm measures "
        f"{measured['least_mm']:.2f} mm at least and {measured['median_mm']:.2f} mm in the median, along the "
        "face's normals."
    )
