"""Meshes of anatomy from elsewhere: inverted cells are mended and told, real limbs meshed as they come."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodies import limb
from limbfit.anatomy.meshing import improving, meshing
from limbfit.anatomy.meshing.background import compute_volumes
from limbfit.anatomy.meshing.engines import ENGINES, VolumeMesh
from limbfit.anatomy.meshing.extrusion import extrude_layers
from limbfit.anatomy.meshing.improving import (
    find_constraints,
    find_inverted_cells,
    repair_mesh,
    thin_inverted_layers,
)
from limbfit.anatomy.meshing.layers import LimbFields
from limbfit.anatomy.meshing.meshing import MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.sites.sites import compute_indenter_axis, project_to_skin
from limbfit.errors import MeshingError
from limbfit.mesh import check, measure_quality
from limbs import SHARED, rotation

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import foreign_meshes

COARSE = MeshSettings(edge_near_mm=6.0, edge_far_mm=22.0, near_radius_mm=10.0, growth=0.9, flatness=1.3)
NO_LIMBS = not (SHARED / "data" / "limbs").is_dir()
needs_limbs = pytest.mark.skipif(NO_LIMBS, reason="shared/data/limbs is not here")


@pytest.fixture(scope="module")
def anatomy():
    return limb(rotation(3))


@pytest.fixture(scope="module")
def base(anatomy):
    return build_base_mesh(anatomy, COARSE)


@pytest.fixture(scope="module")
def site(anatomy):
    point, _ = project_to_skin(anatomy, anatomy.skin.triangles[900].mean(axis=0))
    return point, compute_indenter_axis(anatomy.skin, point, 20.0)


@pytest.fixture(scope="module")
def core(anatomy, base, site) -> VolumeMesh:
    """What the mesher makes of the site, once for all tests."""
    made, run_mmg = [], ENGINES["mmg"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENGINES, "mmg", lambda *task: made.append(run_mmg(*task)) or made[0])
        mesh_site(anatomy, *site, COARSE, base)
    return made[0]


@pytest.fixture
def spoiled(monkeypatch, core):
    """``spoiled(spoil)`` lets something go wrong between the layers' extrusion and the repairs."""

    def apply(spoil) -> None:
        def layers(core: VolumeMesh, fields: LimbFields, regions: tuple[str, ...]):
            mesh, stack = extrude_layers(core, fields, regions)
            return spoil(mesh, stack), stack

        monkeypatch.setitem(ENGINES, "mmg", lambda *task: core)
        monkeypatch.setattr(meshing, "extrude_layers", layers)
        monkeypatch.setattr(improving, "smooth_elements", lambda mesh, fields, stack: mesh)

    return apply


def through(mesh, node: int):
    """A node pushed through the opposite side of the cells about it."""
    cells = mesh.cells[(mesh.cells == node).any(axis=1)]
    far = mesh.points[cells].reshape(-1, 3)
    away = far[np.linalg.norm(far - mesh.points[node], axis=1).argmax()] - mesh.points[node]
    points = mesh.points.copy()
    points[node] += 1.2 * away
    return mesh.with_points(points)


def crossed(mesh, stack):
    """Three neighbouring columns whose heads have changed sides."""
    points, feet = mesh.points.copy(), mesh.points[stack.base]
    heads = stack.top[np.linalg.norm(feet - feet[40], axis=1).argsort()[:3]]
    points[heads] = 1.5 * points[heads].mean(axis=0) - 0.5 * points[heads]
    return mesh.with_points(points)


def inner_node(mesh, stack) -> int:
    """A node of the core, on no surface."""
    surface = np.union1d(mesh.node_sets["fixed_bone"], stack.base)
    core = np.setdiff1d(np.unique(mesh.cells[mesh.regions == 1]), surface)
    return int(core[mesh.points[core, 2] < -5.0][0])


@pytest.mark.parametrize("where", ["core", "foot of a column", "columns"])
def test_inverted_cells_are_mended_and_told(spoiled, anatomy, base, site, where):
    places = []

    def spoil(mesh, stack):
        nodes = {"foot of a column": stack.base[40], "columns": stack.top[40]}
        node = int(nodes.get(where, inner_node(mesh, stack)))
        places.append(mesh.points[node])
        worse = crossed(mesh, stack) if where == "columns" else through(mesh, node)
        assert (compute_volumes(worse.points, worse.cells) <= 0).any()
        return worse

    spoiled(spoil)
    mesh, report = mesh_site(anatomy, *site, COARSE, base)
    check(mesh)
    assert measure_quality(mesh).inverted == 0
    told = re.match(r"[1-9]\d* inverted cells at \((.*)\) mm mended: ", report.repairs[0])
    place = [float(x) for x in told[1].split(",")]
    assert np.linalg.norm(place - base.fields.frame.to_patient(places[0])) < 25.0
    assert abs(report.volume_error) < 0.01


def test_what_cannot_be_mended_is_refused_with_its_place(monkeypatch, spoiled, anatomy, base, site):
    spoiled(lambda mesh, stack: through(mesh, inner_node(mesh, stack)))
    monkeypatch.setattr(improving, "UNTANGLING_SWEEPS", 0)
    told = (
        r"\d+ of \d+ cells are inverted, the first in muscle at \(.*\) mm, .* mm from .*: there is too little"
    )
    with pytest.raises(MeshingError, match=told):
        mesh_site(anatomy, *site, COARSE, base)


def test_a_mesher_that_fails_is_told_with_a_place(anatomy, base, site):
    hurried = replace(COARSE, time_limit_s=0.01)
    told = r"did not end in 0\.01 s; .*; its input is flattest at \(.*\) mm, [\d.]+ mm from the "
    with pytest.raises(MeshingError, match=told):
        mesh_site(anatomy, *site, hurried, base)


def test_a_sound_mesh_is_left_alone_and_thinner_layers_alone_make_crossed_columns_sound(
    monkeypatch, anatomy, base, core, site
):
    given = []

    def watched(mesh, fields, stack):
        after, repairs = repair_mesh(mesh, fields, stack)
        given.append((mesh, after, stack))
        return after, repairs

    monkeypatch.setitem(ENGINES, "mmg", lambda *task: core)
    monkeypatch.setattr(improving, "repair_mesh", watched)
    _, report = mesh_site(anatomy, *site, COARSE, base)
    ((mesh, after, stack),) = given
    assert report.repairs == ()
    assert not find_inverted_cells(mesh).any()
    assert np.array_equal(after.points, mesh.points)
    worse = crossed(mesh, stack)
    assert find_inverted_cells(worse).any()
    points = thin_inverted_layers(worse.points, worse, stack, *find_constraints(worse, base.fields, stack))
    assert (compute_volumes(points, worse.cells) > 0).all()


@needs_limbs
def test_two_long_triangles_that_cross_are_parted_gently():
    """Half the triangles and 0.3 mm of noise: sheets of skin in a fold meet, and hardly need to move."""
    file = foreign_meshes.limb_files(SHARED)["limb-2"]
    found = foreign_meshes.read_limb("limb-2", file, 0.3, True)
    told = next(note for note in found.notes if note.startswith("skin: 1 pairs of crossing faces"))
    assert float(told.rpartition("by ")[2].removesuffix(" mm")) < 1.5


@needs_limbs
@pytest.mark.slow
def test_a_node_that_the_mesher_left_on_the_skin_is_put_back():
    """Over a ridge MMG put a node of the inner face 0.1 mm under the skin: an angle of 0.5 degrees."""
    found = foreign_meshes.read_limb("limb-6", foreign_meshes.limb_files(SHARED)["limb-6"], 0.0, False)
    settings = foreign_meshes.default_settings()["own"]
    site = foreign_meshes.draw_random_sites(found.anatomy, 10)[9]
    row = foreign_meshes.site_row(found, build_base_mesh(found.anatomy, settings), settings, site)
    assert row["sound"], row["failure"]


@needs_limbs
@pytest.mark.slow
@pytest.mark.parametrize("name", [*(f"limb-{i}" for i in range(1, 10)), "mean"])
def test_limbs_of_an_atlas_are_meshed_as_they_come(name):
    file = foreign_meshes.limb_files(SHARED)[name]
    found = foreign_meshes.read_limb(name, file, 0.0, False)
    assert any("skin: open at one end" in note for note in found.notes)
    assert set(found.anatomy.bones) == {"tibia", "fibula", "femur", "patella"}
    settings = foreign_meshes.default_settings()["own"]
    sites = foreign_meshes.draw_random_sites(found.anatomy, 1, 3)
    row = foreign_meshes.site_row(found, build_base_mesh(found.anatomy, settings), settings, sites[0])
    assert row["sound"], row["failure"]
