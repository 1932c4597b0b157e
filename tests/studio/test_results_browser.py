"""What the view Results makes and gives away, in a real browser: simulations played, files downloaded."""

import re
import shutil

import numpy as np
import pytest
import pyvista as pv

from browsing import until
from conftest import COARSE
from editing import append
from limbfit import load_study, run_study
from limbfit.febio import read_feb, to_problem
from limbfit.studio.results_routes import FIELDS

MOMENT = re.compile(r"(\S+) s; von Mises stress (\S+) to (\S+) kPa")
PLACES = {"1": (40.0, 0.0, 60.0), "2": (0.0, 40.0, 50.0)}  # of the stump's sites, mm


@pytest.fixture(scope="module")
def meshed(pristine, tmp_path_factory):
    """The stump with coarse meshes of both sites."""
    folder = shutil.copytree(pristine, tmp_path_factory.mktemp("meshed") / "study")
    append(folder, COARSE)
    run_study(load_study(folder), until="mesh")
    return folder


@pytest.fixture
def stump(meshed, tmp_path):
    return shutil.copytree(meshed, tmp_path / "study")


def choose(page, site: str) -> None:
    page.get_by_role("combobox", name="site", exact=True).select_option(site)
    page.get_by_role("heading", name=f"Site {site}").wait_for()


def download(page, title: str, folder):
    """The file that a link gives, under the name that it is given."""
    with page.expect_download() as waiting:
        page.get_by_role("link", name=title, exact=True).click()
    file = folder / waiting.value.suggested_filename
    waiting.value.save_as(file)
    return file


def is_beside(points: np.ndarray, site: str) -> bool:
    """Whether the middle of some points is nearer to a site than to the other."""
    far = {name: np.linalg.norm(points.mean(axis=0) - place) for name, place in PLACES.items()}
    return min(far, key=far.get) == site and far[site] < 20.0


@pytest.mark.slow
def test_every_step_is_simulated_played_and_told_with_its_unit(stump, serve, open_page, tmp_path):
    page = open_page(serve(stump) + "#/results")
    choose(page, "2")
    page.get_by_text("No fields are stored for this site.").wait_for()
    page.get_by_role("button", name="Simulate every step, to play it").click()
    page.get_by_text("simulating site 2").wait_for()
    page.get_by_role("button", name="Simulate every step again").wait_for(timeout=300_000)
    page.get_by_text("simulating site 2").wait_for(state="detached", timeout=300_000)
    steps = sorted((stump / "results" / "simulate" / "2").glob("step-*.vtu"))
    slider, words = page.get_by_label("moment", exact=True), page.locator(".player-words")
    assert int(slider.get_attribute("max")) == len(steps) - 1 >= 6
    largest = []
    for at, step in enumerate(steps):  # what is told is what is stored
        slider.fill(str(at))
        told = until(lambda: MOMENT.match(words.inner_text()))
        stored = pv.read(step).cell_data["von_mises_kPa"]
        assert float(told[3]) == pytest.approx(stored.max(), rel=0.01, abs=0.01)
        largest.append(stored.max())
    deepest = int(np.argmax(largest))
    assert 0 < deepest < len(steps) - 1
    assert largest[deepest] > 1.0 > largest[0]
    unseen = page.locator(".view.results .lf-canvas").screenshot()
    slider.fill("0")
    page.get_by_label("speed").select_option("4")
    page.get_by_role("button", name="Play").click()
    until(lambda: int(slider.input_value()) == len(steps) - 1)
    until(lambda: page.get_by_role("button", name="Play").count())  # it has stopped by itself
    slider.fill(str(deepest))
    until(lambda: page.locator(".view.results .lf-canvas").screenshot() != unseen)
    shown = page.get_by_role("combobox", name="show", exact=True)
    names = shown.locator("option").evaluate_all("all => all.map((option) => option.value)")
    assert {"displacement", "von_mises", "contact_pressure", "largest_stretch", "J"} <= set(names)
    for name in names:
        shown.select_option(name)
        scale = f"{FIELDS[name].title} ({FIELDS[name].unit})"
        until(lambda wanted=scale: page.locator(".view.results .lf-bar-title").inner_text() == wanted)
    curve = np.genfromtxt(download(page, "simulated curve (CSV)", tmp_path), delimiter=",", names=True)
    assert curve["force_N"].max() > 0.1
    fields = pv.read(download(page, "simulated fields (VTU)", tmp_path))
    assert is_beside(fields.points[np.linalg.norm(fields["displacement_mm"], axis=1) > 2.0], "2")


@pytest.mark.slow
def test_files_of_the_second_site_are_its_own(stump, serve, open_page, tmp_path):
    """The FEBio input, the mesh and the record, pressed on the page and read back."""
    page = open_page(serve(stump) + "#/results")
    choose(page, "2")
    page.get_by_role("button", name="Write the FEBio input (.feb)").click()
    problem = to_problem(read_feb(download(page, "FEBio input (.feb)", tmp_path)))
    mesh = download(page, "mesh (VTU)", tmp_path)
    assert mesh.read_bytes() == (stump / "results" / "mesh" / "2.vtu").read_bytes()
    own = pv.read(mesh)
    assert own.points.shape == problem.mesh.points.shape
    assert np.abs(own.points - problem.mesh.points).max() < 1e-4
    assert own.n_cells == len(problem.mesh.cells)
    touched = problem.mesh.points[np.unique(problem.contact_faces)]
    assert is_beside(touched, "2")
    assert not is_beside(touched, "1")
    record = np.genfromtxt(download(page, "regularised record (CSV)", tmp_path), delimiter=",", names=True)
    assert record["displacement_mm"].max() == pytest.approx(5.0, abs=0.3)  # as the stump's records are made
    assert record["force_N"].max() == pytest.approx(6.0, abs=0.5)
    choose(page, "1")
    assert page.get_by_role("link", name="FEBio input (.feb)").count() == 0
    assert download(page, "mesh (VTU)", tmp_path / "other").read_bytes() != mesh.read_bytes()
