"""FEBio's files: what is read from them, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from limbfit.errors import ProblemError
from limbfit.fe import Indenter
from limbfit.febio import read_feb, read_log, to_problem

# One tetrahedron on the plane z = 0, its other node free; a rigid cube above it comes down on its upper face.
FEB = """<?xml version="1.0"?>
<febio_spec version="4.0"><Module type="solid"/>
<Material>
<material id="1" name="fat" type="uncoupled viscoelastic"><k>0.6</k><g0>1</g0><g1>2</g1><t1>0.5</t1>
 <elastic type="Ogden"><k>0.2</k><c1>0.004</c1><m1>6</m1><c2>0.004</c2><m2>-6</m2></elastic></material>
<material id="2" name="steel" type="rigid body"><center_of_mass>0,0,5</center_of_mass></material>
</Material>
<Mesh><Nodes name="all"><node id="7">9,9,9</node><node id="8">0,0,0</node><node id="9">2,0,0</node>
<node id="11">0,2,0</node><node id="12">0,0,2</node>
<node id="21">1,1,4</node></Nodes>
<Elements type="tet4" name="body"><elem id="1">8,9,11,12</elem></Elements>
<Elements type="tri3" name="punch"><elem id="2">21,7,7</elem></Elements>
<NodeSet name="ground">8,9,11</NodeSet><NodeSet name="top">12</NodeSet>
<Surface name="skin"><tri3 id="1">9,11,12</tri3></Surface>
<Surface name="face"><tri3 id="1">21,7,7</tri3></Surface>
<SurfacePair name="pair"><primary>skin</primary><secondary>face</secondary></SurfacePair></Mesh>
<MeshDomains><SolidDomain name="body" mat="fat"/><ShellDomain name="punch" mat="steel"/></MeshDomains>
<Boundary><bc node_set="ground" type="zero displacement"><x_dof>1</x_dof><y_dof>1</y_dof><z_dof>1</z_dof></bc>
<bc node_set="top" type="zero displacement"><x_dof>1</x_dof><y_dof>0</y_dof><z_dof>0</z_dof></bc>
<bc node_set="top" type="prescribed displacement"><dof>y</dof><value lc="1">0.5</value></bc></Boundary>
<Rigid><rigid_bc type="rigid_fixed"><rb>steel</rb></rigid_bc>
<rigid_bc type="rigid_displacement"><rb>steel</rb><dof>z</dof><value lc="1">-1</value></rigid_bc></Rigid>
<Contact><contact type="sliding-elastic" surface_pair="pair"/></Contact>
<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>
<points><pt>0,0</pt><pt>2,3</pt></points></load_controller></LoadData></febio_spec>
"""
LOG = "*Step  = 0\n*Time  = 0\n*Data  = Fz;z\n3,0,5\n*Step  = 1\n*Time  = 0.5\n*Data  = Fz;z\n3,-0.25,4.5\n"


def written(folder: Path, text: str, name: str = "model.feb") -> Path:
    file = folder / name
    file.write_text(text)
    return file


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


@pytest.mark.parametrize(
    ("old", "new", "fragment"),
    [
        ('version="4.0"', 'version="2.5"', "no input of FEBio 4"),
        ("</Mesh>", "", "not well-formed XML"),
        ('type="Ogden"', 'type="Arruda-Boyce"', "material fat"),
        ("<m2>-6</m2>", "<m2>-5</m2>", "one Ogden pair"),
        ("<t1>0.5</t1>", "<t1>0.5</t1><g2>1</g2><t2>9</t2>", "one Prony term"),
        ("<c1>0.004</c1>", "", "<c1>"),
        ('type="prescribed displacement"', 'type="linear constraint"', "linear constraint"),
        ("8,9,11,12", "8,9,11,13", "13"),
        ("LINEAR", "STEP", "linear load curve"),
    ],
)
def test_what_is_not_understood_is_refused(tmp_path, old, new, fragment):
    assert old in FEB
    file = written(tmp_path, FEB.replace(old, new, 1))
    with pytest.raises(ProblemError, match=fragment) as caught:
        read_feb(file)
    assert str(file) in str(caught.value)


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
