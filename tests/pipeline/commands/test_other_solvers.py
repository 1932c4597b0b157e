"""A study's site written for FEBio, and FEBio's table of it held against limbfit.

FEBio is not run: limbfit solves the exported file and its table takes the place of FEBio's.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import xml.etree.ElementTree as ET

import pytest

from limbfit import compare_site, export_study, load_study, simulate_feb, simulate_site
from limbfit.errors import InputError

MESH = "\n[mesh]\nedge_near_mm = 6.0\nedge_far_mm = 18.0\n[indenter]\nedge_radius_mm = 2.0\n"
TISSUES = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.5},
    "muscle": {"c_kPa": 4.0, "m": 4.0, "gamma": 3.0, "tau_s": 0.3},
}


def quiet(_):
    pass


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
            call(coarse, "1", listener=quiet)
    assert not coarse.results.exists()


def test_formats_and_sites_are_checked(coarse):
    for to, site, words in (("xyz", None, "is no format"), ("feb", "9", "no site"), ("feb", "", "no site")):
        with pytest.raises(InputError, match=words):
            export_study(coarse, to, site=site, listener=quiet)


@pytest.mark.slow
def test_a_site_goes_out_and_its_forces_come_back(coarse, tmp_path):
    out = tmp_path / "out"
    found = export_study(coarse, "feb", site="1", output=out, parameters=TISSUES, listener=quiet)
    (file,) = found["sites"][0]["files"]
    solved = simulate_feb(file, out / "febio", listener=quiet)
    assert solved["completed"]
    compared = compare_site(
        coarse, "1", parameters=TISSUES, febio_log=out / "febio" / "1-forces.txt", listener=quiet
    )
    # a penalty as stiff as limbfit's own: what is left is steps and facets
    assert compared["limbfit_matched"]["difference"]["max_percent"] < 1.0
    assert compared["limbfit"]["difference"]["max_percent"] < 1.5
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
    partial = compare_site(coarse, "1", parameters=TISSUES, febio_log=out / "half.txt", listener=quiet)
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
