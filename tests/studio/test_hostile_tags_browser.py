"""Markup in DICOM tags and in names: nothing of it runs on any view, no tag is shown, sent or stored."""

import gzip
from warnings import catch_warnings, simplefilter

import pydicom
import pytest

from browsing import PATIENCE_MS, until
from conftest import write_trace
from limbfit import study_status
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.mri import make_grid, write_series
from limbfit.phantom.robot import build_true_sites
from limbfit.study import load_study

ATTACKS = (
    "<img src=x onerror=window.hacked=1>TAGSECRET{}",
    "<script>window.hacked=1;alert(1)</script>TAGSECRET{}",
    "'\"><svg onload=window.hacked=1>TAGSECRET{}",
)
LONG_TAGS = ("PatientName", "SeriesDescription", "StudyDescription", "ProtocolName", "PatientID", "StudyID",
             "InstitutionName", "OperatorsName", "Manufacturer", "ManufacturerModelName", "StationName",
             "ReferringPhysicianName", "AccessionNumber", "PatientComments", "ImageComments", "SequenceName",
             "BodyPartExamined", "SoftwareVersions", "InstitutionAddress", "AdmissionID")  # fmt: skip
SECRETS = (b"tagsecret", "tagsecret".encode("utf-16-le"))
NAME = "<img src=x onerror=window.hacked=2>"  # of the study and of a region: shown, as text
STUDY = """
[study]
name = "{name}"
[image]
path = "mri"
[geometry]
surface_edge_mm = 6.0
[[sites]]
name = "1"
fitted = true
region = "{name}"
trace = "1.csv"
position = {place}
"""


@pytest.fixture(scope="module")
def limb(tmp_path_factory):
    """A study of a synthetic limb with an attack in every tag that holds words."""
    folder = tmp_path_factory.mktemp("hostile")
    limb = make_limb(3)
    write_series(folder / "mri", limb, make_grid(limb, "coarse", 3), seed=3)
    with catch_warnings():
        simplefilter("ignore")  # such values are longer than tags may be
        for file in (folder / "mri").iterdir():
            data = pydicom.dcmread(file)
            for n, tag in enumerate(LONG_TAGS):
                setattr(data, tag, ATTACKS[n % len(ATTACKS)].format(n))
            data.save_as(file)
    site = build_true_sites(limb, 3)[0]
    (folder / "study.toml").write_text(
        STUDY.format(name=NAME, place=[round(float(x), 2) for x in site.position])
    )
    write_trace(folder / "1.csv")
    return folder


def holds_a_tag(content: bytes) -> bool:
    return any(secret in content.lower() for secret in SECRETS)


class Watched:
    """A page all of whose answers and dialogues are looked at."""

    def __init__(self, page) -> None:
        self.page, self.leaks, self.answers, self.dialogues = page, [], 0, []
        page.on("dialog", lambda dialogue: (self.dialogues.append(dialogue.message), dialogue.dismiss()))
        page.route("**/*", self.look)

    def look(self, route) -> None:
        answer = route.fetch()
        self.answers += 1
        if holds_a_tag(answer.body()) or holds_a_tag(repr(answer.headers).encode()):
            self.leaks.append(route.request.url)
        route.fulfill(response=answer)

    def check(self) -> None:
        page = self.page
        assert page.evaluate("window.hacked") is None
        assert page.locator("[onerror], [onload], main script, main svg[onload]").count() == 0
        assert not holds_a_tag(page.content().encode())
        assert not holds_a_tag(page.evaluate("document.documentElement.innerText").encode())
        assert (self.dialogues, self.leaks) == ([], [])


@pytest.mark.slow
def test_no_tag_is_run_shown_sent_or_stored(limb, serve, launch):
    """Everything made from the page itself; then a slice is lost, and what is said of that is looked at."""
    assert holds_a_tag(next((limb / "mri").iterdir()).read_bytes())  # the search finds what is planted
    address = serve(limb)
    page = launch().new_page(viewport={"width": 1280, "height": 800})
    page.set_default_timeout(PATIENCE_MS)
    watched = Watched(page)
    page.goto(address + "#/identification")
    page.locator("#run-until option[value=sites]").wait_for(state="attached")
    page.locator("#run-until").select_option("sites")
    page.locator("#run-start").click()
    until(
        lambda: "done" in {row["state"] for row in study_status(load_study(limb)) if row["stage"] == "sites"},
        300,
    )
    page.reload()
    drawn = {
        "identification": page.locator("#run-state").get_by_text("The last run"),
        "image": page.locator(".view.image[data-state=ready]"),
        "model": page.get_by_role("checkbox", name="tibia"),
        "traces": page.locator("#trace-facts dd").first,
        "results": page.get_by_text("No fields are stored for this site."),
    }
    for view, sign in drawn.items():
        page.evaluate("(view) => (location.hash = `#/${view}`)", view)
        sign.wait_for()
        page.wait_for_timeout(300)
        watched.check()
    assert NAME in page.locator("#study-name").inner_text()
    assert NAME in page.locator(".view.results option").first.inner_text()
    for path in ("study", "stages", "changes", "image", "model/scene", "traces", "identification", "results"):
        page.evaluate("(path) => fetch(`/api/${path}`).then((answer) => answer.text())", path)
    assert watched.answers > 30
    for file in (limb / "results").rglob("*"):
        assert not holds_a_tag(file.name.encode())
        if file.is_file():
            raw = file.read_bytes()
            assert not holds_a_tag(raw), file.name
            if file.suffix == ".nrrd":
                assert not holds_a_tag(gzip.decompress(raw.partition(b"\n\n")[2])), file.name
    sorted((limb / "mri").iterdir())[30].unlink()
    page.goto(page.url.partition("#")[0] + "#/image")
    page.reload()
    page.get_by_text("Cannot read the image").wait_for()
    page.evaluate("location.hash = '#/identification'")
    page.locator("#run-start").click()
    until(lambda: page.locator("#run-state.bad").count())
    watched.check()
    page.unroute_all(behavior="ignoreErrors")
    page.close()
