"""A study's site written for FEBio, and FEBio's table of it held against limbfit.

FEBio is not run: limbfit solves the exported file and its table takes the place of FEBio's.
"""

import csv
import json
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from editing import edit
from layered import block_context, block_study
from limbfit import compare_site, export_study, load_study, simulate_feb, simulate_site
from limbfit.errors import InputError
from limbfit.fe import StepControl, solve
from limbfit.indentation import build_problem
from limbfit.mesh import read_vtu
from limbfit.pipeline.commands.other_solvers import check_export
from limbfit.pipeline.commands.simulate import write_site_curve
from limbfit.pipeline.records.records import build_model
from limbfit.results.base import read_curves

MESH = "\n[mesh]\nedge_near_mm = 6.0\nedge_far_mm = 18.0\n[indenter]\nedge_radius_mm = 2.0\n"
TISSUES = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.5},
    "muscle": {"c_kPa": 4.0, "m": 4.0, "gamma": 3.0, "tau_s": 0.3},
}


@pytest.fixture
def coarse(study):
    with (study / "study.toml").open("a") as stream:
        stream.write(MESH)
    return load_study(study)


def test_febio_absent_is_said_before_anything_runs(coarse, monkeypatch, tmp_path):
    monkeypatch.delenv("FEBIO_CMD", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    for call in (compare_site, lambda *a, **k: simulate_site(*a, solver="febio", **k)):
        with pytest.raises(InputError, match="FEBio is not installed here; install FEBio 4"):
            call(coarse, "1")
    assert not coarse.results.exists()


def test_formats_and_sites_are_checked(coarse):
    for to, site, words in (("xyz", None, "is no format"), ("feb", "9", "no site"), ("feb", "", "no site")):
        with pytest.raises(InputError, match=words):
            export_study(coarse, to, site=site)


OWN_LAW = """
from limbfit import Parameter, TissueLaw, register_law
from limbfit.fe import NeoHookean

MODULUS = Parameter("mu", 4.0, 0.1, 50.0, "kPa", "shear modulus")
register_law(TissueLaw("own-neo-hookean", "neo-Hookean", "W = mu/2 (I1 - 3)", (MODULUS,), NeoHookean))
"""


@pytest.mark.parametrize(
    ("material", "more", "site", "words"),
    [
        (
            "",
            "",
            'control = "force"',
            'compares forces, which are given where a record has control = "force"',
        ),
        ('law = "own-neo-hookean"', '[study]\nextensions = ["own.py"]', "", 'not for "own-neo-hookean"'),
        ('law = "ogden-power"', "", "", 'written for "ogden", whatever its relaxation terms, not for'),
    ],
)
def test_what_febios_fit_cannot_identify_is_refused_early(tmp_path, material, more, site, words):
    (tmp_path / "own.py").write_text(OWN_LAW, encoding="utf-8")
    block_study(tmp_path, "", "", site)
    edit(tmp_path, "[material]", f"[material]\n{material}")
    if more:
        edit(tmp_path, "[study]", more, count=1)
    with pytest.raises(InputError, match=f"study.toml: a: FEBio's fit .*{words}"):
        check_export(load_study(tmp_path), "febio-optimize")
    check_export(load_study(tmp_path), "feb")


@pytest.mark.parametrize("lacking", ["muscle", "tau_s"])
def test_parameters_that_lack_something_are_refused(tmp_path, lacking):
    given = {tissue: {k: v for k, v in values.items() if k != lacking} for tissue, values in TISSUES.items()}
    given.pop(lacking, None)
    with pytest.raises(
        InputError, match=r"lack some of c_kPa, m, gamma, tau_s; give all .* each of skin, muscle"
    ):
        check_export(block_study(tmp_path, ""), "feb", parameters=given)


def test_a_record_under_force_has_no_forces_to_compare(tmp_path):
    study = block_study(tmp_path, "", "", 'control = "force"')
    with pytest.raises(
        InputError, match=r"study.toml: a: a force drives the indenter, and there is none to be"
    ):
        compare_site(study, "a", febio_log=tmp_path / "forces.txt")


def test_the_curve_of_a_partial_simulation_ends_where_that_ends(tmp_path):
    context = block_context(block_study(tmp_path, ""), TISSUES)
    model = build_model(context, context.study.recorded[0])
    problem = build_problem(model, read_vtu(model.mesh), TISSUES)
    found = solve(problem, StepControl(most_iterations=12), store="none")
    assert not found.completed
    write_site_curve(model, found, tmp_path / "a.csv")
    curve = read_curves(tmp_path / "a.csv")
    assert 0.0 < curve["time_s"][-1] <= found.times[-1] < 0.9 * model.knots_s[-1]
    assert (np.diff(curve["force_N"]) > 0.0).all()  # no plateau of its last force


@pytest.mark.slow
def test_a_site_goes_out_and_its_forces_come_back(coarse, tmp_path):
    out = tmp_path / "out"
    found = export_study(coarse, "feb", site="1", output=out, parameters=TISSUES)
    (file,) = found["sites"][0]["files"]
    solved = simulate_feb(file, out / "febio")
    assert solved["completed"]
    compared = compare_site(coarse, "1", parameters=TISSUES, febio_log=out / "febio" / "1-forces.txt")
    # A penalty as stiff as limbfit's own: what is left are facets, and contact along the skin's normal (the
    # indenter's here), for which the export states 2 %.
    for which in ("limbfit_matched", "limbfit"):
        assert compared[which]["difference"]["max_percent"] < 2.0
    assert "within 2 % of the peak" in found["sites"][0]["notes"][-1]
    assert "as stiff as limbfit's" in found["sites"][0]["notes"][0]
    assert compared["febio"]["completed"]
    stored = json.loads((coarse.results / "compare" / "1.json").read_text())
    assert stored["limbfit_matched"]["difference"] == compared["limbfit_matched"]["difference"]
    with (coarse.results / "compare" / "1.csv").open() as stream:
        assert next(csv.reader(stream)) == [
            "time_s", "displacement_mm", "febio_N", "limbfit_N", "limbfit_matched_N"
        ]  # fmt: skip
    assert (coarse.results / "compare" / "1.png").read_bytes().startswith(b"\x89PNG")
    text = (out / "febio" / "1-forces.txt").read_text()
    half = text[: text.index("*Step  = 20\n")]
    (out / "half.txt").write_text(half)
    partial = compare_site(coarse, "1", parameters=TISSUES, febio_log=out / "half.txt")
    assert not partial["febio"]["completed"]
    assert "the table ends at" in partial["febio"]["reason"]
    _optimisation(coarse, out)


def _optimisation(study, out):
    """All fitted sites: control file and model of each; the model pushes along z.

    Its penalty is explicit, whatever the study says: FEBio's fit would begin with another automatic one than
    a plain run of the same model.
    """
    with study.file.open("a") as stream:
        stream.write("\n[febio]\npenalty = 3.0\n")
    command = [sys.executable, "-m", "limbfit", "export", str(study.folder), "--to", "febio-optimize"]
    shown = subprocess.run([*command, "--output", str(out), "--json"], capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    assert [row["site"] for row in json.loads(shown.stdout)["sites"]] == ["1"]
    model = ET.parse(out / "1-model.feb").getroot()
    moved = [bc.findtext("dof") for bc in model.iterfind("Rigid/rigid_bc") if bc.find("dof") is not None]
    assert moved == ["z"]
    assert model.findtext("Contact/contact/auto_penalty") == "0"
    control = ET.parse(out / "1-optimize.feb").getroot()
    names = {m.attrib["name"] for m in model.iterfind("Material/material")}
    for parameter in control.iterfind("Parameters/param"):
        assert parameter.attrib["name"].split("'")[1] in names
    data = [float(p.text.split(",")[1]) for p in control.iterfind("Objective/data/pt")]
    assert 5.0 < max(data) < 7.0  # the record's own peak force, N
