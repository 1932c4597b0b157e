"""The patient that comes with limbfit is the one that ``limbfit phantom`` makes."""

import json
from pathlib import Path

import numpy as np
import pytest

from limbfit.anatomy.imaging import read_volume
from limbfit.anatomy.surfaces.surfaces import load_anatomy
from limbfit.errors import InputError
from limbfit.phantom import build_true_sites, draw_true_parameters, make_limb, make_phantom, unpack_patient
from limbfit.phantom.build import _format_study, _Patient
from limbfit.phantom.robot import DETAIL_SITES, SecondaryMeasurements, select_sites

ANEW = (
    "limbfit phantom patient && (cd patient && python -m zipfile -c ../src/limbfit/phantom/patient.zip "
    "mri traces truth truth.json study.toml) packs it anew"
)


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("packed") / "patient"
    truth = unpack_patient(folder)
    assert truth == json.loads((folder / "truth.json").read_text())
    return folder


def test_its_tissues_limb_sites_and_study_are_those_of_seed_0(packed: Path) -> None:
    truth, limb = json.loads((packed / "truth.json").read_text()), make_limb(0)
    assert truth["parameters"] == draw_true_parameters(0), ANEW
    np.testing.assert_allclose(truth["limb"]["rotation"], limb.rotation, atol=1e-12, err_msg=ANEW)
    sites = build_true_sites(limb, 0)
    places = [marker["position_mm"] for marker in truth["markers"]]
    np.testing.assert_allclose(places, [site.position for site in sites], atol=1e-6, err_msg=ANEW)
    indented, forces = select_sites(sites, DETAIL_SITES["coarse"]), SecondaryMeasurements(False, False, False)
    patient = _Patient(0, "coarse", limb, tuple(sites), tuple(indented), truth["parameters"], forces, False)
    assert (packed / "study.toml").read_text(encoding="utf-8") == _format_study(patient), ANEW


def test_a_folder_that_holds_something_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="there is something already"):
        unpack_patient(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_its_images_surfaces_and_records_are_made_alike(packed: Path, tmp_path: Path) -> None:
    """Two minutes of the solver: forces to 1e-4 N, as another machine adds them up."""
    made = tmp_path / "made"
    make_phantom(made)
    for series in ("plain", "markers"):
        one, other = (read_volume(folder / "mri" / series) for folder in (packed, made))
        assert np.array_equal(one.array, other.array), ANEW
        assert one.has_same_grid(other)
    ours, theirs = load_anatomy(packed / "truth"), load_anatomy(made / "truth")
    np.testing.assert_allclose(ours.skin.points, theirs.skin.points, atol=1e-4)
    for file in sorted((made / "traces").iterdir()):
        table, again = (
            np.loadtxt(f, delimiter=",", skiprows=1) for f in (packed / "traces" / file.name, file)
        )
        np.testing.assert_allclose(table, again, atol=1e-4, err_msg=ANEW)
