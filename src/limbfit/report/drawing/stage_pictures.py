"""One PNG for each stage of the geometry: what to look at before going on."""

from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from matplotlib.figure import Figure as Drawing
from scipy.spatial import KDTree

from ...errors import InputError
from ...mesh import compute_dihedral_angles
from ..store import Results, load_store
from . import pictures

CUT_PLANE = "#0072b2"
# Okabe and Ito's colours, for regions of sites.
REGIONS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
THICKEST_MM = 40.0  # of the colours of tissue over bone
MESHES = 3  # how many sites' meshes are drawn
AXIS_MM, CUT_MM = 16.0, 1.5
ANGLES_DEG = (0.0, 72.0)  # the smallest dihedral angle of a regular tetrahedron is 70.5


def draw_stage(results: Path, stage: str, file: Path) -> Path:
    """Draw a stage (``surfaces``, ``sites``, ``mesh``) into a PNG file; `InputError` if results lack it."""
    store = load_store(results)
    if "skin" not in store.surface_files:
        raise InputError("no surfaces are stored", file=results, remedy="run the stage surfaces first")
    with pictures.silence_display_warning():
        draft = file.with_suffix(".part")  # the file appears when it is whole
        _SHEETS[stage](store).savefig(draft, format="png")
    draft.replace(file)
    return file


def draw_surfaces_sheet(store: Results) -> Drawing:
    """Four sides: skin translucent over the bones with the plane of the cut; and tissue in colours."""
    skin = pv.read(store.surface_files["skin"])
    plotter = pictures.make_limb_plotter(store, skin)
    plotter.add_mesh(_make_cut_plane(store, skin), color=CUT_PLANE, opacity=0.55, lighting=False)
    views = pictures.make_four_views(store, skin)
    rows = [pictures.PictureRow(pictures.render_views(plotter, views), pictures.SIDES)]
    for thickness, title in _measure_thicknesses(store, skin):
        limits = (0.0, float(min(np.ceil(np.percentile(thickness, 99)), THICKEST_MM)))
        plotter = pictures.make_field_plotter(skin.copy(), thickness, limits, **pictures.MATT)
        shots = pictures.render_views(plotter, views)
        rows.append(pictures.PictureRow(shots, ("",) * 4, (limits, title)))
    regions = [name for name in store.surface_files if name.startswith("region-")]
    named = [("skin", pictures.SKIN_SURFACE), ("bone", pictures.BONE), ("proximal cut", CUT_PLANE)]
    named += [(name.removeprefix("region-"), pictures.choose_inner_colour(name)) for name in regions]
    return pictures.build_figure_sheet("Surfaces", rows, [pictures.make_key(*one) for one in named])


def draw_sites_sheet(store: Results) -> Drawing:
    """Four sides: every site on the side that shows it, with the axis of the indenter."""
    skin = pv.read(store.surface_files["skin"])
    regions = list(dict.fromkeys(row.region or "" for row in store.sites))
    colours = {name: REGIONS[i % len(REGIONS)] for i, name in enumerate(regions)}
    plotter = pictures.make_limb_plotter(store, skin)
    for row in store.sites:
        axis, place = pictures.normalise(row.axis), np.array(row.position_mm)
        start = place - AXIS_MM * axis
        arrow = pv.Arrow(start=start, direction=axis, scale=AXIS_MM, tip_length=0.4, tip_radius=0.14)
        plotter.add_mesh(arrow, color=colours[row.region or ""], **pictures.MATT)

    def mark_facing(view: pictures.View) -> list[pictures.Mark]:
        return [
            pictures.Mark(row.site, np.array(row.position_mm), colours[row.region or ""], row.fitted)
            for row in store.sites
            if pictures.normalise(row.axis) @ view.direction > 0.35
        ]

    shots = pictures.render_views(plotter, pictures.make_four_views(store, skin), mark_facing)
    keys = [pictures.make_key(name or "no region", colour, dot=True) for name, colour in colours.items()]
    used = {row.fitted for row in store.sites}
    if len(used) == 2:
        uses = (("fitted", True), ("held out", False))
        keys += [pictures.make_key(use, "#555555", dot=True, filled=filled) for use, filled in uses]
    rows = [pictures.PictureRow(shots, pictures.SIDES)]
    return pictures.build_figure_sheet("Sites, with the axis of the indenter", rows, keys)


def draw_mesh_sheet(store: Results) -> Drawing:
    """Meshes of some sites cut through the site, near it, and how sharp their elements are."""
    names = (store.fitted or store.site_names)[:MESHES]
    angles: dict[str, Any] = {}
    colours: dict[str, str] = {}
    found = pictures.render_cut_meshes(store, names)
    for row, grid, *_ in found:
        colours |= pictures.choose_region_colours(grid)
        tets = grid.cell_connectivity.reshape(-1, 4)
        angles[row.site] = compute_dihedral_angles(np.asarray(grid.points, float), tets).min(axis=1)
    colours["wall of a bone"] = pictures.BONE
    keys = [pictures.make_key(name, colour) for name, colour in colours.items()]
    title = "Meshes, cut along the limb through the site"
    drawing = pictures.build_figure_sheet(title, pictures.make_mesh_rows(found), keys, spare_in=2.2)
    _draw_histogram(drawing, angles)
    return drawing


def _draw_histogram(drawing: Drawing, angles: dict[str, Any]) -> None:
    """The smallest dihedral angle of every element, in the spare space at the bottom of a sheet."""
    ax = drawing.subfigs[-1].subplots()
    shades = [REGIONS[i % len(REGIONS)] for i in range(len(angles))]
    values, names = list(angles.values()), list(angles)
    ax.hist(values, bins=36, range=ANGLES_DEG, histtype="step", color=shades, label=names)
    ax.set(xlim=ANGLES_DEG, xlabel="smallest dihedral angle of an element (degrees)", ylabel="elements")
    ax.legend(frameon=False, fontsize=9, title="site")
    ax.spines[["top", "right"]].set_visible(False)


def _make_cut_plane(store: Results, skin: Any) -> Any:
    assert store.surfaces is not None
    normal, point = pictures.normalise(store.surfaces.cut_normal), np.array(store.surfaces.cut_point)
    near = np.asarray(skin.points)[np.abs((skin.points - point) @ normal) < 3.0]
    centre = near.mean(axis=0) if len(near) else point
    reach = 1.12 * float(np.linalg.norm(near - centre, axis=1).max()) if len(near) else 60.0
    middle = centre - ((centre - point) @ normal) * normal
    return pv.Cylinder(center=middle, direction=normal, radius=reach, height=CUT_MM, resolution=60)


def _measure_thicknesses(store: Results, skin: Any) -> list[tuple[Any, str]]:
    """What is known on the skin: tissue down to the nearest bone, and the fat's depth where it was mapped."""
    maps = []
    bones = [pv.read(file) for name, file in store.surface_files.items() if name.startswith("bone-")]
    if bones:
        far = [np.abs(skin.compute_implicit_distance(bone)["implicit_distance"]) for bone in bones]
        maps.append((np.min(far, axis=0), "tissue over the nearest bone (mm)"))
    fat = store.folder / "surfaces" / "fat-depth.vtp"
    if fat.is_file():
        depth = pv.read(fat)
        same = KDTree(depth.points).query(skin.points)[1]  # a surface from STL numbers its vertices anew
        maps.append((np.asarray(depth.point_data["fat_depth_mm"])[same], "depth of the fat (mm)"))
    return maps


_SHEETS = {"surfaces": draw_surfaces_sheet, "sites": draw_sites_sheet, "mesh": draw_mesh_sheet}
