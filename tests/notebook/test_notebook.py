"""Own meshes, solutions that show themselves, and own curves fitted, as a notebook has them."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import meshio
import numpy as np
import pytest
import pyvista as pv

import limbfit
from limbfit import History, Indenter, Mesh, OgdenQLV, Problem, StepControl
from limbfit.errors import ProblemError
from limbfit.fe import Ogden, solve
from limbfit.febio import write_feb
from limbfit.mesh import cell_volumes, to_tet10
from limbfit.notebook import announce_compilation

TISSUE = OgdenQLV(c=0.005, m=4.0, gamma=1.0, tau=0.6)
RAMP = History([0.0, 2.0, 4.0], [0.0, 2.0, 0.0])
STEPS = StepControl(load_steps=4, unload_steps=3)


def block(divisions: int = 5) -> pv.UnstructuredGrid:
    """30 x 30 x 12 mm of hexahedra, top at z = 0; the upper third is skin."""
    side, depth = np.linspace(-15.0, 15.0, divisions), np.linspace(-12.0, 0.0, 4)
    grid = pv.RectilinearGrid(side, side, depth).cast_to_unstructured_grid()
    cells = grid.cells.reshape(-1, 9)[:, 1:]
    if grid.celltypes[0] == 11:  # voxels to hexahedra
        cells = cells[:, [0, 1, 3, 2, 4, 5, 7, 6]]
    found = pv.UnstructuredGrid({12: cells}, grid.points)
    found.cell_data["tissue"] = np.where(found.cell_centers().points[:, 2] > -4.0, "skin", "muscle")
    return found


def problem_of(mesh: Mesh, **materials) -> Problem:
    bottom, top = mesh.nodes_where(lambda p: p[:, 2] < -11.9), mesh.faces_where(lambda p: p[:, 2] > -0.1)
    punch = Indenter("sphere", width=20.0, centre=(0, 0, 0), axis=(0, 0, -1))
    known = {region: materials.get(region, TISSUE) for region in mesh.region_names}
    return Problem(mesh, known, bottom, top, punch, RAMP)


@pytest.fixture(scope="module")
def solution():
    return limbfit.solve(problem_of(Mesh.from_pyvista(block(), "tissue")), STEPS, sensitivities=True)


def test_a_pyvista_grid_becomes_a_mesh_with_its_tissues():
    mesh = Mesh.from_pyvista(block(), "tissue")
    assert mesh.cell_type == "hex8"
    assert mesh.region_names == ("muscle", "skin")
    assert cell_volumes(mesh).sum() == pytest.approx(30 * 30 * 12)
    assert cell_volumes(mesh)[mesh.regions == 1].sum() == pytest.approx(30 * 30 * 4)
    extent = "x -15 to 15 mm, y -15 to 15 mm, z -12 to 0 mm"
    assert repr(mesh) == f"<Mesh: hex8 (muscle 32, skin 16), 100 nodes, {extent}>"


def test_surfaces_beside_the_cells_and_points_of_no_cell_are_left_out():
    grid = block().triangulate()
    shell = pv.UnstructuredGrid({5: np.array([[0, 1, 2]])}, grid.points)
    both = grid.merge(shell, merge_points=False)
    mesh = Mesh.from_pyvista(both)
    assert mesh.cell_type == "tet4"
    assert len(mesh.cells) == grid.n_cells
    more = np.vstack([mesh.points, [[99.0, 99.0, 99.0]]])
    assert len(Mesh.from_arrays(more, mesh.cells).points) == len(mesh.points)


@pytest.mark.parametrize("kind", ["tet4", "tet10", "hex8"])
def test_cells_that_run_the_other_way_round_are_turned(kind):
    mesh = Mesh.from_pyvista(block() if kind == "hex8" else block().triangulate())
    mesh = to_tet10(mesh) if kind == "tet10" else mesh
    mirrored = Mesh.from_arrays(mesh.points * [1.0, 1.0, -1.0], mesh.cells)
    assert (cell_volumes(mirrored) > 0).all()
    assert np.sort(cell_volumes(mirrored)) == pytest.approx(np.sort(cell_volumes(mesh)))
    if kind == "tet10":  # every mid-edge node still lies between its own corners
        ends = mirrored.points[mirrored.cells[:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]]]
        assert mirrored.points[mirrored.cells[:, 4:]] == pytest.approx(ends.mean(axis=2))


def test_a_gmsh_file_read_by_meshio_keeps_its_named_groups(tmp_path):
    grid = block().triangulate()
    numbers = np.where(grid.cell_centers().points[:, 2] > -4.0, 7, 3)
    cells = [("triangle", np.array([[0, 1, 2]])), ("tetra", grid.cells_dict[10])]
    data = {"gmsh:physical": [np.array([1]), numbers], "gmsh:geometrical": [np.array([1]), numbers]}
    groups = {"skin": np.array([7, 3]), "muscle": np.array([3, 3]), "top": np.array([1, 2])}
    file = tmp_path / "block.msh"
    meshio.Mesh(grid.points, cells, cell_data=data, field_data=groups).write(file, file_format="gmsh22")
    mesh = Mesh.from_meshio(meshio.read(file))
    assert mesh.region_names == ("muscle", "skin")
    assert cell_volumes(mesh)[mesh.regions == 1].sum() == pytest.approx(30 * 30 * 4)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Mesh.from_pyvista(pv.Sphere().cast_to_unstructured_grid()), "no volume cells"),
        (lambda: Mesh.from_pyvista(pv.UnstructuredGrid({13: np.arange(6)}, np.eye(6, 3))), "wedges"),
        (lambda: Mesh.from_pyvista(block(), "label"), "no cell data 'label'.*there is tissue"),
        (lambda: Mesh.from_arrays(np.zeros((4, 3)), [[0, 1, 2]]), r"shape \(1, 3\)"),
        (lambda: Mesh.from_arrays(np.eye(4, 3), [[1, 2, 3, 4]]), "count nodes from 0"),
        (lambda: Mesh.from_arrays(np.zeros((4, 3)), [[0, 1, 2, 3]]), "inverted"),
        (lambda: Mesh.from_arrays(np.eye(4, 3), [[0, 1, 2, 3]], [1, 2]), "one for each of 1"),
        (lambda: Mesh.from_pyvista(block()).nodes_where(lambda p: p[:, 2] > 5), "z -12 to 0 mm"),
        (lambda: Mesh.from_pyvista(block()).faces_where(lambda p: p[:, 2] == -4.0), "no boundary face"),
        (lambda: Mesh.from_pyvista(block()).nodes_where(lambda p: np.flatnonzero(p[:, 2] < 0)), "int64"),
        (lambda: Mesh.from_pyvista(block()).nodes_where(lambda p: p < -11.9), r"\(100, 3\), not true or"),
        (lambda: Mesh.from_pyvista(block()).faces_where(lambda p: True), "compare a coordinate"),
    ],
)
def test_what_is_no_mesh_is_refused_with_a_remedy(make, text):
    with pytest.raises(ProblemError, match=text):
        make()


def test_tissues_may_be_a_column_of_objects():
    names = np.array(["skin", "muscle"], dtype=object)[np.arange(48) % 2]
    mesh = Mesh.from_pyvista(block())
    assert Mesh.from_arrays(mesh.points, mesh.cells, names).region_names == ("muscle", "skin")


def test_a_problem_stays_as_it_was_stated_whatever_becomes_of_what_it_was_given():
    tissues, depth, place = {"tissue": TISSUE}, np.array([0.0, 2.0, 0.0]), np.zeros(3)
    mesh, history = Mesh.from_pyvista(block()), History(np.array([0.0, 2.0, 4.0]), depth)
    problem = replace(problem_of(mesh), materials=tissues, history=history)
    problem = replace(problem, indenter=replace(problem.indenter, centre=place))
    tissues["tissue"], place[0] = replace(TISSUE, c=1.0), 5.0
    depth *= 2.0
    assert problem.materials["tissue"] is TISSUE
    assert problem.history.displacement.tolist() == [0.0, 2.0, 0.0]
    assert tuple(problem.indenter.centre) == (0.0, 0.0, 0.0)


def test_what_is_done_to_a_grid_changes_neither_mesh_nor_solution(solution):
    mesh, deepest, grid = solution.problem.mesh, solution.deepest, solution.to_pyvista()
    points, regions, moved = mesh.points.copy(), mesh.regions.copy(), deepest.u.copy()
    grid.points *= 1e-3
    grid["displacement_mm"][:] = 0.0
    grid["region"][:] = 0
    assert (mesh.points == points).all()
    assert (mesh.regions == regions).all()
    assert (deepest.u == moved).all()


def test_a_grid_that_is_saved_is_read_with_its_tissues(solution, tmp_path):
    solution.to_pyvista().save(tmp_path / "deepest.vtu")
    mesh = limbfit.read_vtu(tmp_path / "deepest.vtu")
    assert mesh.region_names == solution.problem.mesh.region_names
    assert (mesh.regions == solution.problem.mesh.regions).all()


def test_one_time_has_one_force(solution):
    assert solution.force_at(2.0).shape == ()
    assert solution.force_at(2.0) == solution.force_at([2.0])[0]
    assert solution.sensitivity_at(2.0).shape == (8,)


def test_a_solution_is_a_result_and_a_grid_of_every_step(solution):
    assert solution.completed
    assert solution.force == pytest.approx(
        solve(solution.problem, STEPS).force, abs=1e-4 * solution.peak_force
    )
    deepest, rest, last = solution.to_pyvista(), solution.to_pyvista(0), solution.to_pyvista(-1)
    assert -4.0 < deepest["displacement_mm"][:, 2].min() < -1.9
    assert not rest["displacement_mm"].any()
    assert deepest["contact_pressure_kPa"].max() > 1.0
    assert last["contact_pressure_kPa"].max() == 0.0
    assert {"cauchy_kPa", "largest_stretch", "region"} <= set(deepest.cell_data.keys())
    assert deepest["von_mises_kPa"].max() > 5 * last["von_mises_kPa"].max()
    assert len(solution.frames) == len(solution.times)
    steps, most = len(solution.times) - 1, f"{solution.peak_force:.3g}"
    assert repr(solution) == f"<Solution: {steps} steps to 4 s, {most} N at most, complete>"
    with pytest.raises(ProblemError, match="no step 99"):
        solution.to_pyvista(99)


def test_the_plot_shows_the_curve_with_units(solution):
    axes = solution.plot()
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("displacement, mm", "force, N")
    curve, points = axes.lines
    assert curve.get_ydata().max() == pytest.approx(solution.peak_force, rel=1e-2)
    assert len(points.get_xdata()) == len(solution.times)


def test_own_curves_tell_their_tissue_and_how_well(solution):
    """From a record made on finer steps, with noise: the truth within every interval."""
    skin = replace(TISSUE, c=0.012)
    true = problem_of(solution.problem.mesh, skin=skin)
    times = np.linspace(0.05, 4.0, 60)
    record = limbfit.solve(true, StepControl(load_steps=16, unload_steps=16), frames=False).force_at(times)
    noisy = record + 0.01 * record.max() * np.random.default_rng(1).standard_normal(60)
    said: list[str] = []
    start = {"skin.c": 0.005, "skin.gamma": 2.0}
    fit = limbfit.calibrate(solution.problem, (times, noisy), start, listener=said.append)
    assert fit.converged, fit.reason
    assert len(said) == fit.simulations
    assert fit.error_percent[0] < 1.5
    for value, (low, high) in zip((skin.c, skin.gamma), fit.uncertainty.intervals_95, strict=True):
        assert low < value < high
    assert fit.parameters["skin.c"] == pytest.approx(skin.c, rel=0.1)
    assert fit.problems[0].materials["skin"].c == fit.parameters["skin.c"]
    assert fit.problems[0].materials["muscle"] == TISSUE
    assert "skin.gamma" in fit.table()
    assert fit.plot().get_ylabel() == "force, N"


def test_two_relaxation_terms_are_told_apart_by_a_hold():
    """From a record with noise, in any law: here the terms of the paper's tissue and a modulus of Ogden's."""
    true = OgdenQLV(c=0.005, m=4.0, gamma=(1.5, 0.7), tau=(0.08, 1.5))
    one = Mesh.from_pyvista(block())
    held = History([0.0, 0.5, 4.0, 6.0], [0.0, 2.0, 2.0, 0.0])
    problem = replace(problem_of(one, tissue=true), history=held)
    times = np.linspace(0.02, 6.0, 150)
    record = limbfit.solve(problem, StepControl(load_steps=16, unload_steps=16), frames=False).force_at(times)
    noisy = record + 0.005 * record.max() * np.random.default_rng(0).standard_normal(150)
    start = {"tissue.c": 0.008, "tissue.gamma1": 0.6, "tissue.tau1": 0.2}
    start |= {"tissue.gamma2": 0.6, "tissue.tau2": 0.6}
    fit = limbfit.calibrate(problem, (times, noisy), start, steps=StepControl(load_steps=16, unload_steps=6))
    assert fit.converged, fit.reason
    truth = [0.005, 1.5, 0.08, 0.7, 1.5]
    assert list(fit.parameters.values()) == pytest.approx(truth, rel=0.15)
    for value, (low, high) in zip(truth, fit.uncertainty.intervals_95, strict=True):
        assert low < value < high


def test_a_parameter_that_is_no_field_is_fitted(solution):
    skin = Ogden(((0.01, 4.0),), ((1.0, 0.6),))
    problem = solution.problem.with_materials({"skin": skin, "muscle": TISSUE})
    times = np.linspace(0.1, 4.0, 30)
    record = limbfit.solve(problem, STEPS, frames=False).force_at(times)
    fit = limbfit.calibrate(problem, (times, record), {"skin.c1": 0.015}, steps=STEPS)
    assert fit.parameters["skin.c1"] == pytest.approx(0.01, rel=0.01)
    assert fit.problems[0].materials["skin"].prony == skin.prony


def test_creep_under_a_force_tells_the_tissue(solution):
    """The record is the displacement; the truth is recorded on finer steps, with noise."""
    force = History([0.0, 1.0, 4.0], force=[0.0, 0.3, 0.3])
    true = replace(solution.problem.with_materials({"skin": TISSUE, "muscle": TISSUE}), history=force)
    times = np.linspace(0.2, 4.0, 60)
    record = limbfit.solve(true, StepControl(load_steps=16, unload_steps=16), frames=False).displacement_at(
        times
    )
    noisy = record + 0.005 * record.max() * np.random.default_rng(1).standard_normal(60)
    assert record[-1] > 1.1 * record[np.searchsorted(times, 1.0)]
    fit = limbfit.calibrate(true, (times, noisy), {"muscle.c": 0.5 * TISSUE.c})
    assert fit.converged, fit.reason
    assert fit.parameters["muscle.c"] == pytest.approx(TISSUE.c, rel=0.05)
    assert fit.error_percent[0] < 1.0
    assert fit.plot().get_ylabel() == "displacement, mm"


@pytest.mark.parametrize(
    ("curve", "text"),
    [
        ([([1.0, 2.0, 3.0], [0.1, 0.2, 0.3])], "curve 1 is no pair of arrays; give"),
        (np.ones((5, 2)), "no pair of arrays"),
        ({"time": [1.0, 2.0], "force": [0.1, 0.2]}, "no pair of arrays"),
        (([], []), "growing"),
        (([1.0, 2.0], [0.1, np.nan]), "1 values that are not finite; leave"),
    ],
)
def test_what_is_no_curve_is_refused(solution, curve, text):
    with pytest.raises(ProblemError, match=text):
        limbfit.calibrate(solution.problem, curve, {"skin.c": 0.005})


def test_a_fit_to_an_indenter_that_never_touches_is_refused(solution):
    away = replace(solution.problem, history=History([0.0, 2.0, 4.0], [0.0, -2.0, 0.0]))
    with pytest.raises(ProblemError, match=r"curve 1: .*; displacement and force are positive"):
        limbfit.calibrate(away, ([1.0, 2.0], [0.1, 0.2]), {"skin.c": 0.005}, steps=STEPS)


def test_a_parameter_that_ends_at_its_bound_is_said_to_be_there(solution):
    """A start in kPa has bounds beyond what MPa the tissue has."""
    times = np.linspace(0.1, 4.0, 20)
    fit = limbfit.calibrate(
        solution.problem, (times, solution.force_at(times)), {"muscle.c": 5.0}, steps=STEPS
    )
    assert fit.parameters["muscle.c"] == pytest.approx(0.05)
    assert fit.table().endswith("; at its bound")


def test_a_fit_simulates_what_it_fitted(solution):
    """By default steps and with another penalty the curve was off by more than the error of the fit."""
    times = np.linspace(0.1, 4.0, 20)
    noisy = solution.force_at(times) * (1.0 + 0.01 * np.sin(9.0 * times))
    fit = limbfit.calibrate(solution.problem, (times, noisy), {"muscle.c": 0.002}, steps=STEPS)
    again, fitted = fit.solve(), fit.responses[0].force_N
    assert again.force_at(times) == pytest.approx(fitted, abs=1e-4 * fitted.max())
    assert len(again.times) < len(limbfit.solve(solution.problem).times)


def test_fewer_points_than_parameters_have_intervals(solution):
    times = np.array([0.5, 1.0, 2.0])
    start = {"muscle.c": 0.004, "muscle.gamma": 0.8, "skin.c": 0.006, "skin.gamma": 1.2}
    fit = limbfit.calibrate(solution.problem, (times, solution.force_at(times)), start, steps=STEPS)
    assert np.isfinite(fit.uncertainty.intervals_95).all()
    assert "determined" not in fit.uncertainty.verdicts


def test_problems_of_two_laws_are_fitted_together(solution):
    one = solution.problem
    other = one.with_materials({"skin": Ogden(((0.01, 4.0),)), "muscle": TISSUE})
    times = np.linspace(0.1, 4.0, 20)
    curves = [(times, limbfit.solve(each, STEPS).force_at(times)) for each in (one, other)]
    fit = limbfit.calibrate([one, other], curves, {"skin.c": 0.006, "skin.c1": 0.008}, steps=STEPS)
    assert list(fit.parameters.values()) == pytest.approx([TISSUE.c, 0.01], rel=0.01)


@pytest.mark.parametrize(
    ("start", "bounds", "times", "text"),
    [
        ({"skin.k": 1.0}, {}, [0.0, 4.0], "no parameter 'skin.k'.*skin.c"),
        ({"skin.c": 1.0}, {"skin.m": (1, 2)}, [0.0, 4.0], "has no start"),
        ({"skin.c": 1.0}, {"skin.c": (2, 3)}, [0.0, 4.0], "skin.c"),
        ({"skin.c": 1.0}, {}, [0.0, 9.0], "cut what lies outside"),
        ({"skin.c": 1.0}, {}, [0.0, 2.0, 4.0], r"both \(n,\)"),
    ],
)
def test_a_fit_that_cannot_be_meant_is_refused(solution, start, bounds, times, text):
    with pytest.raises(ProblemError, match=text):
        limbfit.calibrate(solution.problem, (times, [0.0, 1.0]), start, bounds)


def test_a_tissue_without_material_is_named_before_anything_is_solved(solution):
    bare = replace(solution.problem, materials={"skin": TISSUE})
    for refused in (lambda: limbfit.solve(bare), lambda: limbfit.calibrate(bare, ([0, 1], [0, 1]), {})):
        with pytest.raises(
            ProblemError, match="'muscle' has no material; name it in materials; there are: skin"
        ):
            refused()


def test_verbs_are_quiet_unless_told_otherwise(tmp_path, capsys):
    """And ``listener=print`` shows lines that read."""
    file = tmp_path / "block.feb"
    write_feb(problem_of(Mesh.from_pyvista(block(3).triangulate())), file)
    limbfit.simulate_feb(file, tmp_path)
    assert capsys.readouterr().out == ""
    limbfit.simulate_feb(str(file), tmp_path, listener=print)
    assert re.search(r"^febio [\d.]+ of 4: block.feb: [\d.e-]+ N$", capsys.readouterr().out, re.MULTILINE)


def test_the_first_compilation_is_announced(solution, tmp_path, capsys):
    """Where nothing is compiled yet a first run seems to hang."""
    announce_compilation()
    assert capsys.readouterr().err == ""  # here it is, by the solution
    code = "from limbfit.notebook import announce_compilation; announce_compilation()"
    fresh = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=fresh
    )
    assert "compiles" in shown.stderr
