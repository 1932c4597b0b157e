"""The tables of an input: sets, rigid bodies among the rest, masses that the input leaves to FEBio."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from febfiles import FEB, written

from limbfit.bench.blocks import build_punched_block
from limbfit.errors import ProblemError
from limbfit.fe import History
from limbfit.febio import FebSettings, read_feb, run_feb, write_feb
from limbfit.febio.reading.geometry import Part
from limbfit.febio.reading.rigid import compute_centre_of_mass

TABLES = """<Output><logfile>
<node_data data="z;uz" file="nodes.txt" delim=","></node_data>
<node_data data="uz" file="set.txt" delim="," node_set="bottom"></node_data>
<node_data data="uz" file="surface.txt" delim="," node_set="@surface:contact_patch"></node_data>
<element_data data="sz;J;z" file="cells.txt" delim=","></element_data>
<element_data data="sz" file="skin.txt" delim="," elem_set="skin"></element_data>
<element_data data="z" file="punch.txt" delim="," elem_set="indenter"></element_data>
<element_data data="z" file="two.txt" delim="," elem_set="two"></element_data>
</logfile></Output>"""


def last_step(file):
    """The rows of the last step: number, then values."""
    rows = []
    for line in file.read_text().splitlines():
        if line.startswith("*Step"):
            rows = []
        elif not line.startswith("*"):
            rows.append([float(value) for value in line.split(",")])
    return np.array(rows)


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
    nodes, cells = last_step(out / "nodes.txt"), last_step(out / "cells.txt")
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
    np.testing.assert_array_equal(
        last_step(out / "set.txt")[:, 0], np.sort(problem.mesh.node_sets["bottom"]) + 1
    )
    np.testing.assert_array_equal(last_step(out / "surface.txt")[:, 0], np.unique(problem.contact_faces) + 1)
    skin = int((problem.mesh.regions == problem.mesh.region_names.index("skin")).sum())
    assert len(last_step(out / "skin.txt")) == skin
    assert len(last_step(out / "punch.txt")) == len(tool.cells)
    np.testing.assert_array_equal(last_step(out / "two.txt")[:, 0], [1.0, 3.0])


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
