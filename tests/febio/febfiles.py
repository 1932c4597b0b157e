"""A small input of FEBio 4 that the tests of this folder change."""

import re
from pathlib import Path

import numpy as np

from limbfit.fe import Problem
from limbfit.febio import FebModel, FebSettings, read_feb, to_problem, write_feb

# The triangles of a box whose corners are numbered along x, then y, then z.
BOX_FACES = np.array(
    [[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 6, 7], [2, 7, 3], [0, 4, 6],
     [0, 6, 2], [1, 3, 7], [1, 7, 5]]
)  # fmt: skip

# One tetrahedron on the plane z = 0, its other node free; a rigid cube above it comes down on its upper face.
FEB = """<?xml version="1.0"?>
<febio_spec version="4.0"><Module type="solid"/>
<Control><analysis>STATIC</analysis><time_steps>4</time_steps><step_size>0.5</step_size></Control>
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
<Rigid><rigid_bc type="rigid_fixed"><rb>steel</rb><Rx_dof>1</Rx_dof><Ry_dof>1</Ry_dof><Ru_dof>1</Ru_dof>
<Rv_dof>1</Rv_dof><Rw_dof>1</Rw_dof></rigid_bc>
<rigid_bc type="rigid_displacement"><rb>steel</rb><dof>z</dof><value lc="1">-1</value></rigid_bc></Rigid>
<Contact><contact type="sliding-elastic" surface_pair="pair"/></Contact>
<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>
<points><pt>0,0</pt><pt>2,3</pt></points></load_controller></LoadData></febio_spec>
"""


def written(folder: Path, text: str, name: str = "model.feb") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def export(problem: Problem, folder: Path, settings: FebSettings | None = None) -> str:
    """What is written of a problem, in ``model.feb``."""
    write_feb(problem, folder / "model.feb", settings or FebSettings())
    return (folder / "model.feb").read_text(encoding="utf-8")


def back(problem: Problem, folder: Path, settings: FebSettings | None = None) -> tuple[Problem, FebModel]:
    """The problem, written and read, and what was read."""
    export(problem, folder, settings)
    model = read_feb(folder / "model.feb")
    return to_problem(model), model


def read_rows(file: Path, delimiter: str = ",") -> list[np.ndarray]:
    """The rows of every step of a table: the item's number, then its values."""
    steps = file.read_text().split("*Step")[1:]
    rows = [[line for line in step.splitlines()[1:] if not line.startswith("*")] for step in steps]
    return [np.array([line.split(delimiter) for line in step], dtype=float) for step in rows]


def changed(text, pattern, by):
    """The text with the one place of a pattern replaced."""
    found, count = re.subn(pattern, by, text, count=1)
    assert count == 1
    return found
