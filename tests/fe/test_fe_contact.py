"""Indenters and contact: derivatives, touch-down, penetration, robustness, partial results."""

import numpy as np
import pytest
from blocks import MUSCLE, SKIN, block, check_derivatives, drive, punch

from limbfit.errors import ProblemError
from limbfit.fe import History, Indenter, OgdenQLV, Problem, StepControl, System, solve
from limbfit.fe.system import Increment


@pytest.mark.parametrize(
    ("shape", "radius", "cell_type", "rule"),
    [
        ("square", 1.0, "tet10", "gauss"), ("square", 2.0, "tet10", "nodes"),
        ("square", 2.0, "tet4", "nodes"), ("square", 2.0, "tet4", "gauss"),
        ("square", 2.0, "hex8", "nodes"), ("square", 2.0, "hex8", "gauss"), ("sphere", 0.0, "tet10", "gauss"),
        ("cylinder", 1.0, "hex8", "nodes"), ("cylinder", 2.0, "tet10", "gauss"),
    ],
)  # fmt: skip
def test_contact_force_and_stiffness_are_derivatives_of_its_energy(shape, radius, cell_type, rule):
    tool = Indenter(shape, 20.0, radius, centre=(0.3, -0.4, 2.0), axis=(0.1, 0.05, -1.0))
    problem = punch(cell_type, 4, 1, indenter=tool, contact_rule=rule, start="as-given")
    system, laws = System(problem), problem.build_laws()
    rest = np.zeros((*system.weights.shape, 6))

    def at(u, d):
        return system.evaluate(u, laws, Increment(0.0, d, np.zeros(2), rest, 0.5, drive(d)))

    rng, h = np.random.default_rng(1), 1e-6
    u = 0.01 * rng.normal(size=system.points.shape) * ~system.supported
    d = rng.normal(size=u.shape) * ~system.supported
    here, _ = check_derivatives(system, lambda u: at(u, 2.6), u, d)
    assert here.contact_area > 0
    deeper, shallower = at(u, 2.6 + h), at(u, 2.6 - h)
    assert (deeper.energy - shallower.energy) / (2 * h) == pytest.approx(here.force, rel=1e-5)


def test_indenter_beside_the_faces_is_refused():
    with pytest.raises(ProblemError, match="never meets"):
        System(punch("tet10", 2, 1, indenter=Indenter(centre=(200.0, 0.0, 1.0))))


@pytest.mark.parametrize("cell_type", ["tet4", "tet10", "hex8"])
def test_punch_stays_out_and_comes_back_to_rest(cell_type):
    result = solve(punch(cell_type, 2, 1))
    assert result.completed, result.reason
    assert result.penetration.max() <= 0.01 * 6.0
    assert (result.force >= 0).all()
    assert result.times[np.argmax(result.force)] == pytest.approx(6.0 / 0.96)
    assert result.force[-1] == 0.0


@pytest.mark.parametrize(
    ("c", "m", "gamma", "tau"),
    [
        (4.7e-5, 20.0, 10.0, 0.01),
        pytest.param(0.047, 2.0, 0.01, 10.0, marks=pytest.mark.slow),
        pytest.param(0.047, 20.0, 10.0, 10.0, marks=pytest.mark.slow),
        pytest.param(4.7e-5, 2.0, 10.0, 10.0, marks=pytest.mark.slow),
    ],
)
def test_corners_of_the_parameter_bounds(c, m, gamma, tau):
    skin = OgdenQLV(c, m, gamma, tau)
    result = solve(punch("tet10", 2, 1, materials={"skin": skin, "muscle": MUSCLE}))
    assert result.completed, result.reason


@pytest.mark.parametrize("shape", ["square", pytest.param("sphere", marks=pytest.mark.slow)])
def test_thin_tissue_over_bone(shape):
    """4 mm of tissue pushed in by 2.4 mm by a sharp, tilted tool."""
    lines = np.linspace(-20.0, 20.0, 7)
    mesh = block("tet10", lines, lines, np.array([-4.0, -2.0, 0.0]), layer=2.0)
    tool = Indenter(shape, 20.0, 0.0, centre=(0, 0, 1), axis=(0.05, 0.1, -1.0))
    history = History(np.array([0.0, 2.5, 5.0]), np.array([0.0, 2.4, 0.0]))
    fixed, faces = mesh.node_sets["bottom"], mesh.face_sets["top"]
    result = solve(Problem(mesh, {"skin": SKIN, "muscle": MUSCLE}, fixed, faces, tool, history))
    assert result.completed, result.reason
    assert result.penetration.max() <= 0.024


def test_what_cannot_be_solved_is_a_partial_result_with_its_reason():
    """Slow at first, then 2 m/s: two Newton iterations and one cut do not get there."""
    history = History(np.array([0.0, 10.0, 10.01]), np.array([0.0, 1.0, 21.0]))
    times = (*np.linspace(0.1, 10.0, 40), 10.01)
    result = solve(
        punch("hex8", 2, 1, history=history), StepControl(times=times, max_iterations=5, max_cuts=1)
    )
    assert not result.completed
    assert "stopped at" in result.reason
    assert 2 < len(result.times) == len(result.force)
    assert result.force[-1] > result.force[1] > 0
