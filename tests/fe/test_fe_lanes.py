"""Elements side by side against the kernels of one point, and elements alone against all together."""

import numpy as np
import pytest
from blocks import block, untouched
from numba import njit
from samples import SAMPLES, energy, kirchhoff, point, quotients, slopes

from limbfit.fe import ELEMENTS, System
from limbfit.fe.kernel.assembly import assemble
from limbfit.fe.lanes import LANES, block_places, exponential, logarithm
from limbfit.fe.memory import compute_elastic_stresses


@njit(error_model="numpy", fastmath={"contract"})
def each(x, exponentials, logarithms):
    for i in range(len(x)):
        exponentials[i], logarithms[i] = exponential(x[i]), logarithm(abs(x[i]))


def elementary(x) -> tuple[np.ndarray, np.ndarray]:
    x = np.array(x, dtype=float)
    out = np.empty_like(x), np.empty_like(x)
    each(x, *out)
    return out


def test_exponential_and_logarithm_are_those_of_numpy():
    rng = np.random.default_rng(3)
    small, near, far = (rng.uniform(-a, a, 2000) for a in (1e-3, 3.0, 700.0))
    x = np.concatenate([small, near, far, 1.0 + small, 2.0**0.5 + small])
    exponentials, logarithms = elementary(x)
    np.testing.assert_allclose(exponentials, np.exp(x), rtol=4e-16)
    np.testing.assert_allclose(logarithms, np.log(np.abs(x)), rtol=4e-16)
    extremes = np.array([1e-300, 0.5, 2.0, 1e300])
    np.testing.assert_allclose(elementary(extremes)[1], np.log(extremes), rtol=4e-16)


def test_exponential_and_logarithm_are_exact_where_nothing_is_strained():
    assert elementary([0.0])[0][0] == 1.0
    assert elementary([1.0])[1][0] == 0.0


@pytest.mark.parametrize("x", [709.9, 1e4, np.inf])
def test_an_exponential_too_large_is_infinite(x):
    assert elementary([x])[0][0] == np.inf


def gradients() -> np.ndarray:
    """Deformation gradients of all lanes: at rest, stretches that repeat or nearly do, shear, any."""
    rng = np.random.default_rng(8)
    F = np.eye(3) + 0.3 * rng.normal(size=(LANES, 3, 3))
    F[np.linalg.det(F) < 0.1] = np.eye(3)
    Q, R = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    F[0], F[1], F[2] = np.eye(3), 0.9 * np.eye(3), np.diag([0.7, 1.2, 1.2])
    F[3], F[4] = Q @ np.diag([1.1, 1.1 + 1e-9, 0.8]) @ R, Q @ np.diag([1.2, 0.7, 1.2]) @ Q.T
    F[5] = np.eye(3) + 1e-9 * rng.normal(size=(3, 3))
    F[6, 0, 1] += 1e-170  # its square is no number any more
    return F * np.sign(np.linalg.det(F))[:, None, None]


@pytest.mark.parametrize("law", SAMPLES.values(), ids=SAMPLES)
def test_lanes_are_points_side_by_side(law):
    F = gradients()
    p, _ = point(law, F)
    size = law.shear_modulus
    for l in range(LANES):
        J = np.linalg.det(F[l])
        assert p["J"][l] == pytest.approx(J, rel=1e-13)
        np.testing.assert_allclose(p["inverse"][..., l], np.linalg.inv(F[l]).T, atol=1e-12)
        n, found = p["n"][..., l], p["b"][:3, l]
        np.testing.assert_allclose(n @ n.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(n @ np.diag(found) @ n.T, F[l] @ F[l].T, atol=1e-14 * found.max())
        c2 = np.linalg.eigvalsh(F[l].T @ F[l])
        np.testing.assert_allclose(np.sort(found), c2, rtol=1e-13, atol=1e-15 * found.max())
        stretches = np.sqrt(found)
        assert p["energy"][l] == pytest.approx(energy(law, stretches), rel=1e-11, abs=1e-14 * size)
        expected = {
            "beta": kirchhoff(law, stretches),
            "slope": [*slopes(law, stretches), 0.0, 0.0, 0.0],
            "quotient": quotients(law, found),
        }
        for name, values in expected.items():
            np.testing.assert_allclose(p[name][:, l], values, rtol=1e-11, atol=1e-13 * size)


def deformed(name: str):
    """A system of two tissues with its laws, scales, a history and a displacement, all at random."""
    lines = np.linspace(0.0, 1.0, 3)
    mesh = block(ELEMENTS[name].cell_type, lines, lines, np.linspace(0.0, 1.5, 4), layer=0.5, jitter=0.05)
    tissues = {"skin": SAMPLES["paper"], "muscle": SAMPLES["mooney-rivlin"]}
    problem = untouched(mesh, tissues, fixed=mesh.node_sets["bottom"], element=name)
    system = System(problem)
    rng = np.random.default_rng(11)
    u = system.points @ (0.15 * rng.normal(size=(3, 3))) + 0.01 * rng.normal(size=system.points.shape)
    K = 1e-3 * rng.normal(size=(*system.weights.shape, 6))
    return system, problem.build_laws(), np.array([1.5, 2.5]), K, u


def assembled(case, cells: slice, tangent: bool):
    system, laws, scale, K, u = case
    residual, data = np.zeros_like(u), np.zeros(len(system.indices) if tangent else 0)
    energy = assemble(
        system.elements(cells), system.element.mean_dilatation, laws.tables, scale, K[cells], u, tangent,
        system.cell_positions[cells], residual, data,
    )  # fmt: skip
    return energy, residual, data


every_element = pytest.mark.parametrize("name", ELEMENTS)


@every_element
def test_elements_add_up_however_they_fall_into_lanes(name):
    """Each alone, with all lanes but one empty, against all together, tissues mixed in a record."""
    case = deformed(name)
    count = len(case[0].cells)
    assert count % LANES
    assert len(set(case[0].regions[:LANES].tolist())) == 2 or count < LANES
    energy, residual, data = assembled(case, slice(0, count), True)
    parts = [assembled(case, slice(e, e + 1), True) for e in range(count)]
    assert sum(p[0] for p in parts) == pytest.approx(energy, rel=1e-12)
    np.testing.assert_allclose(sum(p[1] for p in parts), residual, atol=1e-13 * np.abs(residual).max())
    np.testing.assert_allclose(sum(p[2] for p in parts), data, atol=1e-13 * np.abs(data).max())
    alone = assembled(case, slice(0, count), False)
    assert alone[0] == energy
    np.testing.assert_array_equal(alone[1], residual)


@every_element
def test_elastic_stress_is_that_of_each_point(name):
    """From axes of C = F^T F, where the kernel takes those of F F^T; and it is none at rest."""
    system, laws, _, _, u = deformed(name)
    tissues = list(system.problem.materials.values())
    size = max(np.abs(tissue.table().terms[:, 0]).max() for tissue in tissues)
    assert np.abs(compute_elastic_stresses(system, laws, np.zeros_like(u))).max() <= 2e-16 * size
    stress = compute_elastic_stresses(system, laws, u)
    for el, q in np.ndindex(stress.shape[:2]):
        F = np.eye(3) + u[system.cells[el]].T @ system.gradients[el, q].T
        c2, N = np.linalg.eigh(F.T @ F)
        S = (N * (kirchhoff(tissues[system.regions[el]], np.sqrt(c2)) / c2)) @ N.T
        expected = S[[0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
        np.testing.assert_allclose(stress[el, q], expected, atol=1e-13 * np.abs(stress).max())


def test_an_inverted_element_is_infinite():
    system, laws, scale, K, u = deformed("tet10")
    u = u.copy()
    u[system.cells[-1, 0]] += 10.0
    assert assembled((system, laws, scale, K, u), slice(0, len(system.cells)), True)[0] == np.inf


@pytest.mark.parametrize("nodes", [4, 8, 10])
def test_every_entry_of_the_upper_triangle_has_its_place(nodes):
    """Entries of a symmetric matrix, put in blocks by their definition, are found again."""
    K = np.random.default_rng(2).normal(size=(3 * nodes, 3 * nodes))
    K += K.T
    numbers = np.zeros((nodes * (nodes + 1) // 2, 9, LANES))
    for b in range(nodes):
        for a in range(b + 1):
            numbers[b * (b + 1) // 2 + a, :, 5] = K[a::nodes, b::nodes].ravel()
    found = numbers.ravel()[block_places(nodes) + 5]
    np.testing.assert_array_equal(found, K[np.triu_indices(3 * nodes)])
