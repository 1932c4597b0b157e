"""Rigid bodies of an input: tissue that they carry, how they are held, and what is refused of them."""

from __future__ import annotations

import numpy as np
import pytest
from febfiles import FEB, written

from limbfit.errors import ProblemError
from limbfit.febio import read_feb, read_log, run_feb, to_problem

G, K = 0.01, 0.5
# A cube of 10 mm in two elements, its bottom held, its waist free along z; a rigid plate on its top shares
# its nodes and comes down by 3 mm.
CUBE = f"""<?xml version="1.0"?>
<febio_spec version="4.0"><Module type="solid"/>
<Control><analysis>STATIC</analysis><time_steps>4</time_steps><step_size>0.25</step_size>
<solver type="solid"><dtol>1e-9</dtol></solver></Control>
<Material><material id="1" name="gel" type="incomp neo-Hookean"><G>{G}</G><k>{K}</k></material>
<material id="2" name="plate" type="rigid body"><center_of_mass>5,5,11</center_of_mass></material></Material>
<Mesh><Nodes name="all"><node id="1">0,0,0</node><node id="2">10,0,0</node><node id="3">10,10,0</node>
<node id="4">0,10,0</node><node id="5">0,0,10</node><node id="6">10,0,10</node><node id="7">10,10,10</node>
<node id="8">0,10,10</node><node id="9">0,0,12</node><node id="10">10,0,12</node><node id="11">10,10,12</node>
<node id="12">0,10,12</node><node id="21">0,0,5</node><node id="22">10,0,5</node><node id="23">10,10,5</node>
<node id="24">0,10,5</node></Nodes>
<Elements type="hex8" name="cube"><elem id="1">1,2,3,4,21,22,23,24</elem>
<elem id="3">21,22,23,24,5,6,7,8</elem></Elements>
<Elements type="hex8" name="lid"><elem id="2">5,6,7,8,9,10,11,12</elem></Elements>
<NodeSet name="base">1:4</NodeSet><NodeSet name="waist">21:24</NodeSet>
<NodeSet name="top">5:8</NodeSet></Mesh>
<MeshDomains><SolidDomain name="cube" mat="gel"/><SolidDomain name="lid" mat="plate"/></MeshDomains>
<Boundary><bc node_set="base" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof></bc>
<bc node_set="waist" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>0</z_dof></bc></Boundary>
<Rigid><rigid_bc type="rigid_fixed"><rb>plate</rb><Rx_dof>1</Rx_dof><Ry_dof>1</Ry_dof><Ru_dof>1</Ru_dof>
<Rv_dof>1</Rv_dof><Rw_dof>1</Rw_dof></rigid_bc>
<rigid_bc type="rigid_displacement"><rb>plate</rb><dof>z</dof><value lc="1">-1</value></rigid_bc></Rigid>
<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>
<points><pt>0,0</pt><pt>1,3</pt></points></load_controller></LoadData>
<Output><logfile><rigid_body_data data="Fx;Fy;Fz;z" file="plate.txt" delim=","></rigid_body_data>
<node_data data="z" file="nodes.txt" delim=","></node_data></logfile></Output></febio_spec>
"""
OWN = "5,6,7,8,9,10,11,12"
TIED = '<bc node_set="top" type="rigid"><rb>plate</rb></bc></Boundary>'


def apart() -> str:
    """The plate has nodes of its own, and the top of the cube is tied to it."""
    more = "".join(f'<node id="{n}">{x},{y},10</node>' for n, x, y in
                   ((13, 0, 0), (14, 10, 0), (15, 10, 10), (16, 0, 10)))  # fmt: skip
    text = CUBE.replace("</Nodes>", more + "</Nodes>").replace(OWN, "13,14,15,16,9,10,11,12")
    return text.replace("</Boundary>", TIED)


@pytest.mark.parametrize("text", [CUBE, apart()], ids=["shared nodes", "tied nodes"])
def test_tissue_goes_with_the_rigid_body_that_carries_it(tmp_path, text):
    """Uniaxial strain: J = lambda, sigma = 2/3 G J^(-5/3) (lambda^2 - 1) + k ln J / J over 100 mm^2."""
    assert run_feb(written(tmp_path, text), tmp_path / "out").result.completed
    log = read_log(tmp_path / "out" / "plate.txt")
    J = 1.0 - 0.3 * log.times
    stress = 2.0 / 3.0 * G * J ** (-5.0 / 3.0) * (J**2 - 1.0) + K * np.log(J) / J
    np.testing.assert_allclose(log.column("Fz"), 100.0 * stress, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(log.column("z"), 11.0 - 3.0 * log.times)
    assert np.abs(log.column("Fx")).max() < 1e-9 * np.abs(log.column("Fz")).max()  # N, by symmetry
    last = (tmp_path / "out" / "nodes.txt").read_text().rpartition("*Data")[2].splitlines()[1:]
    heights = {int(row.split(",")[0]): float(row.split(",")[1]) for row in last}
    assert [heights[node] for node in (5, 6, 7, 8)] == pytest.approx([7.0] * 4)
    assert [heights[node] for node in (9, 10, 11, 12)] == pytest.approx([9.0] * 4)
    assert [heights[node] for node in (21, 22, 23, 24)] == pytest.approx([3.5] * 4, rel=1e-6)


def test_a_body_that_is_held_holds_what_it_carries(tmp_path):
    zero = 'node_set="base" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof>'
    assert zero in CUBE
    text = CUBE.replace(zero, 'node_set="base" type="rigid"><rb>bone</rb>').replace("</Material>", BONE)
    held = "".join(f"<R{x}_dof>1</R{x}_dof>" for x in "xyzuvw")
    text = text.replace("<Rigid>", f'<Rigid><rigid_bc type="rigid_fixed"><rb>bone</rb>{held}</rigid_bc>')
    problem = to_problem(read_feb(written(tmp_path, text)))
    np.testing.assert_array_equal(problem.fixed, [0, 1, 2, 3])
    moved = [(s.component, s.factor) for s in problem.supports if s.nodes.tolist() == [4, 5, 6, 7]]
    assert moved == [(0, 0.0), (1, 0.0), (2, -1.0)]


BONE = '<material id="3" name="bone" type="rigid body"/></Material>'
TWO = '<bc node_set="top" type="rigid"><rb>bone</rb></bc></Boundary>'
ELSEWHERE = '<bc node_set="top" type="zero displacement"><z_dof>1</z_dof></bc></Boundary>'
FORCE = (
    '<rigid_load type="rigid_force"><rb>plate</rb><dof>Rx</dof><value lc="1">1</value></rigid_load></Rigid>'
)
TURN = '<rigid_bc type="rigid_rotation"><rb>plate</rb><dof>Ru</dof><value lc="1">1</value></rigid_bc></Rigid>'
LOCK = '<rigid_connector type="rigid lock"/></Rigid>'
REFUSED = {
    "free to turn": (
        CUBE.replace("<Ru_dof>1</Ru_dof>", ""),
        r"line \d+, <material>: the rigid body 'plate' is neither fixed nor displaced in Ru; limbfit solves",
    ),
    "free to move": (CUBE.replace("<Rx_dof>1</Rx_dof>", ""), "neither fixed nor displaced in Rx"),
    "turned": (
        CUBE.replace("<Ru_dof>1</Ru_dof>", "").replace("</Rigid>", TURN),
        r"line \d+: the rigid body 'plate' carries tissue, and turns",
    ),
    "pushed": (
        CUBE.replace("<Rx_dof>1</Rx_dof>", "").replace("</Rigid>", FORCE),
        "neither fixed nor displaced in Rx; limbfit solves only for bodies that carry no tissue",
    ),
    "joined": (CUBE.replace("</Rigid>", LOCK), "<rigid_connector>: 'rigid lock' is not supported"),
    "held elsewhere": (
        CUBE.replace("</Boundary>", ELSEWHERE),
        r"line \d+: node 5 of 'top' moves with the rigid body 'plate', which goes elsewhere",
    ),
    "of two bodies": (
        CUBE.replace("</Boundary>", TWO).replace("</Material>", BONE),
        "node 5 is of two rigid bodies, 'plate' and 'bone'",
    ),
    "carries nothing": (
        apart().replace(TIED, "</Boundary>"),
        r"line \d+: the rigid body 'plate' moves, and neither touches nor carries tissue",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_limbfit_cannot_do_with_a_body_is_refused(tmp_path, case):
    text, words = REFUSED[case]
    assert text != CUBE
    with pytest.raises(ProblemError, match=words):
        run_feb(written(tmp_path, text), tmp_path / "out")


def test_a_rotation_by_nothing_holds(tmp_path):
    zero = '<rigid_bc type="rigid_rotation"><rb>steel</rb><dof>Ru</dof><value>0</value></rigid_bc></Rigid>'
    read_feb(written(tmp_path, FEB.replace("<Ru_dof>1</Ru_dof>", "").replace("</Rigid>", zero)))
