"""Shape models of limbs: modes of known limbs are found, and limbs that do not correspond are refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbfit.anatomy.surfaces.files import write_surface
from limbfit.anatomy.surfaces.triangles import Surface, from_pyvista
from limbfit.errors import InputError
from limbfit.population.bodies import name_bodies, read_bodies, register_limbs
from limbfit.population.shape_model import ShapeModel, build_shape_model

import pyvista as pv  # isort: skip


def make_body(
    size: tuple[float, float, float], centre: tuple[float, float, float], fine: int = 24
) -> Surface:
    sphere = from_pyvista(pv.Sphere(radius=1.0, theta_resolution=fine, phi_resolution=fine))
    return Surface(sphere.points * size + np.array(centre), sphere.faces)


def join(*bodies: Surface) -> Surface:
    starts = np.cumsum([0, *(len(body.points) for body in bodies)])
    faces = [body.faces + start for body, start in zip(bodies, starts, strict=False)]
    return Surface(np.vstack([body.points for body in bodies]), np.vstack(faces))


def make_limb(long: float, wide: float, fine: int = 24) -> Surface:
    """A skin with a tibia and a fibula, whose length and width are two modes."""
    skin = make_body((45.0 + wide, 45.0 + wide, 110.0 + long), (0.0, 0.0, 0.0), fine)
    tibia = make_body((12.0, 12.0, 80.0 + long), (0.0, -8.0, 10.0), fine)
    fibula = make_body((6.0, 6.0, 60.0 + long), (-20.0, 10.0, 5.0), fine - 4)
    return join(skin, tibia, fibula)


@pytest.fixture(scope="module")
def limbs(tmp_path_factory):
    """Twelve limbs in correspondence, each turned and moved; the scores of their modes."""
    folder, random = tmp_path_factory.mktemp("limbs"), np.random.default_rng(3)
    scores, files = random.standard_normal((12, 2)), []
    for i, (long, wide) in enumerate(scores * [15.0, 3.0]):
        limb = make_limb(long, wide)
        turn = Rotation.from_rotvec(random.uniform(-0.2, 0.2, 3))
        points = turn.apply(limb.points) + random.uniform(-30, 30, 3)
        files.append(folder / f"limb-{i}.{('stl', 'ply', 'vtp', 'obj')[0]}")
        write_surface(files[-1], Surface(points, limb.faces))
    return files, scores


def test_two_ways_in_which_limbs_differ_are_two_modes(limbs):
    model = build_shape_model(limbs[0])
    assert model.figures.bodies == ["skin", "tibia", "fibula"]
    assert model.figures.explained[1] > 0.999
    assert model.figures.left_out_mm[1] < 0.05 < 1.0 < model.figures.left_out_mm[0]
    # Along z points move by 15 mm times their height over 110 mm: the first mode's size is known.
    assert model.figures.deviation_mm[0] == pytest.approx(15.0 * 0.6, rel=0.35)


def test_a_model_that_is_stored_draws_the_same_limb(limbs, tmp_path):
    model = build_shape_model(limbs[0])
    model.write(tmp_path / "model.npz")
    again = ShapeModel.read(tmp_path / "model.npz")
    assert again.figures == model.figures
    drawn = model.draw(np.array([1.0, -2.0]))
    np.testing.assert_array_equal(again.draw(np.array([1.0, -2.0])).points, drawn.points)
    bone = drawn.extract("tibia")
    assert drawn.extract("skin").signed_distance(bone.points).max() < 0.0


def test_limbs_at_two_deviations_of_a_mean_give_its_mode(tmp_path):
    for name, (long, wide) in {"mean": (0, 0), "a": (20, 0), "b": (-20, 0), "c": (0, 6)}.items():
        write_surface(tmp_path / f"{name}.stl", make_limb(long, wide))
    model = build_shape_model([tmp_path / f"{n}.stl" for n in "abc"], mean=tmp_path / "mean.stl", at=2.0)
    assert len(model.modes) == 2
    mean = read_bodies([tmp_path / "mean.stl"])[0]
    far = np.ptp(model.draw(np.array([2.0, 0.0])).points[:, 2]) - np.ptp(mean.points[:, 2])
    assert abs(far) == pytest.approx(40.0, rel=0.01)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("triangles", "its triangles are not those of"),
        ("bone", "its triangles are not those of"),
        ("unit", "bring all limbs to one unit"),
        ("none", "are too few"),
    ],
)
def test_limbs_that_do_not_correspond_are_refused_in_one_line(limbs, tmp_path, change, words):
    other = tmp_path / "other.stl"
    limb = make_limb(0.0, 0.0, 20 if change == "triangles" else 24)
    if change == "bone":
        limb = join(make_body((45, 45, 110), (0, 0, 0)), make_body((12, 12, 80), (0, -8, 10)))
    write_surface(other, Surface(limb.points * (0.1 if change == "unit" else 1.0), limb.faces))
    given = [limbs[0][0]] if change == "none" else [*limbs[0][:3], other]
    with pytest.raises(InputError, match=words):
        build_shape_model(given)


def test_a_limb_may_be_a_folder_with_a_file_for_each_body(tmp_path):
    for i, long in enumerate((0.0, 10.0, -10.0)):
        limb = make_limb(long, 0.0)
        named = name_bodies(limb, tmp_path)
        (tmp_path / f"limb-{i}").mkdir()
        for name, faces in named.items():
            write_surface(tmp_path / f"limb-{i}" / f"{name}.ply", Surface(limb.points, faces))
    model = build_shape_model([tmp_path / f"limb-{i}" for i in range(3)])
    assert model.figures.bodies == ["fibula", "skin", "tibia"]
    (tmp_path / "limb-2" / "fibula.ply").unlink()
    with pytest.raises(InputError, match="its triangles are not those of"):
        build_shape_model([tmp_path / f"limb-{i}" for i in range(3)])


def test_bodies_that_cannot_be_told_apart_are_refused():
    limb = join(make_limb(0.0, 0.0), make_body((8, 8, 8), (0, 0, 130)))
    with pytest.raises(InputError, match="4 bodies, which cannot be told apart"):
        name_bodies(limb, "limb.stl")


@pytest.mark.slow
def test_limbs_with_other_triangles_are_registered(tmp_path):
    for i, (long, wide, fine) in enumerate([(0, 0, 24), (20, 3, 30)]):
        write_surface(tmp_path / f"{i}.stl", make_limb(long, wide, fine))
    found, distances = register_limbs([tmp_path / "0.stl", tmp_path / "1.stl"])
    assert np.array_equal(found[0].faces["skin"], found[1].faces["skin"])
    assert max(np.sqrt((one**2).mean()) for one in distances) < 1.0
    assert np.ptp(found[1].extract("skin").points[:, 2]) == pytest.approx(260.0, abs=2.0)
