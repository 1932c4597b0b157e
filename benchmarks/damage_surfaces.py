"""Ways to damage surface files."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyvista as pv
from damage import Inputs, Whole, kind

from limbfit.anatomy.surfaces.surfaces import Surface

Random = np.random.Generator
SUFFIXES = (".stl", ".ply", ".obj", ".vtp")
Surfaces = dict[str, Surface]


def surfaces(whole: Whole) -> Surfaces:
    return {"skin": whole.anatomy.skin, **whole.anatomy.bones}


def written(random: Random, folder: Path, found: Surfaces, suffix: str = "", stated: str = "") -> Inputs:
    suffix = suffix or str(random.choice(SUFFIXES))
    for name, surface in found.items():
        save(surface.to_pyvista(), folder / f"{name}{suffix}")
    bones = {name: f"{name}{suffix}" for name in found if name != "skin"}
    return Inputs(surfaces=(f"skin{suffix}", bones), stated=stated)


def save(poly: pv.PolyData, file: Path) -> None:
    """As it is: pyvista would turn faces of STL and PLY, and VTK's writer of OBJ rounds to six digits."""
    if file.suffix != ".obj":
        poly.save(file, recompute_normals=False)
        return
    points = "\n".join(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in poly.points)
    faces = "\n".join(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in poly.regular_faces)
    file.write_text(f"{points}\n{faces}\n")


def spoiled(
    random: Random, whole: Whole, folder: Path, how: Callable[[Surface], Surface], suffix: str = ""
) -> Inputs:
    """All surfaces, one of them spoiled."""
    found = surfaces(whole)
    name = str(random.choice(list(found)))
    return written(random, folder, found | {name: how(found[name])}, suffix)


@kind("surfaces", "same")
def surfaces_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    return written(random, folder, surfaces(whole))


@kind("surfaces", "same")
def surfaces_in_ras(random: Random, whole: Whole, folder: Path) -> Inputs:
    sign = np.array([-1.0, -1.0, 1.0])
    found = {name: replace(s, points=s.points * sign) for name, s in surfaces(whole).items()}
    return written(random, folder, found, stated='coordinates = "RAS"')


def header(file: Path, space: str) -> None:
    content = file.read_bytes()
    file.write_bytes(f"3D Slicer output. SPACE={space}".encode().ljust(80) + content[80:])


@kind("surfaces", "same")
def surfaces_say_ras(random: Random, whole: Whole, folder: Path) -> Inputs:
    sign = np.array([-1.0, -1.0, 1.0])
    found = {name: replace(s, points=s.points * sign) for name, s in surfaces(whole).items()}
    inputs = written(random, folder, found, ".stl")
    for name in found:
        header(folder / f"{name}.stl", "RAS")
    return inputs


@kind("surfaces", "refused", "the study says")
def spaces_contradict(random: Random, whole: Whole, folder: Path) -> Inputs:
    file, study = ("LPS", "RAS") if random.random() < 0.5 else ("RAS", "LPS")
    inputs = written(random, folder, surfaces(whole), ".stl", f'coordinates = "{study}"')
    for name in surfaces(whole):
        header(folder / f"{name}.stl", file)
    return inputs


@kind("surfaces", "refused")
def spaces_mixed(random: Random, whole: Whole, folder: Path) -> Inputs:
    """Skin and bones in different spaces: bones outside the skin."""
    sign = np.array([-1.0, -1.0, 1.0])
    found = surfaces(whole)
    return written(
        random, folder, found | {"skin": replace(found["skin"], points=found["skin"].points * sign)}
    )


def scaled(factor: float, whole: Whole) -> Surfaces:
    return {name: replace(s, points=s.points / factor) for name, s in surfaces(whole).items()}


UNITS = {"cm": 10.0, "m": 1000.0, "inch": 25.4}


@kind("surfaces", "refused", "surfaces.unit")
def other_unit(random: Random, whole: Whole, folder: Path) -> Inputs:
    return written(random, folder, scaled(UNITS[str(random.choice(list(UNITS)))], whole))


@kind("surfaces", "refused")
def bone_in_other_unit(random: Random, whole: Whole, folder: Path) -> Inputs:
    name = str(random.choice(list(whole.anatomy.bones)))
    small = scaled(UNITS[str(random.choice(list(UNITS)))], whole)
    return written(random, folder, surfaces(whole) | {name: small[name]})


@kind("surfaces", "same")
def stated_unit(random: Random, whole: Whole, folder: Path) -> Inputs:
    unit = str(random.choice(list(UNITS)))
    return written(random, folder, scaled(UNITS[unit], whole), stated=f'unit = "{unit}"')


@kind("surfaces", "either", within_mm=5.0)
def holes(random: Random, whole: Whole, folder: Path) -> Inputs:
    def opened(surface: Surface) -> Surface:
        keep = np.ones(len(surface.faces), bool)
        keep[random.integers(0, len(keep), random.integers(1, 40))] = False
        return replace(surface, faces=surface.faces[keep])

    return spoiled(random, whole, folder, opened)


@kind("surfaces", "refused", "inward")
def inside_out(random: Random, whole: Whole, folder: Path) -> Inputs:
    return spoiled(random, whole, folder, lambda surface: surface.flipped_surface)


@kind("surfaces", "repaired", "looked inward and were turned")
def some_faces_flipped(random: Random, whole: Whole, folder: Path) -> Inputs:
    def flipped(surface: Surface) -> Surface:
        faces = surface.faces.copy()
        some = random.integers(0, len(faces), random.integers(1, 40))
        faces[some] = faces[some][:, ::-1]
        return replace(surface, faces=faces)

    return spoiled(random, whole, folder, flipped)


@kind("surfaces", "refused", "crosses itself")
def self_intersecting(random: Random, whole: Whole, folder: Path) -> Inputs:
    """A point pushed through the other side."""

    def dented(surface: Surface) -> Surface:
        points = surface.points.copy()
        n = random.integers(len(points))
        across = points[n] - surface.vertex_normals[n] * np.ptp(points, axis=0).max()
        points[n] = points[n] + random.uniform(0.8, 1.5) * (across - points[n])
        return replace(surface, points=points)

    return spoiled(random, whole, folder, dented)


@kind("surfaces", "refused", "separate bodies")
def two_bodies(random: Random, whole: Whole, folder: Path) -> Inputs:
    def doubled(surface: Surface) -> Surface:
        points = np.concatenate([surface.points, surface.points + np.array([900.0, 0, 0])])
        return Surface(points, np.concatenate([surface.faces, surface.faces + len(surface.points)]))

    return spoiled(random, whole, folder, doubled)


@kind("surfaces", "refused", "more than two faces")
def doubled_faces(random: Random, whole: Whole, folder: Path) -> Inputs:
    def doubled(surface: Surface) -> Surface:
        some = surface.faces[random.integers(0, len(surface.faces), random.integers(1, 20))]
        return replace(surface, faces=np.concatenate([surface.faces, some]))

    return spoiled(random, whole, folder, doubled)


@kind("surfaces", "refused")
def points_not_numbers(random: Random, whole: Whole, folder: Path) -> Inputs:
    def spoil(surface: Surface) -> Surface:
        points = surface.points.copy()
        points[random.integers(0, len(points), random.integers(1, 10))] = random.choice([np.nan, np.inf])
        return replace(surface, points=points)

    return spoiled(random, whole, folder, spoil)


@kind("surfaces", "refused")
def surface_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    inputs = written(random, folder, surfaces(whole))
    assert inputs.surfaces is not None
    files = [inputs.surfaces[0], *inputs.surfaces[1].values()]
    file = folder / str(random.choice(files))
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * random.uniform(0.0, 0.97))])
    return inputs


@kind("surfaces", "refused", "outside the skin")
def bone_moved_out(random: Random, whole: Whole, folder: Path) -> Inputs:
    found = surfaces(whole)
    name = str(random.choice([bone for bone in found if bone != "skin"]))
    direction = np.cross(whole.anatomy.cut_normal, random.normal(size=3))
    shift = direction / np.linalg.norm(direction) * random.uniform(120, 300)
    moved = replace(found[name], points=found[name].points + shift)
    return written(random, folder, found | {name: moved})


@kind("surfaces", "refused")
def not_a_surface(random: Random, whole: Whole, folder: Path) -> Inputs:
    inputs = written(random, folder, surfaces(whole))
    assert inputs.surfaces is not None
    content = [b"", b"a note about J. Doe\n", bytes(random.integers(0, 256, 3000, dtype=np.uint8))]
    (folder / inputs.surfaces[0]).write_bytes(content[random.integers(3)])
    return inputs


@kind("surfaces", "same")
def ascii_stl(random: Random, whole: Whole, folder: Path) -> Inputs:
    inputs = written(random, folder, surfaces(whole), ".stl")
    for name, surface in surfaces(whole).items():
        surface.to_pyvista().save(folder / f"{name}.stl", binary=False, recompute_normals=False)
    return inputs


@kind("surfaces", "same")
def empty_faces(random: Random, whole: Whole, folder: Path) -> Inputs:
    """Faces with two equal corners, as exporters leave them: they vanish when points are merged."""

    def more(surface: Surface) -> Surface:
        some = surface.faces[random.integers(0, len(surface.faces), random.integers(1, 20))].copy()
        some[:, 1] = some[:, 0]
        return replace(surface, faces=np.concatenate([surface.faces, some]))

    return spoiled(random, whole, folder, more)
