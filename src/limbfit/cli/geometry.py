"""The verbs that run a study until a stage of the geometry, and show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.table import Table

import limbfit

from .commands import StudyPath
from .console import STDOUT, AsJson, listen_on_console, print_json


def segment(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the label map; list tissues and volumes."""
    show(study, "segment", show_labels, as_json)


def surfaces(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the surfaces; list closed bodies, volumes and the thinnest tissue over each bone."""
    show(study, "surfaces", show_surfaces, as_json)


def sites(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the sites; list their places on the skin and the markers found there."""
    show(study, "sites", show_sites, as_json)


def mesh(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the meshes; list their size, angles and what was trimmed."""
    show(study, "mesh", show_meshes, as_json)


def show(study: StudyPath, stage: str, tell: Callable[[dict[str, Any]], None], as_json: bool) -> None:
    """Do a stage, tell of it, and say where its picture is."""
    with listen_on_console() as listener:
        found = limbfit.show_stage(limbfit.load_study(study), stage, listener=listener)
    if as_json:
        print_json(found)
        return
    tell(found)
    if found["picture"]:
        print_line(f"picture: {found['picture']}")


def print_line(text: str) -> None:
    STDOUT.print(text, soft_wrap=True)


def show_labels(found: dict[str, Any]) -> None:
    volumes = ", ".join(f"{name} {value:.1f}" for name, value in found["volumes_cm3"].items())
    print_line(f"{found['method']}; volumes in cm3: {volumes}")
    for repair in found.get("repairs", ()):
        print_line(f"repaired: {repair}")
    for warning in found.get("warnings", ()):
        print_line(f"warning: {warning}")
    if "markers_removed" in found:
        print_line(f"markers taken off the skin: {found['markers_removed']}")
    if "motion" in found:
        motion = found["motion"]
        print_line(
            f"between the images the limb moved by {motion['shift_mm']:.1f} mm and {motion['turn_deg']:.1f} "
            f"degrees (correlation {motion['correlation']:.2f})"
        )
    print_line(f"labels: {found['labels']}")


def show_surfaces(found: dict[str, Any]) -> None:
    table = build_table("body", "volume (cm3)", "triangles", "thinnest tissue (mm)", "at (LPS mm)")
    for name, volume in found["volumes_cm3"].items():
        thinnest = found["thinnest_mm"].get(name)
        where = (f"{thinnest['tissue_mm']:.1f}", format_point(thinnest["at"])) if thinnest else ("", "")
        table.add_row(name, f"{volume:.1f}", str(found["triangles"][name]), *where)
    STDOUT.print(table)
    print_line(
        f"{found['closed_bodies']} closed bodies; proximal cut through {format_point(found['cut_point'])}"
    )
    if found["amputation"]:
        ends = found["amputation"]["beyond_plane_mm"].items()
        print_line(
            "amputated; ends beyond the plane (mm): " + ", ".join(f"{name} {end:.1f}" for name, end in ends)
        )


def show_sites(found: dict[str, Any]) -> None:
    head = ("site", "region", "used", "at (LPS mm)", "off skin", "marker", "from 'near'")
    table = build_table(*head)
    for site in found["sites"]:
        marker = site["marker"]
        evidence = ("", "")
        if marker:
            evidence = (f"{marker['height_mm']:.1f} mm", f"{marker['distance_to_hint_mm']:.1f} mm")
        used = "fitted" if site["fitted"] else "held out"
        off = f"{site['off_skin_mm']:.2f} mm"
        table.add_row(site["site"], site["region"], used, format_point(site["position_mm"]), off, *evidence)
    STDOUT.print(table)


def show_meshes(found: dict[str, Any]) -> None:
    head = ("site", "nodes", "elements", "least angle", "layers (mm)", "trimmed bone (cm3)")
    table = build_table(*head)
    for name, row in found["sites"].items():
        trimmed = ", ".join(
            f"{bone} {cut['volume_mm3'] / 1000:.2f}" for bone, cut in row["trimmed_bone"].items()
        )
        layers = f"{row['layer_mean_mm']:.2f} +- {row['layer_std_mm']:.2f}"
        angle = f"{row['min_dihedral_deg']:.1f} deg"
        table.add_row(name, str(row["nodes"]), str(row["cells"]), angle, layers, trimmed or "none")
    STDOUT.print(table)
    for name, row in found["sites"].items():
        for warning in row["warnings"]:
            print_line(f"warning: site {name}: {warning}")


def build_table(*head: str) -> Table:
    """A table whose cells do not wrap but for regions and lists of bones, which may be long."""
    table = Table(box=None)
    for name in head:
        table.add_column(name, no_wrap=name not in {"region", "trimmed bone (cm3)"})
    return table


def format_point(position: Sequence[float]) -> str:
    return ", ".join(f"{value:.1f}" for value in position)


VERBS = (segment, surfaces, sites, mesh)
