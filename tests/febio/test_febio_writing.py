"""What is written for FEBio and Abaqus is the same problem, read by limbfit itself and by others."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from febfiles import BOX_FACES

from limbfit.bench.timing import build_punched_block
from limbfit.errors import ProblemError
from limbfit.fe import History, Indenter, Ogden, OgdenQLV, RigidSurface, StepControl, System, solve
from limbfit.fe.solution.control import schedule_steps
from limbfit.febio import (
    FebSettings,
    ParameterRange,
    RunVerdict,
    build_contact,
    build_result,
    build_step_control,
    read_feb,
    read_log,
    run_feb,
    to_problem,
    turn_to_indenter_frame,
    write_feb,
    write_inp,
    write_optimisation,
)
from limbfit.mesh import Mesh, node_jacobians

AXIS = np.array([0.1, -0.05, -1.0])
BOX = np.array([[x, y, z] for z in (-6.0, 0.0) for y in (-4.0, 4.0) for x in (-4.0, 4.0)])
INDENTERS = {
    "square": Indenter("square", 20.0, 2.0, (0, 0, 5), AXIS),
    "sharp": Indenter("square", 20.0, 0.0, (0, 0, 5), AXIS, edge=(1.0, 1.0, 0.0)),
    "cylinder": Indenter("cylinder", 16.0, 1.0, (1, 2, 5), AXIS),
    "sphere": Indenter("sphere", 18.0, 0.0, (1, 2, 5), AXIS),
    "stl": Indenter("stl", centre=(0, 0, 5), axis=AXIS, surface=RigidSurface(BOX, BOX_FACES)),
}


def block(element="tet4", shape="square", divisions=4):
    return replace(build_punched_block(element, divisions), indenter=INDENTERS[shape])


def exported(problem, folder, **settings):
    file = folder / "model.feb"
    tool = write_feb(problem, file, FebSettings(**settings))
    return file, tool


@pytest.mark.parametrize("element", ["tet4", "tet10", "tet10p0", "tet10g8", "hex8"])
def test_it_is_read_back_as_it_was(tmp_path, element):
    problem = block(element)
    file, _ = exported(problem, tmp_path)
    model = read_feb(file)
    found = to_problem(model)
    order = np.argsort(problem.mesh.regions, kind="stable")  # parts one after the other
    np.testing.assert_array_equal(found.mesh.points, problem.mesh.points)
    np.testing.assert_array_equal(found.mesh.cells, problem.mesh.cells[order])
    np.testing.assert_array_equal(found.mesh.regions, problem.mesh.regions[order])
    assert found.mesh.region_names == problem.mesh.region_names
    np.testing.assert_array_equal(found.mesh.node_sets["bottom"], problem.mesh.node_sets["bottom"])
    np.testing.assert_array_equal(found.fixed, np.unique(problem.fixed))
    np.testing.assert_array_equal(found.contact_faces, problem.contact_faces)
    np.testing.assert_array_equal(found.history.times, problem.history.times)
    np.testing.assert_allclose(found.history.displacement, problem.history.displacement, rtol=1e-14)
    assert found.formulation.name == element
    for name in problem.mesh.region_names:
        mine, back = problem.materials[name].table(), found.materials[name].table()
        np.testing.assert_array_equal(back.terms, mine.terms)
        np.testing.assert_array_equal(back.prony, mine.prony)
        assert back.kappa == pytest.approx(mine.kappa, rel=1e-14)
    times = build_step_control(model, found).times
    assert set(np.round(schedule_steps(problem.history, StepControl()), 9)) <= set(np.round(times, 9))


@pytest.mark.parametrize("terms", [1, 2, 6])
def test_every_relaxation_term_is_read_back(tmp_path, terms):
    tissue = OgdenQLV(0.004, 5.0, np.linspace(0.2, 1.7, terms), np.geomspace(0.03, 7.0, terms))
    problem = replace(block(), materials={"skin": tissue, "muscle": OgdenQLV(0.006, 4.0, 0.5, 1.1)})
    file, _ = exported(problem, tmp_path)
    for name, law in to_problem(read_feb(file)).materials.items():
        mine = problem.materials[name]
        assert law.parameter_names == mine.parameter_names
        assert law.parameters == mine.parameters


def test_friction_is_read_back(tmp_path):
    file, _ = exported(replace(block(), friction=0.3), tmp_path)
    text = file.read_text(encoding="utf-8")
    assert "<symmetric_stiffness>non-symmetric</symmetric_stiffness>" in text
    assert to_problem(read_feb(file)).friction == 0.3
    plain, _ = exported(block(), tmp_path)
    assert "fric_coeff" not in plain.read_text(encoding="utf-8")
    assert to_problem(read_feb(plain)).friction == "frictionless"


@pytest.mark.parametrize("shape", ["square", "sphere"])
def test_the_front_is_read_back_without_valleys(tmp_path, shape):
    """Faces of four corners that are warped bulge: in a valley contact has no smooth energy."""
    file, _ = exported(block("tet4", shape), tmp_path)
    surface = to_problem(read_feb(file)).indenter.surface
    corners = surface.points[surface.faces]
    front = corners[corners[..., 2].min(axis=1) > -2.0]
    normals = np.cross(front[:, 1] - front[:, 0], front[:, 2] - front[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = front.reshape(-1, 3)
    beyond = points @ normals.T - np.einsum("fi,fi->f", normals, front[:, 0])
    assert beyond.max() < 1e-6


@pytest.mark.parametrize("shape", INDENTERS)
def test_the_indenter_is_where_it_touches(tmp_path, shape):
    """The faceted body has the distance of limbfit's own in front of it, to the sagitta of the facets."""
    problem = block("tet4", shape)
    file, tool = exported(problem, tmp_path)
    start = System(problem).indenter
    found = to_problem(read_feb(file)).indenter
    assert start is not None
    assert found is not None
    np.testing.assert_allclose(found.axis, start.frame[2], atol=1e-14)
    surface = start.signed_distance(tool.points[np.unique(tool.front)])
    rounding = start.body.radius if shape == "stl" else 1e-9  # an stl is written with its sharp edges
    assert np.abs(surface).max() <= rounding
    ahead = np.random.default_rng(1).uniform([-7, -7, 0.1], [7, 7, 3], (200, 3)) @ start.frame
    ahead += np.asarray(start.centre)
    gap = found.signed_distance(ahead) - start.signed_distance(ahead)
    assert np.abs(gap).max() < (0.1 if shape in ("sphere", "stl") else 0.05)


@pytest.mark.parametrize("shape", ["square", "stl"])
def test_structure(tmp_path, shape):
    """Numbers from 1 without gaps, faces outward, rigid elements upright, names that exist."""
    problem = block("tet10", shape)
    file, tool = exported(problem, tmp_path, title='a "title" -- with <marks> & all')
    root = ET.parse(file).getroot()
    assert root.attrib == {"version": "4.0"}
    assert [section.tag for section in root] == [
        "Module", "Control", "Globals", "Material", "Mesh", "MeshDomains", "Boundary", "Rigid", "Contact",
        "LoadData", "Output",
    ]  # fmt: skip
    for tag in ("Mesh/Nodes/node", "Mesh/Elements/elem", "Material/material", "LoadData/load_controller"):
        ids = [int(node.attrib["id"]) for node in root.iterfind(tag)]
        assert ids == list(range(1, len(ids) + 1))
    assert (
        len({e.attrib["name"] for e in root.iterfind("Mesh/*") if e.tag != "Nodes"})
        == len(root.findall("Mesh/*")) - 1
    )
    frame = problem.indenter.frame
    normals = np.cross(
        tool.points[tool.front[:, 1]] - tool.points[tool.front[:, 0]],
        tool.points[tool.front[:, 2]] - tool.points[tool.front[:, 0]],
    )
    assert (normals @ frame[2] > 0).all()
    if tool.cell_type == "hex8":
        whole = Mesh(tool.points, tool.cells, "hex8", np.zeros(len(tool.cells), int), ("tool",))
        assert (node_jacobians(whole) > 0).all()
    patch = problem.mesh.points[problem.contact_faces]
    up = np.cross(patch[:, 1] - patch[:, 0], patch[:, 2] - patch[:, 0])
    assert (up @ frame[2] < 0).all()
    rigid = root.find("Output/logfile/rigid_body_data")
    assert rigid.text == root.findall("Material/material")[-1].attrib["id"]


def test_another_reader_understands_it(tmp_path):
    """pyfebio's schemas of the sections that it can read back.

    Its Ogden takes no negative exponent, and what it writes as 0 or 1 (degrees of freedom, contact, how
    steps are cut) it does not read.
    """
    pytest.importorskip("pyfebio")
    from pyfebio import control, loaddata, mesh, meshdomains, output

    problem = block("tet10", "stl")
    file, tool = exported(problem, tmp_path)
    root = ET.parse(file).getroot()
    stepper = root.find("Control/time_stepper")
    stepper.remove(stepper.find("aggressiveness"))
    schemas = {
        "Control": control.Control,
        "Mesh": mesh.Mesh,
        "MeshDomains": meshdomains.MeshDomains,
        "LoadData": loaddata.LoadData,
        "Output": output.Output,
    }
    found = {name: kind.from_xml(ET.tostring(root.find(name))) for name, kind in schemas.items()}
    nodes = found["Mesh"].nodes[0].all_nodes
    points = np.array([[float(v) for v in node.text.split(",")] for node in nodes])
    np.testing.assert_array_equal(points, np.vstack([problem.mesh.points, tool.points]))
    assert [len(part.all_elements) for part in found["Mesh"].elements] == [
        *np.bincount(problem.mesh.regions), len(tool.cells)
    ]  # fmt: skip
    assert {domain.elem_type for domain in found["MeshDomains"].solid_domains} == {"TET10G4"}
    assert [domain.name for domain in found["MeshDomains"].shell_domains] == ["indenter"]
    curve = found["LoadData"].load_controllers[0]
    assert len(curve.points.points) == len(problem.history.times)


@pytest.mark.parametrize(("shape", "parts"), [("square", 64), ("sphere", 64), ("sharp", 128), ("stl", 128)])
def test_steps_that_febio_gets_through_with(tmp_path, shape, parts):
    """Half as large under a sharp edge; a step that fails is halved, not shortened by a ninth."""
    problem = block("tet4", shape)
    file, _ = exported(problem, tmp_path)
    control = ET.parse(file).getroot().find("Control")
    size, count = float(control.findtext("step_size")), int(control.findtext("time_steps"))
    assert size == pytest.approx(problem.history.loading_s / parts, rel=0.02)
    assert size * count == pytest.approx(problem.history.times[-1])
    assert control.findtext("time_stepper/aggressiveness") == "1"
    largest = read_feb(file).curves[2].points[:, 1]
    np.testing.assert_allclose(largest, 4.0 * problem.history.loading_s / parts, rtol=0.02)


def test_it_pushes_as_hard(tmp_path):
    """Solved from the file, with the same penalty, the facets are all that differs."""
    ramp = History(np.array([0.0, 2.0, 3.0]), np.array([0.0, 2.0, 1.0]))
    problem = replace(block("tet4", "sphere", divisions=8), history=ramp)
    file, _ = exported(problem, tmp_path)
    same = {"times": (1.0, 2.0, 3.0), "stress": "linear", "penalty": 20.0, "penetration": 1.0}
    direct = solve(problem, StepControl(**same), store="none")
    run = run_feb(file, tmp_path / "out", **same)
    assert run.result.completed
    limit = 0.01 * direct.peak_force
    np.testing.assert_allclose(run.result.force, direct.force, atol=limit)
    log = read_log(run.files[0])
    found = build_result(problem, log, RunVerdict("normal", "", 3.0, ""))
    np.testing.assert_allclose(found.force, run.result.force, atol=1e-3 * limit)


def test_what_febio_has_not_is_refused(tmp_path):
    for change, words in (
        ({"friction": "sticky"}, "sticky"),
        ({"element": "tet10v"}, "no element 'tet10v'"),
        ({"indenter": None}, "nothing drives"),
    ):
        with pytest.raises(ProblemError, match=words):
            write_feb(replace(block(), **change), tmp_path / "x.feb", FebSettings())
    many = Ogden(((0.004, 6.0),), prony=tuple((0.1, float(t)) for t in range(1, 8)))
    with pytest.raises(ProblemError, match="more than 6 terms"):
        write_feb(block().with_materials({"skin": many, "muscle": many}), tmp_path / "x.feb", FebSettings())


def test_in_the_frame_of_the_indenter(tmp_path):
    problem = block("tet4", "sharp")
    steps = StepControl(load_steps=3, unload_steps=2)
    turned = turn_to_indenter_frame(problem)
    np.testing.assert_allclose(turned.indenter.frame, np.eye(3), atol=1e-14)
    forces = [solve(p, steps, store="none").force for p in (problem, turned)]
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("relaxation", [("gamma", "tau"), ("gamma1", "tau1", "gamma2", "tau2")])
def test_optimisation(tmp_path, relaxation):
    """Ties hold at the start, bounds enclose it, and the data are those given."""
    start = {"c": 0.004, "m": 6.0} | {name: 2.0 / i for i, name in enumerate(relaxation, 1)}
    each = 5 + len(relaxation)
    lower, upper = ({k: f * v for k, v in start.items()} for f in (0.1, 3.0))
    tissues = {name: ParameterRange(start, lower, upper, 100.0) for name in ("skin", "fat", "muscle")}
    times, force = np.linspace(0.0, 10.0, 21), np.linspace(-0.01, 3.0, 21)
    write_optimisation(tmp_path / "o.feb", tissues, times, force)
    root = ET.parse(tmp_path / "o.feb").getroot()
    rows = np.array([[float(v) for v in p.text.split(",")] for p in root.iterfind("Parameters/param")])
    assert rows.shape == (3 * each, 4)
    names = [p.attrib["name"] for p in root.iterfind("Parameters/param")]
    assert names[each - 2 : each] == [
        f"fem.material('skin').{letter}{len(relaxation) // 2}" for letter in "gt"
    ]
    assert (rows[:, 1] <= rows[:, 0]).all()
    assert (rows[:, 0] <= rows[:, 2]).all()
    ties = np.array([[float(v) for v in c.text.split(",")] for c in root.iterfind("Constraints/constraint")])
    np.testing.assert_allclose(ties[:, :-1] @ rows[:, 0], ties[:, -1], atol=1e-12)
    assert np.linalg.matrix_rank(ties) == 9  # of 7 parameters of each tissue 4 are free
    data = np.array([[float(v) for v in p.text.split(",")] for p in root.iterfind("Objective/data/pt")])
    np.testing.assert_array_equal(data, np.column_stack([times, np.maximum(force, 0.0)]))
    with pytest.raises(ProblemError, match="64 parameters"):
        write_optimisation(tmp_path / "o.feb", dict.fromkeys("abcdefghij", tissues["fat"]), times, force)


def test_abaqus(tmp_path):
    """meshio reads mesh and sets; moduli and relaxation are Abaqus' own combinations."""
    meshio = pytest.importorskip("meshio")
    problem = block("tet10")
    file = tmp_path / "m.inp"
    tool = write_inp(problem, file, "abaqus", FebSettings())
    mesh = meshio.read(file)
    count = len(problem.mesh.points)
    np.testing.assert_allclose(mesh.points[:count], problem.mesh.points)
    tets = np.vstack([cells.data for cells in mesh.cells if cells.type == "tetra10"])
    order = np.argsort(problem.mesh.regions, kind="stable")
    np.testing.assert_array_equal(tets, problem.mesh.cells[order])
    assert sum(len(cells.data) for cells in mesh.cells if cells.type == "hexahedron") == len(tool.cells)
    lines = file.read_text().split("\n")
    at = lines.index("*HYPERELASTIC, OGDEN, N=2, MODULI=LONG TERM")
    skin = problem.materials["skin"]
    values = [float(v) for v in lines[at + 1].split(",")]
    np.testing.assert_allclose(values, [skin.c / 2, skin.m, skin.c / 2, -skin.m, 2 / (100 * skin.c), 0])
    g, _, tau = (float(v) for v in lines[at + 3].split(","))
    assert (g, tau) == pytest.approx((skin.gamma / (1 + skin.gamma), skin.tau), rel=1e-11)
    sides = lines[lines.index("*SURFACE, NAME=contact_patch, TYPE=ELEMENT") + 1 :]
    assert sum("S" in line for line in sides[: len(problem.contact_faces)]) == len(problem.contact_faces)


def read_step_times(text: str) -> np.ndarray:
    """First, whole, smallest and largest increment of every step of a file for Abaqus, s."""
    lines = text.split("\n")
    return np.array([[float(v) for v in lines[i + 1].split(",")] for i, line in enumerate(lines)
                     if line.startswith(("*VISCO,", "*STATIC"))])  # fmt: skip


def test_abaqus_meets_every_phase_in_increments_finer_than_it(tmp_path):
    """A quick ramp after a long hold; in one step its peak could lie within an increment."""
    times = np.array([0.0, 0.3, 300.3, 300.6, 300.9])
    problem = replace(block(), history=History(times, np.array([0.0, 1.0, 1.0, 4.0, 0.0])))
    write_inp(problem, tmp_path / "m.inp", "abaqus", FebSettings())
    text = (tmp_path / "m.inp").read_text()
    first, whole, _, largest = read_step_times(text).T
    np.testing.assert_allclose(np.cumsum(whole), times[1:])
    assert (largest <= whole / 10.0).all()
    assert (first <= 0.3 / 10.0).all()
    assert (whole / largest < 10_000).all()  # no more increments than a step may have
    assert text.count("*BOUNDARY, AMPLITUDE=advance") == len(whole)
    assert "*AMPLITUDE, NAME=advance, TIME=TOTAL TIME" in text


def test_abaqus_gets_the_contact_stiffness_that_limbfit_holds_at_the_site(tmp_path):
    found = []
    for penalty in (None, 400.0):
        settings = FebSettings(steps=StepControl(penalty=penalty))
        write_inp(block(), tmp_path / "m.inp", "abaqus", settings)
        lines = (tmp_path / "m.inp").read_text().split("\n")
        found.append(float(lines[lines.index("*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR") + 1]))
        assert found[-1] == pytest.approx(build_contact(block(), settings).penalty)  # as FEBio does
    assert found[1] == pytest.approx(4.0 * found[0])


def test_a_coefficient_of_friction_of_nothing_is_none_for_abaqus(tmp_path):
    write_inp(replace(block(), friction=0.0), tmp_path / "m.inp", "abaqus", FebSettings())
    with pytest.raises(ProblemError, match="friction is not written for Abaqus"):
        write_inp(replace(block(), friction=0.1), tmp_path / "m.inp", "abaqus", FebSettings())


def test_under_a_force_the_displacement_is_that_of_the_table(tmp_path):
    """The table of the exported file, whose force is the stated one and whose place is the answer."""
    history = History(np.array([0.0, 1.0, 2.0]), force=np.array([0.0, 2.0, 1.0]))
    problem = replace(block("tet4", divisions=4), history=history)
    same = {"times": (0.5, 1.0, 1.5, 2.0), "stress": "linear", "penalty": 20.0, "penetration": 1.0}
    direct = solve(problem, StepControl(**same), store="none")
    write_feb(problem, tmp_path / "model.feb", FebSettings(steps=StepControl(**same)))
    run = run_feb(tmp_path / "model.feb", tmp_path / "out", **same)
    found = build_result(problem, read_log(run.files[0]), RunVerdict("normal", "", 2.0, ""))
    np.testing.assert_allclose(found.force[1:], direct.force[1:], rtol=1e-3)
    np.testing.assert_allclose(found.displacement, direct.displacement, atol=0.02 * direct.displacement.max())
    assert np.abs(found.displacement - history.at(found.times)).max() > 0.1  # which are N


def test_calculix_says_no_to_relaxation(tmp_path):
    with pytest.raises(ProblemError, match=r"relaxes, which CalculiX cannot.*gamma is 0"):
        write_inp(block(), tmp_path / "m.inp", "calculix", FebSettings())
    elastic = {name: OgdenQLV(0.004, 4.0, 0.0, 1.0) for name in ("skin", "muscle")}
    write_inp(block("tet10").with_materials(elastic), tmp_path / "m.inp", "calculix", FebSettings())
    assert "*VISCO" not in (tmp_path / "m.inp").read_text()
    with pytest.raises(ProblemError, match=r"hexahedra lock.*quadratic tetrahedra"):
        write_inp(block("hex8").with_materials(elastic), tmp_path / "m.inp", "calculix", FebSettings())


@pytest.mark.parametrize("program", ["abaqus", "calculix"])
def test_no_number_is_longer_than_the_20_characters_that_a_field_may_have(tmp_path, program):
    """As a round indenter's points next to nothing are in full, for which CalculiX stops."""
    ball = Indenter("sphere", 40.0, 0.0, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    elastic = {name: OgdenQLV(1e-3 / 3.0, 4.0 / 7.0, 0.0, 1.0) for name in ("skin", "muscle")}
    problem = replace(block("tet10"), indenter=ball).with_materials(elastic)
    write_inp(problem, tmp_path / "m.inp", program, FebSettings())
    fields = [field.strip() for line in (tmp_path / "m.inp").read_text().split("\n")
              if not line.startswith("*") for field in line.split(",")]  # fmt: skip
    assert max(map(len, fields)) <= 20
