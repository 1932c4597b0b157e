"""Pictures of the model, drawn off-screen: surfaces with sites, cut meshes, fields (figures 1, 4, 6)."""

from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from vtkmodules.vtkCommonCore import vtkLogger

from ...arrays import Array
from ...results.limb import PlacedSite
from ...web import build_patient_frame
from ..page import Figure
from ..store import Results
from ..words import make_picture, write_words
from .plots import PANEL_WIDTH_IN, make_figure, styled

PAPER, INK = "#f6f5f1", "#222222"
FIELD_MAP = "viridis"


@dataclass(frozen=True)
class View:
    """A parallel projection: ``direction`` is where the camera looks, ``size`` is in pixels."""

    focal: Array
    direction: Array
    up: Array
    half_height_mm: float
    size: tuple[int, int]

    @property
    def right(self) -> Array:
        return np.cross(self.direction, self.up)

    @property
    def pixels_per_mm(self) -> float:
        return self.size[1] / (2 * self.half_height_mm)

    def project(self, points: Array) -> Array:
        """Pixels (n, 2), the origin at the top left, of points (n, 3) in mm."""
        offset = np.atleast_2d(points) - self.focal
        axes = np.column_stack([self.right, -self.up])
        return offset @ axes * self.pixels_per_mm + np.array(self.size) / 2


@dataclass(frozen=True)
class Mark:
    """A point of a picture with its name; ``axis`` (into the limb) is drawn as an arrow when given."""

    text: str
    position: Array
    color: str
    filled: bool = True
    axis: Array | None = None


Shot = tuple[Array, View, list[Mark]]


_DPI, _PANEL_IN = 110, 4.6  # height of a row of panels
_PAGE_DPI = 200  # of the pictures within a page's drawings
_AXIS_MM = 14.0
_HALO = [withStroke(linewidth=2.5, foreground=PAPER)]
_SIDES = (("L", "R"), ("P", "A"), ("S", "I"))  # towards which an axis of patient space points, and from which


@dataclass(frozen=True)
class PictureRow:
    """Panels side by side under their titles; a colour bar beside them where ``bar`` has limits and title."""

    shots: Sequence[Shot]
    titles: Sequence[str]
    bar: tuple[tuple[float, float], str] | None = None
    colours: str = FIELD_MAP


def make_key(text: str, color: str, dot: bool = False, filled: bool = True) -> Patch | Line2D:
    """An entry of a legend: a patch, or a dot (``filled`` or open) where ``dot``."""
    if not dot:
        return Patch(facecolor=color, edgecolor=INK, linewidth=0.4, label=text)
    return Line2D([], [], ls="", marker="o", mfc=color if filled else "white", mec=color, ms=8, label=text)


def build_figure_sheet(
    title: str,
    rows: Sequence[PictureRow],
    keys: Sequence[Patch | Line2D],
    spare_in: float = 0.0,
    max_width_in: float = np.inf,
) -> Drawing:
    """Rows of pictures on one sheet with a title and a legend; every picture has a scale and its sides.

    ``spare_in`` inches above the legend are left free: the last of the drawing's ``subfigs``.
    """
    shares = [[view.size[0] / view.size[1] for _, view, _ in row.shots] for row in rows]
    margin = 0.9 if any(row.bar for row in rows) else 0.1
    panel = min(_PANEL_IN, (max_width_in - margin) / max(map(sum, shares)))
    heights = [panel] * len(rows) + [spare_in] * (spare_in > 0)
    size = (panel * max(map(sum, shares)) + margin, sum(heights) + 0.9)
    drawing = Drawing(figsize=size, dpi=_DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(drawing)
    if title:
        drawing.suptitle(title, x=0.01, ha="left", fontsize=13)
    parts = drawing.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for part, row, ratios in zip(parts, rows, shares, strict=False):
        axes = part.subplots(1, len(ratios), squeeze=False, width_ratios=ratios)[0]
        for ax, (pixels, view, marks), name in zip(axes, row.shots, row.titles, strict=True):
            _draw_panel(ax, pixels, view, marks, name)
        if row.bar is not None:
            shades = ScalarMappable(Normalize(*row.bar[0]), row.colours)
            bar = part.colorbar(shades, ax=axes, label=row.bar[1], fraction=0.02, shrink=0.8, pad=0.01)
            bar.solids.set(rasterized=False, edgecolor="face")  # or seams show in a drawing of vectors
    if keys:
        handles = list(keys)
        drawing.legend(handles=handles, loc="outside lower left", ncols=len(keys), frameon=False, fontsize=10)
    return drawing


@styled
def make_picture_figure(
    name: str,
    rows: Sequence[PictureRow],
    keys: Sequence[Patch | Line2D] = (),
    *,
    words: str = "",
    **facts: Any,
) -> Figure:
    """Rows of pictures with a legend as a figure of the page; words and facts are as for `make_figure`."""
    drawing = build_figure_sheet("", rows, keys, max_width_in=PANEL_WIDTH_IN)
    drawing.patch.set_alpha(0)
    drawing.set_dpi(_PAGE_DPI)
    return make_figure(drawing, name, words=words, **facts)


def _draw_panel(ax: Axes, pixels: Array, view: View, marks: list[Mark], title: str) -> None:
    w, h = view.size
    ax.imshow(pixels, extent=(0, w, h, 0), interpolation="antialiased")
    ax.set(xlim=(0, w), ylim=(h, 0), xticks=[], yticks=[])
    ax.set_title(title, fontsize=10, loc="left", pad=3)
    for spine in ax.spines.values():
        spine.set_visible(False)
    for mark, name_y in _place_labels(view, marks):
        x, y = view.project(mark.position)[0]
        face = mark.color if mark.filled else PAPER
        ax.plot(x, y, "o", ms=6, mfc=face, mec=mark.color, mew=1.4)
        if mark.axis is not None:
            x, name_y = view.project(mark.position - _AXIS_MM * mark.axis)[0]
            tip = view.project(mark.position)[0]
            arrow = {"arrowstyle": "-|>", "color": mark.color, "lw": 1.6, "shrinkA": 0, "shrinkB": 3}
            ax.annotate("", xy=(tip[0], tip[1]), xytext=(x, name_y), arrowprops=arrow)
        ax.text(x + 0.014 * h, name_y, mark.text, fontsize=10, va="center", color=INK, path_effects=_HALO)
    right = np.array([view.right, -view.up])
    for (dx, dy), direction in zip(((1, 0), (0, 1)), right, strict=True):
        axis = int(np.abs(direction).argmax())  # of LPS: the letter is that of the side of the body
        for sign in (1, -1):
            x, y = (0.5 + sign * dx * 0.475) * w, (0.5 + sign * dy * 0.478) * h
            side = _SIDES[axis][0 if sign * direction[axis] > 0 else 1]
            ax.text(x, y, side, fontsize=9, ha="center", va="center", color="#5a5a5a")
    length = next(mm for mm in (50, 20, 10, 5) if mm * view.pixels_per_mm < 0.4 * w)
    end, base = 0.97 * w, 0.965 * h
    ax.plot([end - length * view.pixels_per_mm, end], [base, base], color=INK, lw=2)
    ax.text(end, base - 0.012 * h, f"{length} mm", fontsize=9, ha="right", va="bottom", color=INK)


def _place_labels(view: View, marks: Sequence[Mark]) -> list[tuple[Mark, float]]:
    """Marks from top to bottom, with the heights (pixels) at which their names do not touch."""
    placed: list[tuple[float, float]] = []
    found = []
    line = 0.036 * view.size[1]
    for mark in sorted(marks, key=lambda m: float(view.project(m.position)[0, 1])):
        x, y = (float(v) for v in view.project(mark.position)[0])
        while any(abs(y - py) < line and abs(x - px) < line * (1 + len(mark.text)) for px, py in placed):
            y += line / 8
        placed.append((x, y))
        found.append((mark, y))
    return found


SKIN, MUSCLE, BONE = "#e3c878", "#c8717a", "#e9e6dc"
BETWEEN = ("#7d6a2e", "#f7efce", "#4a6472")  # layers between the outermost and the core
SKIN_SURFACE = "#d9a07c"
MATT: dict[str, Any] = {"ambient": 0.35, "diffuse": 0.75, "specular": 0.0}
FITTED, HELD_OUT = "#0072b2", "#d55e00"
SIDES = ("anterior view", "left view", "posterior view", "right view")
MARKER_COLOUR_MM = 4.0  # the height of a skin marker in the image
FIELDS = (
    ("von_mises_kPa", "von Mises stress (kPa)"),
    ("displacement_mm", "displacement (mm)"),
    ("J", "volume ratio J (–)"),
)
Grid = Any  # a pyvista data set; what its stubs promise differs between its releases


def normalise(values: Iterable[float]) -> Array:
    v = np.asarray(tuple(values), dtype=float)
    return v / np.linalg.norm(v)


def read_limb_frame(store: Results) -> Array:
    """Rows: patient's left, posterior and proximal direction, the last one along the limb."""
    return build_patient_frame(store.surfaces.cut_normal if store.surfaces else None)


@contextmanager
def silence_display_warning() -> Iterator[None]:
    """VTK warns on the terminal that there is no display before it draws without one, as it should."""
    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)


def render_view(plotter: Any, view: View) -> Array:
    """The picture (rows, columns, 3) of what the plotter holds, seen by a view."""
    camera = plotter.camera
    camera.parallel_projection = True
    camera.focal_point = tuple(view.focal)
    camera.position = tuple(view.focal - 2000.0 * view.direction)
    camera.up = tuple(view.up)
    camera.parallel_scale = view.half_height_mm
    plotter.render_window.SetSize(*view.size)
    plotter.renderer.ResetCameraClippingRange()
    plotter.render()
    return np.asarray(plotter.screenshot(return_img=True))


def make_plotter() -> Any:
    plotter: Any = pv.Plotter(off_screen=True, lighting="light kit")
    plotter.set_background(PAPER)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def make_limb_plotter(store: Results, skin: Any) -> Any:
    """The translucent skin with what is inside: bones, and regions of soft tissue in another colour."""
    plotter = make_plotter()
    plotter.enable_depth_peeling(8)
    plotter.add_mesh(skin, color=SKIN_SURFACE, opacity=0.36, smooth_shading=True, **MATT)
    for name, file in store.surface_files.items():
        if name != "skin":
            plotter.add_mesh(pv.read(file), color=choose_inner_colour(name), **MATT)
    return plotter


def choose_inner_colour(name: str) -> str:
    """The colour of a surface inside the skin, by the name of its file."""
    return BONE if name.startswith("bone-") else BETWEEN[0]


def render_views(
    plotter: Any, views: Sequence[View], marks: Callable[[View], list[Mark]] = lambda view: []
) -> list[Shot]:
    """The pictures of what the plotter holds, each with its marks; the plotter is closed."""
    shots = [(render_view(plotter, view), view, marks(view)) for view in views]
    plotter.close()
    return shots


def make_field_plotter(
    mesh: Any, values: Any, limits: tuple[float, float], colours: str = FIELD_MAP, **surface: Any
) -> Any:
    """A surface coloured by values or a stored field, without shading, so that colours can be read off."""
    plotter = make_plotter()
    style = surface or {"lighting": False}
    plotter.add_mesh(mesh, scalars=values, clim=limits, cmap=colours, show_scalar_bar=False, **style)
    return plotter


@silence_display_warning()
def draw_surface_figure(store: Results) -> Figure | None:
    """The limb from four sides: skin translucent, bones and regions inside, sites named where they show."""
    if "skin" not in store.surface_files:
        return None
    skin = pv.read(store.surface_files["skin"])
    views = make_four_views(store, skin)
    shots = render_views(make_limb_plotter(store, skin), views, lambda view: _mark_facing_sites(store, view))
    return make_picture_figure("model", [PictureRow(shots, SIDES)], names=store.site_names)


@silence_display_warning()
def draw_marker_figure(store: Results) -> Figure | None:
    """Figure 1: the skin of the image with markers, coloured by its distance from the skin without them."""
    marked_file, plain_file = store.folder / "segment" / "skin-markers.stl", store.surface_files.get("skin")
    if plain_file is None or not marked_file.is_file():
        return None
    plain = pv.read(plain_file)
    marked = pv.read(marked_file).compute_implicit_distance(plain)
    limits = (0.0, float(np.ceil(MARKER_COLOUR_MM)))
    plotter = make_field_plotter(marked, "implicit_distance", limits, **MATT)
    shots = render_views(plotter, make_four_views(store, plain), lambda view: _mark_facing_sites(store, view))
    return make_picture_figure("markers", [PictureRow(shots, SIDES, (limits, "distance (mm)"))])


def draw_slices_figure(store: Results) -> Figure | None:
    """The stored picture of outlines over slices, and what its slices to look at are."""
    file = store.folder / "segment" / "quality.png"
    if not file.is_file():
        return None
    picture, words = b64encode(file.read_bytes()).decode("ascii"), escape(write_words("figure slices"))
    markup = f'<img src="data:image/png;base64,{picture}" alt="{words}" style="width:100%">'
    return make_picture("slices", markup)


def make_four_views(store: Results, skin: Any) -> list[View]:
    """Views of the whole limb, in the order of ``SIDES``."""
    return make_side_views(read_limb_frame(store), skin)


def make_side_views(frame: Array, skin: Any) -> list[View]:
    """Views of a surface, in the order of ``SIDES``; rows of the frame: its left, posterior and proximal."""
    left, back, up = frame
    points = (np.asarray(skin.points) - skin.center) @ np.array([left, back, up]).T
    half = np.abs(points).max(axis=0) * 1.06 + 4
    width = 2 * max(half[0], half[1]) + 8
    size = (round(1000 * width / (2 * half[2])), 1000)
    return [View(np.array(skin.center), side, up, half[2], size) for side in (back, -left, -back, left)]


def _mark_facing_sites(store: Results, view: View) -> list[Mark]:
    """The sites whose skin faces the camera of a view."""
    return [_mark_site(row) for row in store.sites if normalise(row.axis) @ view.direction > 0.5]


def _mark_site(row: PlacedSite, axis: bool = False) -> Mark:
    color = FITTED if row.fitted else HELD_OUT
    position, direction = np.array(row.position_mm), normalise(row.axis) if axis else None
    return Mark(row.site, position, color, row.fitted, direction)


@silence_display_warning()
def draw_mesh_figure(store: Results, sites: Sequence[str]) -> Figure | None:
    """Figures 4 and 6: whole meshes of some sites cut through the site, and the refinement near it."""
    found = render_cut_meshes(store, sites)
    if not found:
        return None
    names = [row.site for row, *_ in found]
    colours = {name: colour for _, grid, *_ in found for name, colour in choose_region_colours(grid).items()}
    paper = {"skin": "skin–adipose layer", "muscle": "muscle–soft tissue"}
    words = paper if tuple(colours) == tuple(paper) else {name: name for name in colours}
    keys = [make_key(words[name], colour) for name, colour in colours.items()]
    keys.append(make_key("wall of a bone", BONE))
    return make_picture_figure("mesh-cut", make_mesh_rows(found), keys, names=names, regions=list(colours))


def make_mesh_rows(cut_meshes: Sequence[tuple[PlacedSite, Grid, Shot, Shot]]) -> list[PictureRow]:
    """Whole meshes that :func:`render_cut_meshes` gave, and below them what is near the indenter."""
    titles = [f"site {row.site}" for row, *_ in cut_meshes]
    return [
        PictureRow([whole for _, _, whole, _ in cut_meshes], titles),
        PictureRow([near for *_, near in cut_meshes], [f"{title}, near the indenter" for title in titles]),
    ]


def render_cut_meshes(store: Results, sites: Sequence[str]) -> list[tuple[PlacedSite, Grid, Shot, Shot]]:
    """Sites with their meshes: the whole mesh, cut through the site, and what is near it, with its axis."""
    found = []
    for row, file in find_placed_meshes(store, sites, "mesh"):
        grid, views = read_linear(file), make_cut_views(store, row, file)
        plotter = make_plotter()
        add_regions(plotter, cut_behind(grid, views[0]))
        marks = [_mark_site(row, axis=True)]
        whole, near = ((pixels, view, marks) for pixels, view, _ in render_views(plotter, views))
        found.append((row, grid, whole, near))
    return found


@silence_display_warning()
def draw_field_figure(store: Results, sites: Sequence[str], stage: str, name: str) -> Figure | None:
    """The deformed cut of some sites at the largest indentation, coloured by what is stored."""
    grids = [(row, file, read_linear(file)) for row, file in find_placed_meshes(store, sites, stage)]
    stored = {name for _, _, grid in grids for name in grid.array_names}
    field = next(((name, title) for name, title in FIELDS if name in stored), None)
    if field is None or "displacement_mm" not in stored:
        return None
    views = [make_cut_views(store, row, file)[1] for row, file, _ in grids]
    cuts = [cut_behind(grid, view, smooth=True) for view, (_, _, grid) in zip(views, grids, strict=True)]
    limits = _find_colour_limits(cuts, views, field[0])
    shots = [render_field(cut, view, field[0], limits) for view, cut in zip(views, cuts, strict=True)]
    names = [row.site for row, _, _ in grids]
    pictures = PictureRow(shots, [f"site {name}" for name in names], (limits, field[1]))
    return make_picture_figure(name, [pictures], words="field", title=field[1], names=names)


def render_field(cut: Grid, view: View, field: str, limits: tuple[float, float]) -> Shot:
    """A deformed cut, coloured by a field."""
    surface = cut.warp_by_vector("displacement_mm").extract_surface(algorithm="dataset_surface")
    return render_views(make_field_plotter(surface, field, limits), [view])[0]


def find_placed_meshes(store: Results, sites: Sequence[str], stage: str) -> list[tuple[PlacedSite, Path]]:
    """Sites with a place and a stored mesh."""
    rows = store.placed_sites
    files = [(rows[name], store.vtu(stage, name)) for name in sites if name in rows]
    return [(row, file) for row, file in files if file is not None]


def read_linear(file: Path) -> Grid:
    """The stored mesh with straight-edged tetrahedra, which draw much faster.

    Made by hand: VTK's linear copy keeps the mid-edge nodes in the connectivity, and cutting it crashes.
    """
    grid = pv.read(file)
    width = 10 if grid.celltypes[0] == pv.CellType.QUADRATIC_TETRA else 4
    corners, tets = np.unique(grid.cell_connectivity.reshape(-1, width)[:, :4], return_inverse=True)
    plain = pv.UnstructuredGrid({pv.CellType.TETRA: tets.reshape(-1, 4)}, grid.points[corners])
    for name in grid.point_data.keys():  # noqa: SIM118 - not a dictionary
        plain.point_data[name] = grid.point_data[name][corners]
    for name in grid.cell_data.keys():  # noqa: SIM118
        plain.cell_data[name] = grid.cell_data[name]
    plain.field_data["region_names"] = grid.field_data["region_names"]
    return plain


def make_cut_views(store: Results, row: PlacedSite, file: Path) -> tuple[View, View]:
    """The whole limb and the neighbourhood of a site, seen at right angles to the cut through it."""
    up = read_limb_frame(store)[2]
    axis = normalise(row.axis)
    normal = normalise(np.cross(axis, up)) if abs(axis @ up) < 0.98 else read_limb_frame(store)[0]
    whole = make_whole_view(np.asarray(pv.read(file).points), normal, up, margin_mm=30)
    close = View(np.array(row.position_mm) + 14 * axis, normal, up, 34.0, (700, 700))
    return whole, close


def make_whole_view(points: Array, normal: Array, up: Array, margin_mm: float) -> View:
    """All of some points (n, 3), with a margin beside them, cut through their middle."""
    height, middle = points @ up, points.mean(axis=0)
    half = float(np.ptp(height)) / 2 * 1.05
    centre = middle + ((height.max() + height.min()) / 2 - middle @ up) * up
    reach = float(np.abs((points - centre) @ np.cross(normal, up)).max()) + margin_mm
    return View(centre, normal, up, half, (round(900 * reach / half), 900))


def cut_behind(grid: Grid, view: View, smooth: bool = False) -> Grid:
    """What lies behind the plane through the middle of the view: whole cells, or cut through."""
    if smooth:
        return grid.clip(normal=tuple(view.direction), origin=tuple(view.focal), invert=False)
    centres = np.asarray(grid.cell_centers().points)
    return grid.extract_cells(np.flatnonzero((centres - view.focal) @ view.direction > 0))


def add_regions(plotter: Any, grid: Grid) -> None:
    regions = np.asarray(grid.cell_data["region"])
    for index, colour in enumerate(choose_region_colours(grid).values()):
        part = grid.extract_cells(np.flatnonzero(regions == index))
        if part.n_cells:
            surface = part.extract_surface(algorithm="dataset_surface")
            bone = _find_bone_wall(surface)
            for chosen, color in ((~bone, colour), (bone, BONE)):
                faces = surface.extract_cells(np.flatnonzero(chosen))
                if faces.n_cells:
                    edges = {"show_edges": True, "edge_color": "#4a2f2f", "line_width": 1.5}
                    plotter.add_mesh(faces, color=color, **edges, **MATT)


def choose_region_colours(grid: Grid) -> dict[str, str]:
    """The colour of each region: layers, outermost first, what is inside the core, and the core."""
    names = [str(name) for name in grid.field_data["region_names"]]
    between = [BETWEEN[i % len(BETWEEN)] for i in range(len(names) - 2)]
    return dict(zip(names, [SKIN, *between, MUSCLE], strict=False))


def _find_bone_wall(surface: Grid) -> NDArray[np.bool_]:
    """Which triangles of a region's surface are the wall of a bone void."""
    if "in fixed_bone" not in surface.point_data:
        return np.zeros(surface.n_cells, dtype=bool)
    triangles = np.asarray(surface.faces).reshape(-1, 4)[:, 1:]
    return np.asarray(surface.point_data["in fixed_bone"])[triangles].all(axis=1)


def _find_colour_limits(cuts: Sequence[Grid], views: Sequence[View], field: str) -> tuple[float, float]:
    """Colour limits shared by all pictures: percentiles of what they show, so that a corner does not rule."""
    shown = []
    for cut, view in zip(cuts, views, strict=True):
        where = cut.points if field in cut.point_data else cut.cell_centers().points
        values = np.asarray(cut[field], dtype=float)
        visible = np.linalg.norm(np.asarray(where) - view.focal, axis=1) < view.half_height_mm
        shown.append((np.linalg.norm(values, axis=1) if values.ndim == 2 else values)[visible])
    low, high = np.percentile(np.concatenate(shown), [1, 99])
    return float(low), float(max(high, low + 1e-9))
