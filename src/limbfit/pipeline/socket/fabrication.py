"""A socket for the shop: its wall, slices and trim line, and a check sheet, in the folder ``shop``."""

from pathlib import Path

import numpy as np
from jinja2 import StrictUndefined, Template

from ...anatomy.surfaces.exchange import list_circumferences
from ...anatomy.surfaces.files import write_surface
from ...anatomy.surfaces.slices import format_slices
from ...anatomy.surfaces.triangles import Surface
from ...errors import InputError
from ...results.shapes import ShopPackage
from ...socket import Socket
from ..engine.store import write_table
from .shape import find_covered_regions
from .simulation import SocketLimb

FOLDER, SHEET = "shop", "check-sheet.html"
TEMPLATE = Path(__file__).parent / "check-sheet.html.j2"


def write_shop_package(folder: Path, limb: SocketLimb, face: Socket, wall: Surface) -> ShopPackage:
    """Write the files of a socket's face and wall around a limb; what they hold, and measures to check."""
    shop, axis, outside = folder / FOLDER, limb.anatomy.cut_normal, face.surface.flipped_surface
    shop.mkdir(exist_ok=True)
    write_surface(shop / "wall.stl", wall)
    trim = face.points[face.brim]
    write_table(shop / "trim-line.csv", ["x_mm", "y_mm", "z_mm"], trim.tolist())
    files = {"wall.stl": "the wall, as a closed body", "trim-line.csv": "the trim line, a closed curve"}
    left_out, deviation = list[str](), None
    try:
        write_surface(shop / "wall.3mf", wall)
        files["wall.3mf"] = "the wall, with its unit"
    except InputError as error:
        left_out.append(str(error))
    try:
        slices, deviation = format_slices(outside, axis, (limb.study.socket.side or "none").upper())
        (shop / "shape.aop").write_text(slices, encoding="ascii")
        files["shape.aop"] = "the shape inside, as slices; above the trim line it goes on straight"
    except InputError as error:
        left_out.append(f"shape.aop: {error}")
    at = face.offset(limb.outer.skin)[face.faces].mean(axis=1)
    middles = face.surface.triangles.mean(axis=1)
    covered = find_covered_regions(middles, limb.anatomy.skin, limb.regions, face)
    package = ShopPackage(
        files=files | {SHEET: "circumferences, volumes and depths, to check what was made"},
        left_out=left_out,
        aop_deviation_mm=deviation,
        trim_line_mm=np.linalg.norm(trim - np.roll(trim, 1, axis=0), axis=1).sum(),
        volumes_cm3=(limb.outer.skin.volume / 1000.0, face.volume_mm3 / 1000.0),
        circumferences=list_circumferences(limb.outer.skin, outside, axis),
        depths_mm={name: (at[mask].mean(), at[mask].min(), at[mask].max()) for name, mask in covered.items()},
    )
    text = TEMPLATE.read_text(encoding="utf-8")
    sheet = Template(text, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    content = sheet.render(package=package, axis=axis, wall=limb.study.socket.design.wall_mm)
    (shop / SHEET).write_text(content, encoding="utf-8")
    return package
