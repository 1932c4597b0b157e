"""The tissue near a site: a part of a mesh, its force against the whole one's, first guesses from it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array, triu

from layered import SKIN_OVER_MUSCLE as TRUTH
from layered import build_block_site, layered_block
from limbfit.errors import ProblemError
from limbfit.fe import System, compute_tangent_at_rest
from limbfit.indentation import (
    Extension,
    SimulationJob,
    build_problem,
    cut_neighbourhood,
    simulate,
    simulating,
    to_vector,
)
from limbfit.mesh import Mesh, cell_volumes, check
from limbfit.study import SolverTable

TISSUES = tuple(TRUTH)
RADIUS_MM = 42.0
CENTRE, AXIS = np.zeros(3), np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def wide() -> Mesh:
    """A wide layer of tissue on bone, 120 x 120 x 24 mm."""
    return layered_block((4.0, 20.0), TISSUES, half_mm=60.0, divisions=10)


@pytest.fixture(scope="module")
def site(wide, tmp_path_factory):
    steps = SolverTable(load_steps=3, unload_steps=2, penalty_per_mm=100.0)
    return build_block_site("wide", tmp_path_factory.mktemp("wide") / "wide.vtu", wide, 4.0, steps, "tet10p0")


def job(model, **how) -> SimulationJob:
    times = tuple(np.linspace(0.0, model.knots_s[-1], 60))
    return SimulationJob(model, TISSUES, tuple(to_vector(TRUTH, TISSUES)), times, **how)


def test_a_part_keeps_its_geometry_tissues_and_sets(wide):
    part = cut_neighbourhood(wide, CENTRE, RADIUS_MM)
    mesh = part.mesh
    check(mesh)
    assert mesh.points == pytest.approx(wide.points[part.nodes])
    assert len(mesh.cells) < 0.6 * len(wide.cells)
    middle = wide.points[wide.corners].mean(axis=1)
    near = np.linalg.norm(middle, axis=1) < RADIUS_MM
    for tissue in range(2):
        both = near & (wide.regions == tissue)
        assert cell_volumes(mesh)[mesh.regions == tissue].sum() == pytest.approx(
            cell_volumes(wide)[both].sum()
        )
    assert (mesh.points[mesh.node_sets["fixed_bottom"], 2] == -24.0).all()
    assert (mesh.points[mesh.face_sets["skin"], 2] == 0.0).all()
    # The cut is what it shares with the rest: nothing of it is nearer than an edge to the middle.
    assert np.linalg.norm(mesh.points[part.cut], axis=1).min() > RADIUS_MM - 20.0


def test_only_what_hangs_together_with_the_site_is_kept(wide):
    """Two limbs beside each other: the other one is near enough, but not of this one."""
    other = replace(wide, points=wide.points - 30.0 * AXIS)
    both = Mesh(
        np.vstack([wide.points, other.points]), np.vstack([wide.cells, other.cells + len(wide.points)]),
        wide.cell_type, np.tile(wide.regions, 2), wide.region_names,
    )  # fmt: skip
    assert cut_neighbourhood(both, CENTRE, RADIUS_MM).nodes.max() < len(wide.points)


def test_a_site_beside_its_mesh_is_told(wide):
    with pytest.raises(ProblemError, match="no cell of the mesh is within 42 mm"):
        cut_neighbourhood(wide, CENTRE - 500.0 * AXIS, RADIUS_MM)


def test_a_part_that_nothing_else_carries_is_held_at_its_cut(wide, site):
    """Thin tissue far from bone: no cut below the indenter, no bone in reach."""
    far = replace(wide, node_sets={"fixed_side": wide.nodes_where(lambda p: p[:, 0] < -59.9)})
    part = cut_neighbourhood(far, CENTRE, RADIUS_MM)
    problem = build_problem(replace(site, within_mm=RADIUS_MM), far, TRUTH)
    assert len(part.cut) > 0
    assert set(problem.fixed) == set(part.cut)


def test_the_force_of_the_part_is_nearly_in_proportion_to_the_whole_one(site):
    whole = simulate(job(site))
    near = simulate(job(replace(site, within_mm=RADIUS_MM)))
    assert near.facts["unknowns"] < 0.6 * whole.facts["unknowns"]
    factor = whole.force_N @ near.force_N / (near.force_N @ near.force_N)
    assert factor == pytest.approx(1.0, abs=0.1)
    peak = whole.force_N.max()
    assert np.abs(factor * near.force_N - whole.force_N).max() < 0.01 * peak
    size = np.linalg.norm(whole.jacobian, axis=0)
    assert (np.linalg.norm(factor * near.jacobian - whole.jacobian, axis=0) < 0.06 * size).all()


@pytest.mark.slow
def test_first_guesses_of_the_part_save_iterations_and_change_no_force(site):
    simulating._prepared.clear()
    rest = simulate(job(site, sensitivities=False))
    nested = simulate(job(site, sensitivities=False, nested_mm=RADIUS_MM))
    assert nested.completed
    assert np.abs(nested.force_N - rest.force_N).max() < 1e-4 * rest.force_N.max()
    assert nested.facts["newton_iterations"] < rest.facts["newton_iterations"]


@pytest.mark.slow
def test_first_guesses_of_the_part_serve_a_law_with_other_parameters(site):
    """Two relaxation terms, of which one does nothing, are the law of one."""
    start = tuple(1.2 * to_vector(TRUTH, TISSUES))
    one = simulate(job(site, sensitivities=False, starts=(start,), nested_mm=RADIUS_MM))
    model = replace(site, law="ogden-prony2")
    two = np.array(
        [[c, m, gamma, tau, 1e-9, 8.0] for c, m, gamma, tau in to_vector(TRUTH, TISSUES).reshape(2, 4)]
    )
    more = replace(
        job(model, sensitivities=False, nested_mm=RADIUS_MM),
        parameters=tuple(two.ravel()),
        starts=(tuple((two * [1.2, 1.2, 1.2, 1.2, 1.0, 1.0]).ravel()),),
    )
    assert np.abs(simulate(more).force_N - one.force_N).max() < 1e-6 * one.force_N.max()


def test_first_guesses_do_not_depend_on_what_was_simulated_before(site):
    """The part's simulation is at hand in one process, and not in the other."""
    start = tuple(1.2 * to_vector(TRUTH, TISSUES))
    wanted = job(site, sensitivities=False, starts=(start,), nested_mm=RADIUS_MM)
    simulating._prepared.clear()
    fresh = simulate(wanted)
    simulating._prepared.clear()
    simulate(wanted.nested_job)
    simulate(job(replace(site, within_mm=RADIUS_MM), sensitivities=False))
    assert (simulate(wanted).force_N == fresh.force_N).all()


def test_the_extension_is_in_equilibrium_where_nothing_is_given(site, wide):
    problem = build_problem(site, wide, TRUTH)
    system, part = System(problem), cut_neighbourhood(wide, CENTRE, RADIUS_MM)
    extended = Extension(system, part, CENTRE, RADIUS_MM)
    moved = np.random.default_rng(0).normal(size=(len(part.nodes), 3))
    u = extended(moved)
    assert (u[system.supported] == 0.0).all()
    given = part.nodes[np.linalg.norm(part.mesh.points, axis=1) < 0.6 * RADIUS_MM]
    free = ~system.supported[given].any(axis=1)
    assert u[given][free] == pytest.approx(moved[np.isin(part.nodes, given)][free])
    forces = _product(system, u)
    elsewhere = np.ones(len(wide.points), dtype=bool)
    elsewhere[given] = False
    rest = np.repeat(elsewhere, 3)[system.free]
    assert np.abs(forces[rest]).max() < 1e-9 * np.abs(forces).max()


def _product(system: System, u: np.ndarray) -> np.ndarray:
    """The tangent at rest times a displacement, at the unknowns."""
    upper = csr_array(
        (compute_tangent_at_rest(system), system.indices, system.indptr), shape=(system.unknowns,) * 2
    )
    return (upper + triu(upper, 1).T) @ u.ravel()[system.free]


def test_workers_on_all_cores_keep_at_most_half_of_the_memory():
    assert simulating.count_stored_nodes(64e9, 2) == 200_000
    assert simulating.count_stored_nodes(8e9, 4) * 4 * 25_000 == pytest.approx(4e9)


def test_a_process_with_little_memory_forgets_the_site_that_was_not_used_for_longest(site, monkeypatch):
    site = replace(site, within_mm=RADIUS_MM)
    other = replace(site, name="other")
    simulating._prepared.clear()
    monkeypatch.setattr(simulating, "count_stored_nodes", lambda memory, cores: 1)
    for model in (site, other):
        assert simulate(job(model, sensitivities=False)).completed
    assert [model.name for model, *_ in simulating._prepared] == ["other"]
