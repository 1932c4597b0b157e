"""Fibres in FEBio's files, both ways."""

from dataclasses import replace

import numpy as np
import pytest
from febfiles import FEB, back, written

from limbfit import OgdenQLV
from limbfit.bench.timing import build_punched_block
from limbfit.errors import ProblemError
from limbfit.fe import (
    FibredMaterial,
    StepControl,
    solve,
)
from limbfit.febio import (
    FebSettings,
    read_feb,
    write_inp,
)

GROUND = OgdenQLV(0.004, 5.0, (0.8, 0.3), (0.2, 1.5))
ELASTIC = '<elastic type="Ogden"><k>0.2</k><c1>0.004</c1><m1>6</m1><c2>0.004</c2><m2>-6</m2></elastic>'
FIBRE = '<solid type="fiber-exp-pow-uncoupled"><ksi>0.01</ksi><alpha>3</alpha><beta>2</beta></solid>'
MIXED = (
    '<elastic type="uncoupled solid mixture"><k>0.2</k><solid type="Ogden"><c1>0.004</c1><m1>6</m1>'
    f"<c2>0.004</c2><m2>-6</m2></solid>{FIBRE}</elastic>"
)


@pytest.mark.parametrize("ground", [GROUND, OgdenQLV(0.004, 5.0, 0.0, 1.0)], ids=["relaxing", "elastic"])
@pytest.mark.parametrize("field", [False, True], ids=["one direction", "a field"])
def test_fibres_are_read_back(tmp_path, ground, field):
    problem = build_punched_block("tet4", 4)
    count = len(problem.mesh.cells)
    fibres = np.random.default_rng(0).normal(size=(count, 3)) if field else np.array([0.3, -1.0, 0.2])
    tissues = {"skin": OgdenQLV(0.009, 4.0, 1.0, 0.5), "muscle": FibredMaterial(ground, 0.012, 2.5)}
    problem = replace(problem, materials=tissues, fibres=fibres)
    found, _ = back(problem, tmp_path)
    assert found.materials["muscle"].parameters == tissues["muscle"].parameters
    assert found.materials["muscle"].table().kappa == pytest.approx(tissues["muscle"].table().kappa)
    order = np.argsort(problem.mesh.regions, kind="stable")
    inside = found.mesh.regions == found.mesh.region_names.index("muscle")
    mine = np.broadcast_to(fibres, (count, 3))[order]
    np.testing.assert_array_equal(found.fibres[inside], mine[inside])
    # FEBio takes axes of elements in every material, and ends at once where a fibre states no vector.
    text = (tmp_path / "model.feb").read_text()
    assert '<fiber type="vector">1.0,0.0,0.0</fiber>' in text
    assert text.count("mat_axis") == 1
    assert 'ElementData type="mat_axis" elem_set="muscle"' in text
    if field:
        steps = StepControl(load_steps=3, unload_steps=2)
        assert solve(found, steps, store="none").peak_force > 0.0


def mixed(folder, old=ELASTIC, new=MIXED, axis=""):
    text = FEB.replace(ELASTIC, MIXED).replace("<g0>1</g0>", f"{axis}<g0>1</g0>")
    return written(folder, text.replace(old, new) if old != ELASTIC else text)


def test_an_input_with_fibres_is_read(tmp_path):
    axis = '<mat_axis type="vector"><a>0,2,0</a><d>1,0,0</d></mat_axis>'
    model = read_feb(mixed(tmp_path, axis=axis))
    (fat,) = model.materials.values()
    assert fat == FibredMaterial(OgdenQLV(0.004, 6.0, 2.0, 0.5, 200.0), 0.01, 3.0)
    np.testing.assert_array_equal(model.fibres["body"], [[0.0, 2.0, 0.0]])
    unsaid = read_feb(mixed(tmp_path))
    np.testing.assert_array_equal(unsaid.fibres["body"], [[1.0, 0.0, 0.0]])  # FEBio's default


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("<beta>2</beta>", "<beta>3</beta>", "beta = 2"),
        (FIBRE, FIBRE + FIBRE, "a mixture is read of one fiber"),
        ("<ksi>", "<k>1</k><ksi>", "bulk modulus of its own"),
        ("<alpha>3</alpha>", "<alpha>0</alpha>", "k2 = 0.0 is not positive"),
        ("<ksi>", "<theta>3</theta><ksi>", "parameter of the material is not known"),
        ("<beta>2", '<fiber type="vector">0,1,0</fiber><beta>2', "along the first of the local axes"),
        ("<Boundary>", "<MeshData><NodeData/></MeshData><Boundary>", "only the mat_axis of elements"),
    ],
)
def test_what_limbfit_has_not_is_refused_with_its_line(tmp_path, old, new, what):
    with pytest.raises(ProblemError, match=what) as refused:
        read_feb(mixed(tmp_path, old, new))
    assert "line" in str(refused.value)


def test_abaqus_is_not_given_fibres(tmp_path):
    problem = build_punched_block("tet4", 4)
    tissues = {name: FibredMaterial(GROUND, 0.01, 3.0) for name in problem.mesh.region_names}
    with pytest.raises(ProblemError, match="has fibres, which are written for FEBio only"):
        write_inp(
            replace(problem, materials=tissues, fibres=(1, 0, 0)), tmp_path / "m.inp", "abaqus", FebSettings()
        )
