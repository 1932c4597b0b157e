"""The cube in uniaxial compression against its closed form, and the published tissues beside it."""

import json

import numpy as np
import pytest
from scipy.integrate import quad

from limbfit import compress_cube
from limbfit.errors import InputError
from limbfit.pipeline.variants.cube import KPA, PUBLISHED, compress

SKIN = {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.5}
MUSCLE = {"c_kPa": 4.0, "m": 4.0, "gamma": 3.0, "tau_s": 0.3}


def elastic_stress(terms, stretch: float) -> tuple[float, float]:
    """Second Piola-Kirchhoff stresses (axial, lateral) of the deviatoric part, incompressible, kPa.

    ``S_i = beta_i / lambda_i^2`` with ``beta_i = sum c/m lambda_i^m`` less its mean over the directions.
    """
    axial, lateral = stretch, stretch**-0.5
    beta = np.array([sum(c / m * x**m for c, m in terms) for x in (axial, lateral, lateral)])
    beta -= beta.mean()
    return beta[0] / axial**2, beta[1] / lateral**2


def exact_stress(terms, gamma: float, tau: float, depth: float, t: float) -> float:
    """Compressive Cauchy stress (kPa) at ``t``, sides free, incompressible, by its hereditary integral."""

    def stretch(s: float) -> float:
        return 1.0 - depth * float(np.interp(s, [0.0, 0.5, 1.0, 2.0], [0.0, 1.0, 0.0, 0.0]))

    def relaxed(i: int) -> float:
        now = elastic_stress(terms, stretch(t))[i]

        def rate(s: float) -> float:
            after, before = (elastic_stress(terms, stretch(s + d))[i] for d in (1e-6, -1e-6))
            return (after - before) / 2e-6

        history = sum(
            quad(lambda s: np.exp(-(t - s) / tau) * rate(s), a + 2e-6, b - 2e-6)[0]
            for a, b in ((0.0, min(t, 0.5)), (0.5, min(t, 1.0)))
            if b > a
        )
        return now + gamma * history

    x = stretch(t)
    return -(x**2 * relaxed(0) - relaxed(1) / x)


@pytest.mark.parametrize("tissue", PUBLISHED, ids=[tissue.name for tissue in PUBLISHED])
def test_stress_is_that_of_the_closed_form(tissue):
    """Nearly incompressible: kappa ten thousand times the shear modulus."""
    material = tissue.material(((2.0, 0.5),))
    stiff = type(material)(material.terms, material.prony, kappa_ratio=1e5)
    times = np.linspace(0.0, 2.0, 81)[1:]
    stress, least, most = compress(stiff, times, 20.0)
    gamma, tau = material.prony[0] if material.prony else (0.0, 1.0)
    wanted = [exact_stress(tissue.terms, gamma, tau, 0.2, t) for t in (0.25, 0.5, 0.75, 1.0, 1.5)]
    found = np.interp([0.25, 0.5, 0.75, 1.0, 1.5], times, stress)
    np.testing.assert_allclose(found, wanted, atol=4e-3 * max(wanted))
    assert least == pytest.approx(1.0, abs=1e-3)
    assert most == pytest.approx(1.0, abs=1e-3)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The published tissues and those of a study, compressed, and the folder of the results."""
    folder = tmp_path_factory.mktemp("cube")
    return compress_cube(folder, parameters={"skin": SKIN, "muscle": MUSCLE}), folder


def test_the_papers_bulk_modulus_keeps_the_volume_within_a_percent(stored):
    found, _ = stored
    paper = next(row for row in found["tissues"] if "Sengeh" in row["tissue"])
    assert 0.99 < paper["J_min"] < 0.9975
    assert paper["bulk_modulus_kPa"] == pytest.approx(522.0)
    assert paper["instantaneous_modulus_kPa"] == pytest.approx(5.22 * 4.57)


def test_a_study_stands_beside_the_published_and_lends_its_relaxation(stored):
    found, folder = stored
    rows = {row["tissue"]: row for row in found["tissues"]}
    assert rows["skin (this study)"]["kind"] == "skin"
    assert rows["muscle (this study)"]["kind"] == "muscle"
    assert rows["skin (this study)"]["shear_modulus_kPa"] == pytest.approx(9.0)
    lim = rows["pig skin, along the spine (Lim 2011)"]
    assert lim["prony"] == [[2.0, 0.5]]
    assert lim["terms"] == [[20.0, 11.0]]
    assert rows["rat tibialis anterior (Bosboom 2001)"]["prony"] == [[0.549, 6.01]]
    assert json.loads((folder / "cube.json").read_text())["stress_kPa"].keys() == rows.keys()
    table = np.genfromtxt(folder / "cube.csv", delimiter=",", names=True)
    assert table["time_s"][-1] == 2.0
    assert table["skin_this_study_kPa"].max() == pytest.approx(rows["skin (this study)"]["peak_kPa"])
    drawn = (folder / "cube.svg").read_text()
    assert drawn.startswith("<?xml")
    assert "var(--" not in drawn


def test_every_published_tissue_has_its_citation():
    for tissue in PUBLISHED:
        assert any(year in tissue.source for year in ("2001", "2010", "2011", "2016", "2018"))
        assert tissue.conversion
        assert tissue.material(((1.0, 1.0),)).table().kappa == pytest.approx(tissue.bulk_kPa * KPA)


@pytest.mark.parametrize("percent", [0.0, -5.0, 80.0])
def test_a_compression_that_is_none_is_refused(percent):
    with pytest.raises(InputError, match="is not possible here"):
        compress_cube(compression_percent=percent)
