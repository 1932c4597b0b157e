"""FEBio inputs solved by limbfit: held to FEBio's own results through the files, and to simple truths."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from febfiles import FEB, read_rows, written

from limbfit import simulate_feb
from limbfit.bench.timing import build_punched_block
from limbfit.errors import InputError, ProblemError
from limbfit.fe import History, Indenter
from limbfit.febio import FebSettings, compute_axial_force, read_feb, read_log, run_feb, to_problem, write_feb
from limbfit.febio.reading.geometry import Part
from limbfit.febio.reading.rigid import compute_centre_of_mass
from reference import REFERENCE, recorded

CUBES = ("skin", "lim_par")  # the others are held to FEBio in tests/fe/test_fe_febio.py
PUNCHED = ("block/block_hex8", "block/block_tet4", "block/block_tet10", "residuum/posterior_tet4",
           "residuum/posterior_tet10")  # fmt: skip


def both(case, folder):
    """FEBio's table of a case and limbfit's for the same file."""
    (table,) = run_feb(REFERENCE / f"{case}.feb", folder).files
    assert table.name == f"{Path(case).name}.txt"
    return read_log(REFERENCE / f"{case}.txt"), read_log(table)


@recorded
@pytest.mark.parametrize("tissue", CUBES)
def test_cube(tmp_path, tissue):
    """Axial stress and volume ratio, step by step; the side stresses are zero in both."""
    febio, mine = both(f"cube/cube_{tissue}", tmp_path)
    assert mine.names == febio.names
    np.testing.assert_allclose(mine.times, febio.times, rtol=1e-9)
    peak = np.abs(febio.column("sz")).max()
    np.testing.assert_allclose(mine.column("sz"), febio.column("sz"), atol=1e-6 * peak)
    np.testing.assert_allclose(mine.column("J"), febio.column("J"), rtol=1e-6)
    for side in ("sx", "sy"):
        assert np.abs(mine.column(side)).max() < 1e-6 * peak


@recorded
@pytest.mark.slow
@pytest.mark.parametrize("case", PUNCHED)
def test_punch(tmp_path, case):
    """Force along the axis over the whole curve within 1 %; FEBio's steps are foreseen."""
    febio, mine = both(case, tmp_path)
    assert abs(len(mine.times) - len(febio.times)) <= 1
    travel = {x: np.ptp(febio.column(x)) for x in "xyz" if x in febio.names}
    strongest = "F" + max(travel, key=lambda x: travel[x])  # the axes lie within 1 degree of x, y or z
    theirs = febio.column(strongest)
    ours = np.interp(febio.times, mine.times, mine.column(strongest))
    assert np.abs(ours - theirs).max() < 0.01 * np.abs(theirs).max()


@recorded
@pytest.mark.slow
def test_written_anew(tmp_path):
    """FEBio's input read, written with limbfit's own punch, steps and search, read and solved again.

    With the automatic penalty of FEBio's run: limbfit's own is stiffer, by 7 % of the force here.
    """
    case = REFERENCE / "residuum" / "posterior_tet4"
    problem = to_problem(read_feb(f"{case}.feb"), Indenter("square", 20.0, 2.0))
    write_feb(problem, tmp_path / "anew.feb", FebSettings(penalty=3.0))
    result = run_feb(tmp_path / "anew.feb", tmp_path / "out").result
    log = read_log(f"{case}.txt")
    force = compute_axial_force(problem, log)
    assert result.completed
    assert np.abs(np.interp(log.times, result.times, result.force) - force).max() < 0.015 * force.max()


CUBE = """<?xml version="1.0"?>
<febio_spec version="4.0"><Module type="solid"/>
<Control><analysis>STATIC</analysis><time_steps>4</time_steps><step_size>0.25</step_size>
<solver type="solid"><dtol>1e-9</dtol></solver></Control>
<Material><material id="1" name="gel" type="incomp neo-Hookean"><G>0.01</G><k>100</k></material></Material>
<Mesh><Nodes name="all"><node id="1">0,0,0</node><node id="2">10,0,0</node><node id="3">10,10,0</node>
<node id="4">0,10,0</node><node id="5">0,0,10</node><node id="6">10,0,10</node><node id="7">10,10,10</node>
<node id="8">0,10,10</node></Nodes>
<Elements type="hex8" name="part"><elem id="5">1,2,3,4,5,6,7,8</elem></Elements>
<NodeSet name="x0">1,4,5,8</NodeSet><NodeSet name="y0">1,2,5,6</NodeSet><NodeSet name="z0">1:4</NodeSet>
<Surface name="top"><quad4 id="1">5,6,7,8</quad4></Surface></Mesh>
<MeshDomains><SolidDomain name="part" mat="gel"/></MeshDomains>
<Boundary><bc node_set="x0" type="zero displacement"><x_dof>1</x_dof></bc>
<bc node_set="y0" type="zero displacement"><y_dof>1</y_dof></bc>
<bc node_set="z0" type="zero displacement"><z_dof>1</z_dof></bc>
<bc node_set="@surface:top" type="prescribed displacement"><dof>z</dof><value lc="1">-1</value></bc>
</Boundary>
<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>
<points><pt>0,0</pt><pt>1,3</pt></points></load_controller></LoadData>
<Output><plotfile type="febio"><var type="stress"/></plotfile><logfile>
<node_data data="z;uz;vx" file="nodes.txt" delim=",">5:7</node_data>
<element_data data="sz;s3;s1;J;x;y;z" file="cells.txt"></element_data></logfile></Output></febio_spec>
"""


def test_an_incompressible_cube(tmp_path):
    """sigma = G (lambda^2 - 1/lambda) in one direction, none across; tables as the input asks."""
    run = run_feb(written(tmp_path, CUBE), tmp_path / "out")
    assert run.result.completed
    assert read_log(tmp_path / "out" / "nodes.txt").names == ("z", "uz")  # velocities are left out
    nodes = np.array(read_rows(tmp_path / "out" / "nodes.txt"))
    cells = np.array(read_rows(tmp_path / "out" / "cells.txt", " "))
    assert any("'vx'" in note for note in run.notes)
    assert any("plotfile" in note for note in run.notes)
    stretch = 1.0 - 0.3 * np.arange(5) / 4
    np.testing.assert_array_equal(nodes[..., 0], [[5.0, 6.0, 7.0]] * 5)
    np.testing.assert_allclose(nodes[..., 1], np.tile(10.0 * stretch, (3, 1)).T)
    assert cells.shape[:2] == (5, 1)
    number, stress, least, most, volume, *middle = cells[:, 0].T
    np.testing.assert_allclose(stress, 0.01 * (stretch**2 - 1.0 / stretch), rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(least, stress, atol=1e-12)
    np.testing.assert_allclose(most, 0.0, atol=1e-6)
    np.testing.assert_allclose(volume, 1.0, atol=1e-3)
    np.testing.assert_allclose(middle[2], 5.0 * stretch)
    assert set(number) == {5.0}


def test_tables_are_not_written_over(tmp_path):
    file = written(tmp_path, CUBE)
    (tmp_path / "cells.txt").write_text("FEBio's own")
    with pytest.raises(InputError, match="is there already"):
        simulate_feb(file, listener=lambda _: None)
    assert (tmp_path / "cells.txt").read_text() == "FEBio's own"
    found = simulate_feb(file, tmp_path / "out", listener=lambda _: None)
    assert Path(found["fields"]).is_file()
    file.write_text(CUBE.replace("nodes.txt", file.name))
    with pytest.raises(InputError, match="is there already"):  # never over the input itself
        simulate_feb(file, tmp_path, listener=lambda _: None)
    assert file.read_text().startswith("<?xml")


def test_command(tmp_path, limbfit):
    file = written(tmp_path, CUBE)
    command = ("febio", file, "--output", tmp_path / "o", "--json")
    code, shown, said = limbfit(*command)
    assert code == 0, said
    found = json.loads(shown)
    assert found["completed"]
    assert found["steps"] == 4
    assert found["peak_force_N"] is None
    file.write_text(CUBE.replace("incomp neo-Hookean", "Arruda-Boyce"))
    code, _, said = limbfit(*command)
    assert code == 2
    assert said.strip().split("\n")[-1].startswith(f"error: {file}: line 5, <material>: ")


TABLES = """<Output><logfile>
<node_data data="z;uz" file="nodes.txt" delim=","></node_data>
<node_data data="uz" file="set.txt" delim="," node_set="bottom"></node_data>
<node_data data="uz" file="surface.txt" delim="," node_set="@surface:contact_patch"></node_data>
<element_data data="sz;J;z" file="cells.txt" delim=","></element_data>
<element_data data="sz" file="skin.txt" delim="," elem_set="skin"></element_data>
<element_data data="z" file="punch.txt" delim="," elem_set="indenter"></element_data>
<element_data data="z" file="two.txt" delim="," elem_set="two"></element_data>
</logfile></Output>"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    ramp = History(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    problem = replace(build_punched_block("hex8", 4), history=ramp)
    tool = write_feb(problem, folder / "model.feb", FebSettings())
    text = (folder / "model.feb").read_text()
    text = re.sub("<Output>.*</Output>", TABLES, text, flags=re.DOTALL)
    text = text.replace("<SurfacePair", '<ElementSet name="two">1,3</ElementSet><SurfacePair', 1)
    file = written(folder, text, "tables.feb")
    run = run_feb(file, folder / "out", times=(0.5, 1.0))
    assert run.result.completed
    return problem, tool, run, folder / "out"


def test_rigid_nodes_and_elements_are_in_the_tables(ran):
    problem, tool, _, out = ran
    nodes, cells = (read_rows(out / name)[-1] for name in ("nodes.txt", "cells.txt"))
    count = len(problem.mesh.points)
    np.testing.assert_array_equal(nodes[:, 0], np.arange(1, count + len(tool.points) + 1))
    np.testing.assert_allclose(nodes[count:, 2], -1.0, rtol=1e-12)
    np.testing.assert_allclose(nodes[count:, 1], tool.points[:, 2] - 1.0, rtol=1e-9)
    np.testing.assert_array_equal(cells[:, 0], np.arange(1, len(problem.mesh.cells) + len(tool.cells) + 1))
    rigid = cells[len(problem.mesh.cells) :]
    np.testing.assert_array_equal(
        rigid[:, 1:3], np.column_stack([0.0 * rigid[:, 0], 1.0 + 0.0 * rigid[:, 0]])
    )
    np.testing.assert_allclose(rigid[:, 3], tool.points[tool.cells][:, :, 2].mean(axis=1) - 1.0)
    assert (cells[: len(problem.mesh.cells), 1] != 0.0).all()


def test_tables_of_sets_and_parts(ran):
    problem, tool, _, out = ran
    numbers = {file.stem: read_rows(file)[-1][:, 0] for file in out.glob("*.txt")}
    np.testing.assert_array_equal(numbers["set"], np.sort(problem.mesh.node_sets["bottom"]) + 1)
    np.testing.assert_array_equal(numbers["surface"], np.unique(problem.contact_faces) + 1)
    skin = int((problem.mesh.regions == problem.mesh.region_names.index("skin")).sum())
    assert len(numbers["skin"]) == skin
    assert len(numbers["punch"]) == len(tool.cells)
    np.testing.assert_array_equal(numbers["two"], [1.0, 3.0])


@pytest.mark.parametrize("tag", ['node_data data="x" node_set', 'element_data data="x" elem_set'])
def test_a_set_that_is_not_there_is_refused(tmp_path, tag):
    entry = f'<Output><logfile><{tag}="none"/></logfile></Output></febio_spec>'
    with pytest.raises(ProblemError, match=r"line \d+, <\w+_data>: there is no (node|element) set 'none'"):
        read_feb(written(tmp_path, FEB.replace("</febio_spec>", entry)))


SKEWED = np.array([[2.0, 0.3, 0.1], [0.2, 1.5, 0.0], [-0.1, 0.4, 1.2]])
UNIT = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def part(kind, cells, thickness=0.0):
    return Part(kind, np.array(cells), "steel", np.arange(len(cells)), "", 1, thickness)


@pytest.mark.parametrize(
    ("kind", "cell"),
    [
        ("hex8", [0, 1, 2, 3, 4, 5, 6, 7]),
        ("penta6", [0, 1, 3, 4, 5, 7]),
        ("tet4", [0, 1, 3, 4]),
        ("tri3", [0, 1, 6]),
        ("quad4", [0, 1, 6, 7]),
    ],
)
def test_the_mass_of_a_straight_cell_lies_in_its_middle(kind, cell):
    points = UNIT @ SKEWED
    found = compute_centre_of_mass(points, [part(kind, [cell], 0.5)])
    np.testing.assert_allclose(found, points[cell].mean(axis=0), atol=1e-12)


def test_masses_add_up():
    points = np.vstack([UNIT, [[3.0, 0, 0], [4.0, 0, 0], [3.0, 1, 0]]]).astype(float)
    both = [part("hex8", [[0, 1, 2, 3, 4, 5, 6, 7]]), part("tri3", [[8, 9, 10]], 2.0)]
    # one cubic millimetre around 0.5, another (0.5 mm^2 of 2 mm) around 10/3
    np.testing.assert_allclose(compute_centre_of_mass(points, both)[0], 0.5 * (0.5 + 10.0 / 3.0))


def test_a_rigid_body_without_a_centre_reports_where_its_mass_is(tmp_path):
    problem = replace(
        build_punched_block("hex8", 2), history=History(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    )
    tool = write_feb(problem, tmp_path / "model.feb", FebSettings())
    text = re.sub("<center_of_mass>.*</center_of_mass>", "", (tmp_path / "model.feb").read_text())
    model = read_feb(written(tmp_path, text))
    (body,) = model.rigid.values()
    corners = tool.points[tool.cells]
    assert abs(body.centre[0]) < 1e-9
    assert abs(body.centre[1]) < 1e-9
    assert corners[..., 2].min() < body.centre[2] < corners[..., 2].max()


def test_a_material_of_no_part_is_left_out(tmp_path):
    odd = '<material id="9" name="gel" type="Arruda-Boyce"><mu>1</mu></material></Material>'
    model = read_feb(written(tmp_path, FEB.replace("</Material>", odd)))
    assert "gel" not in model.materials
    assert any("material 'gel' not read: no part is made of it" in note for note in model.notes)
