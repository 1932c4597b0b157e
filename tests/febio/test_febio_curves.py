"""Load curves between and beyond their points, as FEBio takes them; expressions of the time."""

from __future__ import annotations

import numpy as np
import pytest
from febfiles import FEB, written

from limbfit.errors import ProblemError
from limbfit.fe import Indenter
from limbfit.febio import build_step_control, read_feb, to_problem

POINTS = "<pt>0,0</pt><pt>1,2</pt><pt>2,3</pt><pt>4,1</pt>"


def curve(folder, interpolate, extend="CONSTANT", points=POINTS):
    text = FEB.replace("LINEAR</interpolate>", f"{interpolate}</interpolate><extend>{extend}</extend>")
    return read_feb(written(folder, text.replace("<pt>0,0</pt><pt>2,3</pt>", points))).curves[1]


def expression(folder, text):
    controller = f'<load_controller id="1" type="math"><math>{text}</math></load_controller>'
    head = FEB[: FEB.index("<load_controller")]
    return written(folder, f"{head}{controller}</LoadData></febio_spec>")


def lagrange(t, nodes):
    return sum(y * np.prod([(t - other) / (x - other) for other, _ in nodes if other != x]) for x, y in nodes)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("LINEAR", [0.0, 1.0, 2.0, 2.5, 2.0, 1.0]),
        ("STEP", [0.0, 2.0, 2.0, 3.0, 1.0, 1.0]),
        ("SMOOTH STEP", [0.0, 1.0, 2.0, 2.5, 2.0, 1.0]),
    ],
)
def test_between_points(tmp_path, kind, expected):
    times = np.array([0.0, 0.5, 1.0, 1.5, 3.0, 4.0])
    np.testing.assert_allclose(curve(tmp_path, kind).at(times), expected, atol=1e-14)


def test_smooth_is_two_parabolas(tmp_path):
    nodes = [(0.0, 0.0), (1.0, 2.0), (2.0, 3.0), (4.0, 1.0)]
    found = curve(tmp_path, "SMOOTH")
    first, last = (lambda t: lagrange(t, nodes[:3])), (lambda t: lagrange(t, nodes[1:]))
    assert found.at(0.3) == pytest.approx(first(0.3))  # at the ends one of them
    assert found.at(3.1) == pytest.approx(last(3.1))
    assert found.at(1.25) == pytest.approx(0.75 * first(1.25) + 0.25 * last(1.25))
    assert curve(tmp_path, "SMOOTH", points="<pt>0,0</pt><pt>2,3</pt>").at(0.5) == pytest.approx(0.75)
    three = curve(tmp_path, "SMOOTH", points="<pt>0,0</pt><pt>1,2</pt><pt>2,3</pt>")
    assert three.at(1.7) == pytest.approx(first(1.7))


@pytest.mark.parametrize(
    ("extend", "expected"),
    [
        ("CONSTANT", [0.0, 1.0, 1.0]),
        ("EXTRAPOLATE", [-2.0, 0.0, -4.0]),
        ("REPEAT", [2.0, 2.0, 1.0]),
        ("REPEAT OFFSET", [1.0, 3.0, 2.0]),
    ],
)
def test_beyond_points(tmp_path, extend, expected):
    found = curve(tmp_path, "LINEAR", extend)
    np.testing.assert_allclose(
        found.at(np.array([-1.0, 5.0, 9.0 - 1.0 * (extend[:6] == "REPEAT")])), expected
    )


def test_a_displacement_may_follow_any_curve(tmp_path):
    """FEBio knows it at the ends of its steps only; there limbfit's history has it."""
    smooth = FEB.replace("LINEAR", "SMOOTH STEP")
    sphere = Indenter("sphere", 8.0)
    model = read_feb(written(tmp_path, smooth))
    problem = to_problem(model, sphere)
    times = np.array(build_step_control(model, problem, penalty=1.0).times)
    w = times / 2.0
    np.testing.assert_allclose(problem.history.at(times), 3.0 * w**3 * (10 - 15 * w + 6 * w**2))
    math = expression(tmp_path, "1.5*t^2 - sin(pi*t)/2 + 0*exp(-t)")
    problem = to_problem(read_feb(math), sphere)
    np.testing.assert_allclose(problem.history.at(times), 1.5 * times**2 - np.sin(np.pi * times) / 2)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')", "t.real", "(t)(1)", "x+1", "t**2", "2^3^t", "1;2", "", "t[0]", "[t]", "True",
        "lambda: t", "log(t)", "sin(t, t)", "9" * 500, "(" * 100 + "t" + ")" * 101, "'a'", "t if t else 1",
    ],
)  # fmt: skip
def test_only_arithmetic_is_an_expression(tmp_path, text):
    with pytest.raises(ProblemError, match=r"line \d+, <math>: .* is no expression of t"):
        read_feb(expression(tmp_path, text))


def test_an_expression_that_breaks_is_refused_with_its_line(tmp_path):
    model = read_feb(expression(tmp_path, "1/(t-1)"))
    with pytest.raises(ProblemError, match=r"line \d+, <math>: '1/\(t-1\)' is not finite"):
        to_problem(model, Indenter("sphere", 8.0))
