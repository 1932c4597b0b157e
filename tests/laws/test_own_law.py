"""A law from outside the package, and the exponential one: at a point, in the solver, in a study."""

import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from editing import write_study
from guide import from_the_guide, identified
from limbfit import History, OgdenQLV, Problem, load_study
from limbfit.errors import InputError
from limbfit.extensions import load_extensions
from limbfit.fe import StepControl, System, solve
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.materials import FungQLV
from limbfit.fe.system import Increment
from limbfit.indentation.sites import build_materials
from limbfit.laws import FUNG, LAWS, Parameter, TissueLaw, register_law
from limbfit.mesh import Mesh
from limbfit.pipeline.commands.other_solvers import check_export
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.socket.simulation import SocketLimb, SocketRun
from limbfit.socket import Socket
from small_limb import limb as limb_with_a_bone

sys.path.insert(0, str(Path(__file__).parents[1] / "fe"))
from blocks import block, check_tangent, punch
from samples import point

RELAXED = {"b": 1.6, "gamma": 2.0, "tau_s": 0.5}
TRUTH = {"a_kPa": 9.0, **RELAXED}


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """The law's file as the guide shows it."""
    return from_the_guide("Yeoh(", tmp_path_factory.mktemp("extension") / "yeoh.py")


@pytest.fixture(scope="module")
def law(file) -> TissueLaw:
    load_extensions([file])
    return LAWS["yeoh"]


@pytest.fixture(scope="module", params=["yeoh", FUNG])
def tissue(request, law):
    if request.param == FUNG:
        return build_materials({"skin": {"c_kPa": 9.0, **RELAXED}}, 100.0, FUNG)["skin"]
    return law.material(**law.in_solver_units(TRUTH))


def energy(tissue, stretches):
    lt = stretches * stretches.prod(axis=-1)[..., None] ** (-1 / 3)
    more = (lt**2).sum(axis=-1) - 3
    if isinstance(tissue, FungQLV):
        return tissue.c / (2 * tissue.b) * (np.exp(tissue.b * more) - 1)
    return tissue.a / 2 * (more + tissue.b * more**2)


def stress(tissue, stretches):
    """Deviatoric principal Kirchhoff stresses by complex steps."""
    steps = np.exp(1e-30j * np.eye(3))
    return np.array([energy(tissue, stretches * step).imag for step in steps]) / 1e-30


@pytest.mark.parametrize(
    "stretches", [[1.0, 1.0, 1.0], [0.7, 1.2, 1.2], [1.1, 1.1 + 1e-9, 0.8], [0.6, 1.1, 1.5]]
)
def test_the_kernels_give_its_energy_stress_and_parameters_derivatives(tissue, stretches):
    x = np.array(stretches)
    p, rates = point(tissue, np.diag(x))
    assert p["energy"][0] == pytest.approx(energy(tissue, x), rel=1e-12, abs=1e-15)
    np.testing.assert_allclose(
        p["beta"][:, 0], stress(tissue, x), rtol=1e-11, atol=1e-14 * tissue.shear_modulus
    )
    for k, name in enumerate(tissue.parameter_names[:2]):
        h = 1e-5 * getattr(tissue, name)
        ends = [replace(tissue, **{name: getattr(tissue, name) + s * h}) for s in (1, -1)]
        change = (stress(ends[0], x) - stress(ends[1], x)) / (2 * h)
        np.testing.assert_allclose(rates["kept"][k, :, 0], change, atol=1e-8 * max(1.0, np.abs(change).max()))


def test_its_modulus_of_small_strains_is_that_of_the_kernels(tissue):
    """``d beta_1/d(e_1 - e_2) = 2 mu`` at rest, and what the material says of itself."""
    p, _ = point(tissue, np.eye(3))
    assert (p["slope"][0, 0] - p["slope"][3, 0]) / 2 == pytest.approx(tissue.shear_modulus, rel=1e-14)
    assert p["quotient"][0, 0] == pytest.approx(tissue.shear_modulus, rel=1e-14)
    shear = np.eye(3)
    shear[0, 1] = 1e-5
    sheared, _ = point(tissue, shear)
    tau = (sheared["n"][..., 0] * sheared["beta"][:, 0]) @ sheared["n"][..., 0].T
    assert tau[0, 1] / 1e-5 == pytest.approx(tissue.shear_modulus, rel=1e-8)


def mixed(tissue) -> tuple[System, Laws]:
    """Elements of both laws side by side in the kernels."""
    lines = np.linspace(0.0, 1.0, 3)
    mesh = block("tet10", lines, lines, lines, layer=0.5, jitter=0.05)
    tissues = {"skin": tissue, "muscle": OgdenQLV(0.004, 4.0, 3.0, 0.3)}
    ramp = History(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    faces = mesh.face_sets["top"][:0]
    system = System(Problem(mesh, tissues, mesh.node_sets["bottom"], faces, None, ramp))
    return system, Laws.build(list(tissues.values()))


def test_forces_and_tangent_are_derivatives_beside_another_law(tissue):
    system, laws = mixed(tissue)
    assert len(set(system.regions[:16].tolist())) == 2
    rng = np.random.default_rng(4)
    u = system.points @ (0.1 * rng.normal(size=(3, 3))) + 0.01 * rng.normal(size=system.points.shape)
    rest = Increment(0.0, 0.0, np.array([1.5, 2.5]), np.zeros((*system.weights.shape, 6)), 1.0)
    d = rng.normal(size=u.shape) * ~system.supported
    check_tangent(system, laws, u, rest, d)


def test_every_parameter_of_a_simulation_has_its_sensitivity(tissue):
    problem = punch("hex8", 2, 1, materials={"skin": tissue, "muscle": OgdenQLV(0.004, 4.0, 3.0, 0.3)})
    control = StepControl(load_steps=3, unload_steps=2, tolerance=1e-11)
    centre = solve(problem, control, sensitivities=True, store="all")
    for j, name in enumerate(tissue.parameter_names):
        h, forces = 1e-4 * getattr(tissue, name), []
        for sign in (1, -1):
            skin = replace(tissue, **{name: getattr(tissue, name) + sign * h})
            changed = problem.with_materials({**problem.materials, "skin": skin})
            forces.append(solve(changed, control, warm_start=centre).force)
        difference = (forces[0] - forces[1]) / (2 * h)
        error = np.abs(difference - centre.force_sensitivity[:, j]).max()
        assert error <= 1e-4 * np.abs(difference).max(), name


def test_impossible_laws_are_refused():
    with pytest.raises(InputError, match="tissue law 'ogden' exists already"):
        register_law(LAWS["ogden"])
    soft = Parameter("a", start=1.0, lower=2.0, upper=3.0, unit="kPa")
    with pytest.raises(InputError, match="parameter a needs"):
        register_law(TissueLaw("soft", "", "", (soft,), None))
    with pytest.raises(InputError, match="has no modulus"):
        register_law(TissueLaw("soft", "", "", (replace(soft, unit=""),), None))
    with pytest.raises(InputError, match="no tissue law is named 'unheard-of'; use ogden"):
        LAWS["unheard-of"]


GIVEN = """\
[study]
name = "own law"
extensions = ["yeoh.py"]

[surfaces]
skin = "skin.stl"

[material]
law = "yeoh"
start = { b = 2.0 }

[calibration]
fixed = ["skin.tau_s"]

[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [0.0, -50.0, 10.0]
"""


def test_a_study_names_it_and_follows_its_file(tmp_path, file, law):
    assert law.moduli == ("a_kPa",)
    shutil.copy(file, tmp_path / "yeoh.py")
    study = write_study(tmp_path, GIVEN)
    assert study.parameters[:4] == tuple(("skin", key) for key in TRUTH)
    assert study.material.start == {"a_kPa": 4.0, "b": 2.0, "gamma": 1.2, "tau_s": 1.0}
    assert study.material.upper["b"] == 10.0
    before = compute_keys(study)
    (tmp_path / "yeoh.py").write_text((tmp_path / "yeoh.py").read_text() + "# another thought\n")
    with pytest.raises(InputError, match="tissue law 'yeoh' exists already"):
        load_study(tmp_path)  # one that is known here from another file
    assert compute_keys(study) != before
    shutil.copy(file, tmp_path / "yeoh.py")
    with pytest.raises(InputError, match="c_kPa is no parameter of the law; they are a_kPa, b, gamma, tau_s"):
        write_study(tmp_path, GIVEN.replace("b = 2.0", "c_kPa = 2.0"))


def test_a_socket_knows_it_in_a_process_that_has_read_no_study_and_follows_its_file(tmp_path, file):
    study = write_study(tmp_path, GIVEN.replace("yeoh.py", str(file)), ("skin.stl", "1.csv", "limb.vtu"))
    corners = np.eye(3) + np.array([12.0, -80.0, 270.0])  # beside the limb
    socket = Socket(corners, np.array([[0, 1, 2]]), corners, np.arange(3))
    anatomy, mesh = limb_with_a_bone(), Mesh.from_arrays(np.eye(4, 3), [[0, 1, 2, 3]])
    mesh = replace(mesh, face_sets={"skin": np.array([[0, 1, 2]])})
    limb = SocketLimb(study, anatomy, anatomy, None, {}, ())
    model = limb.build_model(socket, mesh)
    (tmp_path / "model.pickle").write_bytes(pickle.dumps(model))
    code = f"""import pickle, sys
model = pickle.load(open(sys.argv[1], "rb"))
print(model.build_laws({{"skin": {TRUTH}}})["skin"].parameters)"""
    told = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "model.pickle"], capture_output=True, text=True, check=False
    )
    assert told.stdout.strip() == str(model.build_laws({"skin": TRUTH})["skin"].parameters), told.stderr
    shutil.copy(file, tmp_path / "yeoh.py")
    (tmp_path / "yeoh.py").write_text(file.read_text() + "# another thought\n")
    changed = study.model_copy(
        update={"study": study.study.model_copy(update={"extensions": (tmp_path / "yeoh.py",)})}
    )
    keys = {SocketRun("", one, {}).key for one in (model, replace(model, study=changed))}
    assert len(keys) == 2


def test_an_export_of_the_exponential_law_is_refused_at_once(tmp_path):
    stated = GIVEN.replace('extensions = ["yeoh.py"]\n', "").replace('"yeoh"', f'"{FUNG}"')
    with pytest.raises(InputError, match="Ogden"):
        check_export(write_study(tmp_path, stated), "feb")


def test_an_extension_whose_change_is_taken_back_is_run_again(tmp_path):
    file, state = tmp_path / "own.py", tmp_path / "state"
    for text in ("one", "two", "one", "one"):
        file.write_text(f"with open({str(state)!r}, 'a') as stream:\n    stream.write('{text} ')\n")
        load_extensions([file])
    assert state.read_text() == "one two one "


def test_what_an_extension_raises_names_it(tmp_path):
    (tmp_path / "broken.py").write_text("import unheard_of_module\n")
    with pytest.raises(InputError, match=r"broken\.py: extension: ModuleNotFoundError"):
        load_extensions([tmp_path / "broken.py"])
    with pytest.raises(InputError, match="cannot be read"):
        load_extensions([tmp_path / "missing.py"])


STATED = """
[indenter]
edge_radius_mm = 2.0
[material]
law = "yeoh"
"""


@pytest.mark.slow
def test_a_study_identifies_it(tmp_path, file, law):
    found = identified(tmp_path, file, STATED, TRUTH, within=0.02)
    assert found["law"]["name"] == "yeoh"
    assert found["law"]["parameters"][1]["words"] == "stiffening"
