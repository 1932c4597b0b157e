"""The report as a file in a real browser: nothing is asked for, and its figures answer."""

import pytest
from stored_results import SITES, write_results

from browsing import WITHOUT_WEBGL, until
from editing import rewritten
from limbfit.report import build_report

pytestmark = pytest.mark.slow
HOSTILE = "</script><script>document.title='taken'</script><!--"


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two sites, one with fields; a region, a bone and the study with names that would end a script."""
    results = write_results(tmp_path_factory.mktemp("study") / "results", sites=SITES[3:5], name=HOSTILE)
    for file in (results / "sites" / "sites.json", results / "predict" / "predict.json"):
        with rewritten(file) as content:
            content["sites"][0]["region"] = HOSTILE
    return build_report(results, results / "report").as_uri()


def asked(page) -> list[str]:
    return page.evaluate("performance.getEntriesByType('resource').map((entry) => entry.name)")


def test_the_limb_is_drawn_and_its_fields_and_curves_are_read(address, open_page):
    page = open_page(address)
    figure = page.locator("#interactive-explorer")
    canvas = figure.locator(".lf-canvas")
    canvas.scroll_into_view_if_needed()
    limb = canvas.screenshot()
    canvas.focus()
    page.keyboard.press("ArrowLeft")
    until(lambda: canvas.screenshot() != limb)
    field = figure.locator("label", has_text="Show").locator("select")
    field.select_option("stress")
    assert "von Mises stress (kPa)" in figure.locator(".lf-bar").inner_text()
    figure.locator(".lf-plot").focus()
    page.keyboard.press("Shift+ArrowRight")
    words = figure.locator(".lf-readout").inner_text()
    assert words.startswith("measured: time")
    assert words.count(" N") == 2  # the force, and its interval
    figure.locator("label", has_text="Site").locator("select").select_option("TI-5")
    assert field.locator("option[value=stress]").is_disabled()  # no field is stored there
    assert asked(page) == []


def test_records_and_iterates_change_what_they_show(address, open_page):
    page = open_page(address)
    for name, label, other in (("records", "Site", "TI-5"), ("iterates", "Show", "1")):
        figure = page.locator(f"#interactive-{name}")
        plot = figure.locator(".lf-plot")
        plot.scroll_into_view_if_needed()
        before = plot.screenshot()
        figure.locator("label", has_text=label).first.locator("select").select_option(other)
        until(lambda before=before, plot=plot: plot.screenshot() != before)


def test_names_stay_text(address, open_page):
    page = open_page(address)
    assert "taken" in page.title()  # as text of the title, whole
    assert page.title().startswith(HOSTILE)
    figure = page.locator("#interactive-explorer")
    assert HOSTILE in figure.locator(".explorer-words").inner_text()
    assert page.evaluate("document.scripts.length") == 4  # three blocks of data and the report's own


def test_without_webgl_pictures_stand_in_and_are_named(address, open_page):
    page = open_page(address, arguments=WITHOUT_WEBGL)
    assert "the pictures below show the same" in page.locator("#interactive-explorer").inner_text()
    assert page.locator("#figure-model svg").is_visible()
    assert page.locator("#interactive-records .lf-plot").is_visible()


def test_printed_pages_hold_pictures_and_no_controls(address, open_page):
    page = open_page(address)
    page.emulate_media(media="print")
    assert not page.locator("#interactive-explorer").is_visible()
    assert page.locator("#figure-model svg").is_visible()
