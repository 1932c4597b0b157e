"""FEBio's files: what is read from them, load curves among it, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from febfiles import BOX_FACES, FEB, written

from limbfit.bench.timing import build_punched_block
from limbfit.errors import ProblemError
from limbfit.fe import Indenter, RigidSurface
from limbfit.febio import FebSettings, build_step_control, read_feb, read_log, to_problem, write_feb

BOX = np.array([[x, y, z] for z in (-2.0, 0.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
LOG = "*Step  = 0\n*Time  = 0\n*Data  = Fz;z\n3,0,5\n*Step  = 1\n*Time  = 0.5\n*Data  = Fz;z\n3,-0.25,4.5\n"


def test_a_feb_becomes_a_problem(tmp_path):
    problem = to_problem(read_feb(written(tmp_path, FEB)), Indenter("sphere", 8.0), contact_rule="gauss")
    np.testing.assert_array_equal(problem.mesh.points, [[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]])
    np.testing.assert_array_equal(problem.mesh.cells, [[0, 1, 2, 3]])
    np.testing.assert_array_equal(problem.fixed, [0, 1, 2])
    np.testing.assert_array_equal(problem.contact_faces, [[1, 2, 3]])
    assert [(s.nodes.tolist(), s.component, s.factor) for s in problem.supports] == [
        ([3], 0, 0.0),
        ([3], 1, 0.5),
    ]
    fat = problem.materials["body"]
    assert (fat.c, fat.m, fat.gamma, fat.tau) == (0.004, 6.0, 2.0, 0.5)
    assert fat.kappa_ratio * fat.c == pytest.approx(0.8)  # the wrapper's k and the elastic one's add up
    assert problem.indenter is not None
    np.testing.assert_array_equal(problem.indenter.axis, [0, 0, -1])
    np.testing.assert_array_equal(problem.indenter.centre, [0, 0, 4])  # the foremost of the rigid nodes
    assert problem.history.at(1.0) == 1.5
    assert problem.contact_rule == "gauss"


def test_a_feb_that_states_limbfits_units_is_read(tmp_path):
    stated = FEB.replace('type="solid"/>', 'type="solid">\n <units> mm-N-s </units></Module>', 1)
    np.testing.assert_array_equal(
        read_feb(written(tmp_path, stated)).geometry.node_ids, [7, 8, 9, 11, 12, 21]
    )


def test_missing_files_are_named(tmp_path):
    for read in (read_feb, read_log):
        with pytest.raises(ProblemError, match="nowhere"):
            read(tmp_path / "nowhere")


def test_a_log_is_read_by_column(tmp_path):
    log = read_log(written(tmp_path, LOG, "log.txt"))
    np.testing.assert_array_equal(log.times, [0.0, 0.5])
    np.testing.assert_array_equal(log.column("Fz"), [0.0, -0.25])
    np.testing.assert_array_equal(log.column("z"), [5.0, 4.5])


@pytest.mark.parametrize("cut", [1, 2, 4, 7, 10, 25, 40])
def test_a_step_cut_short_is_left_out(tmp_path, cut):
    """FEBio was killed while it wrote its second step."""
    log = read_log(written(tmp_path, LOG[:-cut], "log.txt"))
    assert log.times.tolist() == [0.0]
    assert log.values.shape == (1, 1, 2)


def test_an_empty_or_foreign_log_is_refused(tmp_path):
    with pytest.raises(ProblemError, match="no complete step"):
        read_log(written(tmp_path, "", "log.txt"))
    with pytest.raises(ProblemError, match=r"log.txt: 1"):
        read_log(written(tmp_path, "time,force\n1,2\n", "log.txt"))


V3 = (
    (' version="4.0"', ' version="3.0"'),
    (
        'type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof></bc>',
        'type="fix"><dofs>x,y,z</dofs></bc>',
    ),
    (
        'type="zero displacement"><x_dof>1</x_dof><y_dof>0</y_dof><z_dof>0</z_dof></bc>',
        'type="fix"><dofs>x</dofs></bc>',
    ),
    (
        'type="prescribed displacement"><dof>y</dof><value lc="1">0.5</value>',
        'type="prescribe"><dof>y</dof><scale lc="1">0.5</scale>',
    ),
    ('<NodeSet name="top">12</NodeSet>', '<NodeSet name="top"><n id="12"/></NodeSet>'),
    (
        '<rigid_bc type="rigid_fixed"><rb>steel</rb><Rx_dof>1</Rx_dof><Ry_dof>1</Ry_dof><Ru_dof>1</Ru_dof>\n'
        "<Rv_dof>1</Rv_dof><Rw_dof>1</Rw_dof></rigid_bc>",
        '<rigid_constraint type="fix"><rb>2</rb><dofs>Rx,Ry,Ru,Rv,Rw</dofs></rigid_constraint>',
    ),
    (
        '<rigid_bc type="rigid_displacement"><rb>steel</rb><dof>z</dof><value lc="1">-1</value></rigid_bc>',
        '<rigid_constraint type="prescribe"><rb>2</rb><dof>RZ</dof><value lc="1">-1</value>'
        "</rigid_constraint>",
    ),
    ("<pt>0,0</pt><pt>2,3</pt>", "<point>0,0</point><point>2,3</point>"),
)


def same(a, b):
    np.testing.assert_array_equal(a.mesh.points, b.mesh.points)
    np.testing.assert_array_equal(a.mesh.cells, b.mesh.cells)
    np.testing.assert_array_equal(a.fixed, b.fixed)
    np.testing.assert_array_equal(a.contact_faces, b.contact_faces)
    np.testing.assert_array_equal(a.history.displacement, b.history.displacement)
    assert [(s.nodes.tolist(), s.component, s.factor) for s in a.supports] == [
        (s.nodes.tolist(), s.component, s.factor) for s in b.supports
    ]
    assert a.materials == b.materials


def test_an_input_of_febio_3_is_the_same_problem(tmp_path):
    text = FEB
    for new, old in V3:
        assert new in text
        text = text.replace(new, old)
    sphere = Indenter("sphere", 8.0)
    old, new = (to_problem(read_feb(written(tmp_path, t)), sphere) for t in (text, FEB))
    same(old, new)


@pytest.mark.parametrize(
    ("given", "asked", "expected"),
    [
        ("", "@elem_set:body", [1, 2, 3, 4]),
        ('<ElementSet name="one">1</ElementSet>', "@elem_set:one", [1, 2, 3, 4]),
        ('<PartList name="soft">body</PartList>', "@part_list:soft", [1, 2, 3, 4]),
        ('<NodeSet name="rows">8\n 9, 11\n 12</NodeSet>', "rows", [1, 2, 3, 4]),
        ("", "all", [0, 1, 2, 3, 4, 5]),
    ],
)
def test_node_sets_of_elements_parts_and_nodes(tmp_path, given, asked, expected):
    text = FEB.replace("</Mesh>", f"{given}</Mesh>").replace('node_set="ground"', f'node_set="{asked}"')
    held = [m.nodes.tolist() for m in read_feb(written(tmp_path, text)).motions if m.target == asked]
    assert held == [expected] * 3


ELASTIC = '<elastic type="Ogden"><k>0.2</k><c1>0.004</c1><m1>6</m1><c2>0.004</c2><m2>-6</m2></elastic>'


@pytest.mark.parametrize(
    ("elastic", "law"),
    [
        ('<elastic type="Mooney-Rivlin"><k>0.2</k><c1>0.003</c1><c2>0.001</c2></elastic>', "MooneyRivlin"),
        ('<elastic type="incomp neo-Hookean"><k>0.2</k><G>0.008</G></elastic>', "NeoHookean"),
        ('<elastic type="Ogden"><k>0.2</k><c1>0.016</c1><m1>6</m1></elastic>', "Ogden"),
    ],
)
def test_laws(tmp_path, elastic, law):
    """All have mu = 0.008 MPa; g0 = 2 doubles it and halves the amplitude, the bulk modulus stays."""
    assert ELASTIC in FEB
    text = FEB.replace(ELASTIC, elastic).replace("<g0>1</g0>", "<g0>2</g0>")
    (fat,) = read_feb(written(tmp_path, text)).materials.values()
    assert type(fat).__name__ == law
    assert fat.shear_modulus == pytest.approx(0.016)
    assert fat.table().kappa == pytest.approx(0.8)
    assert fat.prony == ((1.0, 0.5),)


def test_volumetric_law_and_prony_series(tmp_path):
    text = FEB.replace("<g0>1</g0>", "<pressure_model>NIKE3D</pressure_model><g2>1</g2><t2>9</t2>")
    (fat,) = read_feb(written(tmp_path, text)).materials.values()
    assert fat.volumetric == "nike3d"
    assert fat.prony == ((2.0, 0.5), (1.0, 9.0))


def test_must_points_and_the_growing_step(tmp_path):
    stepper = "<time_stepper><dtmin>0.01</dtmin><dtmax lc='2'>1</dtmax></time_stepper></Control>"
    curve = (
        "<load_controller id='2' type='loadcurve'><interpolate>STEP</interpolate><points>"
        "<pt>0,0.3</pt><pt>0.5,0.3</pt><pt>2,0.3</pt></points></load_controller></LoadData>"
    )
    text = FEB.replace("<step_size>0.5", "<step_size>0.5").replace("</Control>", stepper)
    text = text.replace(
        "<time_steps>4</time_steps><step_size>0.5", "<time_steps>20</time_steps><step_size>0.1"
    )
    model = read_feb(written(tmp_path, text.replace("</LoadData>", curve)))
    times = build_step_control(model, to_problem(model, Indenter("sphere", 8.0)), penalty=1.0).times
    # a fifth of the way from 0.1 to 0.3 s each time: 0.1, 0.14, 0.172, ..; 0.5 s is met
    np.testing.assert_allclose(times[:4], [0.1, 0.24, 0.412, 0.5])
    assert times[-1] == pytest.approx(2.0)


def test_a_motion_backwards_pushes_the_other_way(tmp_path):
    """A negative curve is an advance along the other direction."""
    text = FEB.replace("<pt>2,3</pt>", "<pt>2,-3</pt>")
    problem = to_problem(read_feb(written(tmp_path, text)), Indenter("sphere", 8.0))
    assert problem.indenter is not None
    np.testing.assert_array_equal(problem.indenter.axis, [0, 0, 1])
    assert problem.history.at(2.0) == 3.0
    assert [s.factor for s in problem.supports] == [0.0, -0.5]


@pytest.mark.parametrize("thin", [1.0, 1e-2])
def test_edges_are_no_rounder_than_the_tissue_is_thick(tmp_path, thin):
    """A plate of 150 mm over a bar: 1 % of its width would be an edge of 1.5 mm."""
    plate = RigidSurface(np.array([75.0, 75.0, 5.0]) * BOX, BOX_FACES)
    problem = build_punched_block("hex8", 2)
    points = problem.mesh.points * [1.0, 1.0, thin]
    tool = Indenter("stl", centre=(0.0, 0.0, 1.0), axis=(0.0, 0.0, -1.0), surface=plate)
    problem = replace(problem, mesh=problem.mesh.with_points(points), indenter=tool)
    write_feb(problem, tmp_path / "model.feb", FebSettings())
    found = to_problem(read_feb(tmp_path / "model.feb")).indenter
    assert found.body.radius == pytest.approx(min(1.5, 3.0 * thin))


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
