"""One PNG for each stage of the geometry: what to look at before going on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from scipy.spatial import KDTree

from ...errors import InputError
from ...mesh import dihedral_angles
from ..store import Json, Results, load_store
from .panels import FIELD_MAP, Drawing, Key, Mark, PictureRow, Shot, View, sheet, write_png
from .pictures import (
    BONE,
    MATT,
    SIDES,
    SKIN_SURFACE,
    add_inner,
    add_regions,
    cut_views,
    drawable,
    far_side,
    four_sides,
    inner_colour,
    linear,
    new_plotter,
    region_colours,
    shoot,
    unit,
    without_display_warning,
)

CUT_PLANE = "#0072b2"
# Okabe and Ito's colours, for regions of sites.
REGIONS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
THICKEST_MM = 40.0  # of the colours of tissue over bone
MESHES = 3  # how many sites' meshes are drawn
AXIS_MM, CUT_MM = 16.0, 1.5
ANGLES_DEG = (0.0, 72.0)  # the smallest dihedral angle of a regular tetrahedron is 70.5


def draw_stage(results: Path, stage: str, file: Path) -> Path:
    """Draw what a finished stage made into a PNG file; its path.

    Parameters
    ----------
    results : the results folder of a study.
    stage : ``surfaces``, ``sites`` or ``mesh``.

    Raises
    ------
    InputError
        When the stage has not been done.
    """
    store = load_store(results)
    if "skin" not in store.surface_files:
        raise InputError("no surfaces are stored", file=results, remedy="run the stage surfaces first")
    with without_display_warning():
        write_png(_SHEETS[stage](store), file)
    return file


def surfaces_sheet(store: Results) -> Drawing:
    """Four sides: skin translucent over the bones with the plane of the cut; and tissue in colours."""
    skin = pv.read(store.surface_files["skin"])
    plotter = _limb_plotter(store, skin)
    plotter.add_mesh(_cut_plane(store, skin), color=CUT_PLANE, opacity=0.55, lighting=False)
    views = four_sides(store, skin)
    rows = [PictureRow(_shots(plotter, views), SIDES)]
    for thickness, title in _thicknesses(store, skin):
        limits = (0.0, float(min(np.ceil(np.percentile(thickness, 99)), THICKEST_MM)))
        plotter = new_plotter()
        plotter.add_mesh(
            skin.copy(), scalars=thickness, clim=limits, cmap=FIELD_MAP, show_scalar_bar=False, **MATT
        )
        rows.append(PictureRow(_shots(plotter, views), ("",) * 4, (limits, title)))
    regions = [name for name in store.surface_files if name.startswith("region-")]
    keys = [Key("skin", SKIN_SURFACE), Key("bone", BONE), Key("proximal cut", CUT_PLANE)]
    keys += [Key(name.removeprefix("region-"), inner_colour(name)) for name in regions]
    return sheet("Surfaces", rows, keys)


def sites_sheet(store: Results) -> Drawing:
    """Four sides: every site on the side that shows it, with the axis of the indenter."""
    skin = pv.read(store.surface_files["skin"])
    regions = list(dict.fromkeys(str(row.get("region") or "") for row in store.sites))
    colours = {name: REGIONS[i % len(REGIONS)] for i, name in enumerate(regions)}
    plotter = _limb_plotter(store, skin)
    for row in store.sites:
        axis, place = unit(row["axis"]), np.array(row["position_mm"])
        arrow = pv.Arrow(
            start=place - AXIS_MM * axis, direction=axis, scale=AXIS_MM, tip_length=0.4, tip_radius=0.14
        )
        plotter.add_mesh(arrow, color=colours[str(row.get("region") or "")], **MATT)
    shots = []
    for view in four_sides(store, skin):
        seen = [row for row in store.sites if unit(row["axis"]) @ view.direction > 0.35]
        marks = [_site_mark(row, colours) for row in seen]
        shots.append((shoot(plotter, view), view, marks))
    plotter.close()
    keys = [Key(name or "no region", colour, dot=True) for name, colour in colours.items()]
    used = {bool(row.get("fitted")) for row in store.sites}
    if len(used) == 2:
        keys += [Key("fitted", "#555555", True), Key("held out", "#555555", True, filled=False)]
    return sheet("Sites, with the axis of the indenter", [PictureRow(shots, SIDES)], keys)


def mesh_sheet(store: Results) -> Drawing:
    """Meshes of some sites cut through the site, near it, and how sharp their elements are."""
    names = (store.fitted or store.site_names)[:MESHES]
    whole: list[Shot] = []
    near: list[Shot] = []
    angles: dict[str, Any] = {}
    colours: dict[str, str] = {}
    for row, file in drawable(store, names, "mesh"):
        grid = linear(file)
        colours |= region_colours(grid)
        plotter = new_plotter()
        view, close = cut_views(store, row, file)
        add_regions(plotter, far_side(grid, view))
        mark = Mark(str(row["site"]), np.array(row["position_mm"]), CUT_PLANE, True, unit(row["axis"]))
        whole.append((shoot(plotter, view), view, [mark]))
        near.append((shoot(plotter, close), close, [mark]))
        plotter.close()
        tets = grid.cell_connectivity.reshape(-1, 4)
        angles[str(row["site"])] = dihedral_angles(np.asarray(grid.points, float), tets).min(axis=1)
    titles = [f"site {name}" for name in angles]
    keys = [Key(name, colour) for name, colour in (colours | {"wall of a bone": BONE}).items()]
    drawing = sheet(
        "Meshes, cut along the limb through the site",
        [PictureRow(whole, titles), PictureRow(near, [f"{title}, near the indenter" for title in titles])],
        keys,
        spare_in=2.2,
    )
    _histogram(drawing, angles)
    return drawing


def _histogram(drawing: Drawing, angles: dict[str, Any]) -> None:
    """The smallest dihedral angle of every element, in the spare space at the bottom of a sheet."""
    height = drawing.get_figheight()
    ax = drawing.add_axes((0.09, 0.95 / height, 0.86, 1.35 / height))
    shades = [REGIONS[i % len(REGIONS)] for i in range(len(angles))]
    ax.hist(
        list(angles.values()), bins=36, range=ANGLES_DEG, histtype="step", color=shades, label=list(angles)
    )
    ax.set(xlim=ANGLES_DEG, xlabel="smallest dihedral angle of an element (degrees)", ylabel="elements")
    ax.legend(frameon=False, fontsize=9, title="site")
    ax.spines[["top", "right"]].set_visible(False)


def _limb_plotter(store: Results, skin: Any) -> Any:
    """The translucent skin with the bones inside."""
    plotter = new_plotter()
    plotter.enable_depth_peeling(8)
    plotter.add_mesh(skin, color=SKIN_SURFACE, opacity=0.36, smooth_shading=True, **MATT)
    add_inner(plotter, store.surface_files)
    return plotter


def _shots(plotter: Any, views: Sequence[View]) -> list[Shot]:
    shots: list[Shot] = [(shoot(plotter, view), view, []) for view in views]
    plotter.close()
    return shots


def _cut_plane(store: Results, skin: Any) -> Any:
    normal, point = unit(store.surfaces["cut_normal"]), np.array(store.surfaces["cut_point"])
    near = np.asarray(skin.points)[np.abs((skin.points - point) @ normal) < 3.0]
    centre = near.mean(axis=0) if len(near) else point
    reach = 1.12 * float(np.linalg.norm(near - centre, axis=1).max()) if len(near) else 60.0
    return pv.Cylinder(
        center=centre - ((centre - point) @ normal) * normal,
        direction=normal,
        radius=reach,
        height=CUT_MM,
        resolution=60,
    )


def _thicknesses(store: Results, skin: Any) -> list[tuple[Any, str]]:
    """What is known on the skin: tissue down to the nearest bone, and the fat's depth where it was mapped."""
    found = []
    bones = [pv.read(file) for name, file in store.surface_files.items() if name.startswith("bone-")]
    if bones:
        far = [np.abs(skin.compute_implicit_distance(bone)["implicit_distance"]) for bone in bones]
        found.append((np.min(far, axis=0), "tissue over the nearest bone (mm)"))
    fat = store.folder / "surfaces" / "fat-depth.vtp"
    if fat.is_file():
        depth = pv.read(fat)
        same = KDTree(depth.points).query(skin.points)[1]  # a surface from STL numbers its vertices anew
        found.append((np.asarray(depth.point_data["fat_depth_mm"])[same], "depth of the fat (mm)"))
    return found


def _site_mark(row: Json, colours: dict[str, str]) -> Mark:
    colour = colours[str(row.get("region") or "")]
    return Mark(str(row["site"]), np.array(row["position_mm"]), colour, bool(row.get("fitted")))


_SHEETS = {"surfaces": surfaces_sheet, "sites": sites_sheet, "mesh": mesh_sheet}
