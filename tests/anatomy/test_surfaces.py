"""Surfaces: measures, files, what may not pass, and from labels to a closed limb."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv
from scipy.spatial import cKDTree

from limbfit.anatomy.imaging import LabelMap, Volume, read_volume
from limbfit.anatomy.surfaces.extraction import extract_fine_surface, untangle_surface
from limbfit.anatomy.surfaces.surfaces import (
    Anatomy,
    Surface,
    build_anatomy,
    check_anatomy,
    check_closed,
    extract_surface,
    load_anatomy,
    read_surface,
    save_anatomy,
    write_surface,
)
from limbfit.anatomy.surfaces.triangles import from_pyvista, stack_surfaces
from limbfit.errors import LabelError, SurfaceError
from limbs import DIRECTIONS, Leg, grid, leg_image, rotation, write_dicom


def ball(radius: float = 50.0, centre=(10.0, -20.0, 30.0)) -> Surface:
    """A closed sphere, outward."""
    return from_pyvista(pv.Icosphere(radius=radius, center=centre, nsub=3)).outward_surface


def test_measures_of_a_box():
    surface = from_pyvista(pv.Box((0, 100, 0, 50, 0, 20)).triangulate()).outward_surface
    assert surface.volume == pytest.approx(100 * 50 * 20)
    assert surface.area == pytest.approx(2 * (5000 + 2000 + 1000))
    away = surface.points + np.array([1e4, -1e4, 1e4])
    assert Surface(away, surface.faces).volume == pytest.approx(surface.volume, rel=1e-9)


def test_vertex_normals_point_outward():
    surface = ball(centre=(0, 0, 0))
    assert np.einsum("ij,ij->i", surface.vertex_normals, surface.points / 50).min() > 0.999


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtp", ".obj"])
def test_round_trip_through_files_keeps_coordinates_far_from_the_origin(tmp_path, suffix):
    surface = ball(centre=(822.3, -975.7, -1390.9))
    write_surface(tmp_path / f"ball{suffix}", surface)
    back = read_surface(tmp_path / f"ball{suffix}")
    assert len(back.points) == len(surface.points)
    assert back.volume == pytest.approx(surface.volume, rel=1e-5)
    assert cKDTree(surface.points).query(back.points)[0].max() < 0.001
    check_closed(back, "skin")


def centroid(surface: Surface) -> np.ndarray:
    """Centre of the enclosed volume."""
    corner = surface.points.mean(axis=0)
    triangles = surface.triangles - corner
    volumes = np.linalg.det(triangles) / 6
    return corner + (volumes @ triangles.sum(axis=1)) / 4 / volumes.sum()


def opened(surface):
    return replace(surface, faces=surface.faces[5:])


def with_inner_wall(surface):
    fan = [[surface.faces[0][0], surface.faces[0][1], len(surface.points)]]
    for a, b in ((1, 2), (2, 0)):
        fan.append([surface.faces[0][a], surface.faces[0][b], len(surface.points)])
    points = np.vstack([surface.points, surface.points.mean(axis=0)])
    return Surface(points, np.vstack([surface.faces, fan, [[f[1], f[0], f[2]] for f in fan]]))


def half_flipped(surface):
    faces = surface.faces.copy()
    faces[::2] = faces[::2, ::-1]
    return replace(surface, faces=faces)


def doubled(surface):
    return stack_surfaces([surface, replace(surface, points=surface.points + np.array([200.0, 0, 0]))])


def dented_through(surface):
    points = surface.points.copy()
    points[np.argmax(points[:, 2])] -= [3.0, 5.0, 120.0]
    return replace(surface, points=points)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (opened, "open, .* edges have a face on one side only.*close its holes"),
        (lambda s: s.flipped_surface, "inverted.*flip the normals"),
        (with_inner_wall, "more than two faces"),
        (half_flipped, "oriented against"),
        (doubled, "2 separate bodies"),
        (dented_through, r"crosses itself \(\d+ pairs of faces, the first at \(.*\) mm\)"),
        (lambda s: Surface(s.points / 1000, s.faces), "metres.*millimetres"),
        (lambda s: Surface(s.points * 1000, s.faces), "millimetres"),
    ],
)
def test_damaged_surfaces_are_refused_with_a_remedy(damage, expected):
    check_closed(ball(), "skin")
    with pytest.raises(SurfaceError, match=expected) as caught:
        check_closed(damage(ball()), "skin", "skin.stl")
    assert str(caught.value).startswith("skin.stl")


def test_files_that_hold_no_surface_are_refused(tmp_path):
    (tmp_path / "words.stl").write_text("not a surface")
    (tmp_path / "words.xyz").write_text("not a surface")
    for name in ("words.stl", "words.xyz", "none.stl"):
        with pytest.raises(SurfaceError, match=name):
            read_surface(tmp_path / name)
    points = ball()
    nan = points.points.copy()
    nan[3] = np.nan
    write_surface(tmp_path / "nan.vtp", Surface(nan, points.faces))
    with pytest.raises(SurfaceError, match="not numbers"):
        read_surface(tmp_path / "nan.vtp")


def scatter_triangles(seed: int, large: int) -> np.ndarray:
    """Corners (20, 3, 3) of triangles in a box of 10 mm: some right across it, the others of 1 mm."""
    random = np.random.default_rng(seed)
    across = random.uniform(0, 10, size=(large, 3, 3))
    small = random.uniform(3, 7, size=(20 - large, 1, 3)) + random.uniform(-0.8, 0.8, size=(20 - large, 3, 3))
    return np.concatenate([across, small])


@pytest.mark.parametrize(("seed", "large"), [(3, 20), (4, 6), (5, 3)])
def test_self_intersections_agree_with_testing_every_pair(seed, large):
    """Also where a few faces are so large, as in a scan's cap, that they are looked for in pieces."""
    points = scatter_triangles(seed, large).reshape(-1, 3)
    surface = Surface(points, np.arange(60).reshape(-1, 3))
    fast = {tuple(sorted(pair)) for pair in surface.self_intersections}
    slow = set()
    for i in range(20):
        for j in range(i + 1, 20):
            one = pv.PolyData.from_regular_faces(points[3 * i : 3 * i + 3], [[0, 1, 2]])
            other = pv.PolyData.from_regular_faces(points[3 * j : 3 * j + 3], [[0, 1, 2]])
            if one.collision(other)[1] > 0:
                slow.add((i, j))
    assert fast == slow
    assert len(slow) > 1


def sphere_labels(radius: float, spacing: list[float], seed: int) -> tuple[LabelMap, np.ndarray]:
    shape = tuple((np.ceil(2 * radius / np.array(spacing)) + 8).astype(int)[::-1])
    labels = grid(shape, spacing, rotation(seed))
    centre = labels.index_to_point((np.array(labels.size) - 1) / 2 + [0.2, -0.3, 0.4])
    i, j, k = np.meshgrid(*[np.arange(n) for n in labels.size], indexing="ij")
    points = labels.index_to_point(np.stack([i, j, k], -1).transpose(2, 1, 0, 3))
    return labels.with_array((np.linalg.norm(points - centre, axis=-1) < radius) * 2), centre


@pytest.mark.parametrize(
    ("radius", "spacing"),
    [(20.0, [1.2, 1.15, 1.0]), (20.0, [0.5, 0.5, 3.0]), (24.0, [2.3, 2.3, 2.0])],
)
def test_sphere_from_labels(radius, spacing):
    labels, centre = sphere_labels(radius, spacing, seed=8)
    surface = extract_surface(labels, "tibia", 3.0)
    check_closed(surface, "tibia")
    error = np.linalg.norm(surface.points - centre, axis=1) - radius
    assert surface.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    assert np.sqrt(np.mean(error**2)) < 0.15 * max(spacing)
    assert np.abs(centroid(surface) - centre).max() < 0.02 * max(spacing)


def test_edges_have_the_length_that_was_asked_for():
    labels, _ = sphere_labels(14.0, [1.5, 1.5, 1.5], seed=2)
    for edge in (2.0, 4.0):
        triangles = extract_surface(labels, "tibia", edge).triangles
        lengths = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
        assert lengths.mean() == pytest.approx(edge, rel=0.1)


@pytest.mark.parametrize("edge", [2.0, 6.0])
def test_smoothing_and_coarse_triangles_keep_the_volume(edge):
    labels, _ = sphere_labels(12.0, [1.5, 1.5, 1.5], seed=3)
    volume = labels.mask("tibia").sum() * labels.voxel_mm3
    assert extract_fine_surface(labels, "tibia", edge).volume == pytest.approx(volume, rel=1e-3)
    assert extract_surface(labels, "tibia", edge).volume == pytest.approx(volume, rel=1e-3)


def test_folded_triangles_are_untangled():
    surface = ball(centre=(0, 0, 0))
    points = surface.points.copy()
    first, second = points[0], points[np.argsort(np.linalg.norm(points - points[0], axis=1))[12]]
    points[0] = first + 1.3 * (second - first)  # beyond its neighbours: their triangles lie over others
    folded = Surface(points, surface.faces)
    assert len(folded.self_intersections) > 0
    mended = untangle_surface(folded)
    assert len(mended.self_intersections) == 0
    assert np.median(np.linalg.norm(mended.points - surface.points, axis=1)) == 0
    assert np.abs(np.linalg.norm(mended.points, axis=1) - 50).max() < 3


def test_only_the_largest_body_is_kept():
    labels, _ = sphere_labels(20.0, [2, 2, 2], seed=2)
    array = labels.array.copy()
    array[:2, :2, :2] = 2
    assert extract_surface(labels.with_array(array), "tibia").volume == pytest.approx(33510, rel=0.02)


def test_nothing_to_extract_is_said():
    labels, _ = sphere_labels(20.0, [2, 2, 2], seed=2)
    with pytest.raises(LabelError, match="'fibula'"):
        extract_surface(labels, "fibula")
    with pytest.raises(LabelError, match=r"no label is named 'hoof'.*tibia"):
        extract_surface(labels, "hoof")


@pytest.fixture(scope="module")
def leg() -> LabelMap:
    return leg_image([2.5, 2.5, 3.0], (52, 48, 48), DIRECTIONS["oblique"])[1]


@pytest.fixture(scope="module")
def anatomy(leg) -> Anatomy:
    return build_anatomy(leg, 5.0)


def test_anatomy_is_closed_flat_at_the_cut_and_open_to_the_bones(leg, anatomy):
    check_anatomy(anatomy)
    height = anatomy.height(anatomy.skin.points)
    cap = np.abs(height) < 1e-3
    assert height.max() < 1e-3
    # The cap is the whole section of the leg, 2 mm inside the image's last slice, with a sharp rim.
    face_in_cap = cap[anatomy.skin.faces].all(axis=1)
    radius = 46 + 0.05 * (51 / 2 * 3.0 + 1.5 - 2)
    assert anatomy.skin.face_areas[face_in_cap].sum() == pytest.approx(np.pi * radius**2, rel=0.02)
    assert np.allclose(anatomy.cut_normal, leg.direction[:, 2])
    end = leg.index_to_point([0, 0, 51.5])
    assert (end - anatomy.cut_point) @ anatomy.cut_normal == pytest.approx(2.0)
    assert set(anatomy.bones) == {"tibia", "fibula"}
    for bone in anatomy.bones.values():
        assert 3 < anatomy.height(bone.points).max() < 9


def test_anatomy_has_the_legs_shape(leg, anatomy):
    centre = leg.index_to_point((np.array(leg.size) - 1) / 2)
    for name, surface in [("skin", anatomy.skin), *anatomy.bones.items()]:
        below = surface.points[anatomy.height(surface.points) < -3]
        p = (below - centre) @ leg.direction
        depth = Leg().limb(p) if name == "skin" else Leg().bone(name, p)
        side = p[:, 2] > -35  # bones end flat, with edges that smoothing rounds
        assert np.sqrt(np.mean(depth[side] ** 2)) < 0.25 * 2.5, name  # a quarter of a voxel


def test_a_given_cut_is_kept(leg):
    point, normal = leg.index_to_point([24, 24, 33]), leg.direction @ np.array([0.1, -0.1, 1.0])
    cut = build_anatomy(leg, 8.0, (point, 3 * normal))
    assert np.allclose(cut.cut_normal, normal / np.linalg.norm(normal))
    assert cut.height(cut.skin.points).max() == pytest.approx(0, abs=1e-3)
    assert all(cut.height(bone.points).max() > 2 for bone in cut.bones.values())
    check_anatomy(cut)
    with pytest.raises(SurfaceError, match="misses the limb"):
        build_anatomy(leg, 5.0, (point + 500 * normal, normal))


def test_a_bone_that_the_cut_leaves_in_two_pieces_is_refused():
    """Of a femur that is cut through its condyles one would be soft tissue."""
    z, y, x = 4.0 * (np.indices((36, 28, 28)) - np.array([0.0, 13.5, 13.5])[:, None, None, None])
    limb, two = np.hypot(x, y) < 46.0, np.hypot(np.abs(x) - 18.0, y) < 12.0
    shaft = (np.abs(x) < 30.0) & (np.abs(y) < 12.0) & (z > 80.0)
    array = np.where(limb, 1, 0) + np.where((two & (z > 40.0)) | shaft, 3, 0)
    labels = LabelMap(array, [4.0] * 3, [0.0, 0.0, 0.0], np.eye(3))
    with pytest.raises(LabelError, match=r"'femur' is cut into pieces of 12 and 12 cm3; .*or move the cut"):
        build_anatomy(labels, 6.0, ([54.0, 54.0, 70.0], [0.0, 0.0, 1.0]))


def test_a_cut_without_a_direction_is_refused(anatomy):
    with pytest.raises(SurfaceError, match="normal of the plane is zero"):
        replace(anatomy, cut_normal=[0, 0, 0])


def test_the_proximal_end_is_found_along_every_axis_and_sense(leg):
    flipped = LabelMap(
        leg.array[::-1].transpose(1, 0, 2),
        leg.spacing[[0, 2, 1]],
        leg.index_to_point([0, 0, 51]),
        np.column_stack([leg.direction[:, 0], -leg.direction[:, 2], leg.direction[:, 1]]),
    )
    again = build_anatomy(flipped, 8.0)
    assert np.allclose(again.cut_normal, leg.direction[:, 2])
    assert (leg.index_to_point([0, 0, 51.5]) - again.cut_point) @ again.cut_normal == pytest.approx(2.0)


def test_a_limb_cut_off_by_the_images_side_is_refused(leg):
    with pytest.raises(LabelError, match="side of the image"):
        build_anatomy(leg.with_array(leg.array[:, :, 16:]), 5.0)


def test_a_bone_outside_the_skin_is_refused(anatomy):
    out = dict(anatomy.bones)
    far = 40 * np.cross(anatomy.cut_normal, [1.0, 0, 0])
    out["tibia"] = Surface(out["tibia"].points + far, out["tibia"].faces)
    with pytest.raises(SurfaceError, match=r"tibia lies outside the skin.*RAS"):
        check_anatomy(replace(anatomy, bones=out))
    out["tibia"] = Surface(anatomy.bones["tibia"].points + 400 * anatomy.cut_normal, out["tibia"].faces)
    with pytest.raises(SurfaceError, match="beyond the proximal cut"):
        check_anatomy(replace(anatomy, bones=out))


def test_saved_anatomy_comes_back(tmp_path, anatomy):
    save_anatomy(tmp_path, anatomy)
    back = load_anatomy(tmp_path)
    check_anatomy(back)
    assert list(back.bones) == list(anatomy.bones)
    assert np.allclose(back.cut_point, anatomy.cut_point)
    assert np.allclose(back.cut_normal, anatomy.cut_normal)
    assert back.skin.volume == pytest.approx(anatomy.skin.volume, rel=1e-5)
    for one, other in ((back.skin, anatomy.skin), (back.bones["tibia"], anatomy.bones["tibia"])):
        assert cKDTree(other.points).query(one.points)[0].max() < 0.01
    (tmp_path / "surfaces.json").write_text("{}")
    with pytest.raises(SurfaceError, match=r"surfaces\.json"):
        load_anatomy(tmp_path)
    shutil.rmtree(tmp_path)
    with pytest.raises(SurfaceError):
        load_anatomy(tmp_path)


@pytest.mark.parametrize("name", ["flipped rows", "permuted"])
def test_a_physical_point_survives_from_dicom_to_stl(tmp_path, name):
    """A slab of tissue whose faces lie at known places, through DICOM, labels, surface and STL."""
    empty = grid((24, 30, 32), [2.0, 2.0, 2.5], DIRECTIONS[name])
    array = np.zeros(empty.array.shape)
    array[4:20, 5:25, 6:26] = 800
    image = Volume(array, *empty.geometry)
    write_dicom(tmp_path / "dicom", image)
    back = read_volume(tmp_path / "dicom")
    labels = LabelMap(back.array > 400, *back.geometry)
    write_surface(tmp_path / "slab.stl", extract_surface(labels, None, 2.5))
    surface = read_surface(tmp_path / "slab.stl")
    # The middles of the slab's faces, half a voxel outside its outermost voxels, in the image as it was made.
    middle = np.array([15.5, 14.5, 11.5])
    for axis, ends in enumerate(((5.5, 25.5), (4.5, 24.5), (3.5, 19.5))):
        for end in ends:
            index = middle.copy()
            index[axis] = end
            expected = image.index_to_point(index)
            along = image.direction[:, axis] * np.sign(end - middle[axis])
            near = surface.points[np.linalg.norm(surface.points - expected, axis=1) < 6]
            assert ((near - expected) @ along).mean() == pytest.approx(0, abs=0.15)
    assert centroid(surface) == pytest.approx(image.index_to_point(middle), abs=0.01)


def test_the_limb_goes_on_beyond_a_given_cut_and_not_at_its_other_end():
    """An arm that is held up: both ends reach the image's border, and the lower one is proximal."""
    j, i = np.mgrid[:25, :25]
    away = np.hypot(i - 12.0, j - 12.0) * 4.0
    array = np.repeat([(away < 40.0) + np.uint8(away < 12.0)], 30, axis=0)
    labels = LabelMap(array, [4.0, 4.0, 4.0], [0.0, 0.0, 0.0], np.eye(3))
    arm = build_anatomy(labels, 8.0, ((48.0, 48.0, 20.0), (0.0, 0.0, -1.0)))
    assert arm.skin.points[:, 2].min() == pytest.approx(20.0, abs=1e-3)
    assert arm.skin.points[:, 2].max() == pytest.approx(118.0, abs=2.0)
    assert arm.bones["tibia"].points[:, 2].min() < 18.0
