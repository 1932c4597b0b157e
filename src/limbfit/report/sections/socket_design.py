"""A socket designed from pressures, beside its control: offsets, pressures, regions, how it was optimised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ...results.socket import SocketDesignResult
from ..drawing.socket_pictures import draw_offset_figure, draw_pressure_figures
from ..formats import format_fixed
from ..page import Note, Prose, Section, Table, make_section
from ..store import Json, Results
from ..tables import Column, make_table
from .socket import ORIGINS


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
        Prose(_describe_loads(designs)),
        draw_pressure_figures(store, held, "socket-design"),
        _make_region_table(designs, optimisation.get("limits_kPa", {})),
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


def _describe_loads(designs: Sequence[Json]) -> str:
    words = []
    for one in designs:
        loads = one["simulation"]["loads"] or [one["simulation"]["donning"]]
        settled = f", settled by {loads[-1]['settling_mm']:.1f} mm" if "settling_mm" in loads[-1] else ""
        words.append(f"{one['name']}: {max(load['peak_kPa'] for load in loads):.0f} kPa at most{settled}")
    return "; ".join(words) + "."


def _make_region_table(designs: Sequence[Json], limits: Mapping[str, float]) -> Table:
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
