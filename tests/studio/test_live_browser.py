"""A session seen in a real browser while `limbfit acquire` records it from a virtual FitSocket."""

import re
import time

import pytest

from acquiring import fitsocket, start
from browsing import serious_findings, until
from editing import append
from limbfit.acquire import read_recording


def acquire(study, address: str, site: str = "1"):
    return start("acquire", study, "--device", address, "--unattended", "--site", site, "--depth", 4.0)


def seconds(page) -> float:
    """How far the session is, as the page says."""
    found = re.search(r"([0-9.]+) s, -?[0-9.]+ mm from (home|touch), -?[0-9.]+ N of at most 25 N", now(page))
    return float(found[1]) if found else -1.0


def now(page) -> str:
    return page.locator("#live-now").inner_text() if page.locator("#live-now").count() else ""


def state(page) -> str | None:
    return page.locator("#live").get_attribute("data-state")


@pytest.mark.slow
def test_curves_grow_outlast_a_reload_and_end_in_the_verdict(ready, serve, open_page):
    append(ready, "precondition = 4\n")  # long enough for a browser on a busy machine
    page = open_page(serve(ready) + "#/traces")
    page.get_by_role("heading", name="Site 1").wait_for()
    assert not page.locator("#live").is_visible()
    with fitsocket(ready, "--speed", "1.2") as (address, _):
        host = acquire(ready, address)
        until(lambda: seconds(page) > 0.5)
        assert state(page) == "live"
        plot = page.locator("#live .u-over").last
        before, drawn = seconds(page), plot.screenshot()
        until(lambda: seconds(page) > before + 1)
        assert page.locator("#live .lf-plot canvas").last.screenshot() != drawn
        page.reload()
        until(lambda: seconds(page) > before + 1)
        assert state(page) == "live"
        seen = set()
        while state(page) == "live":
            seen.add(now(page).partition("\n")[0])
            time.sleep(0.05)
        host.communicate(timeout=60)
    until(lambda: state(page) == "judged")
    assert any(re.match("load, ramp [1-5] of 5", text) for text in seen), seen
    assert "the record is good" in page.locator("#live h2").inner_text()
    assert "ramps: 1 of 1 ramps" in page.locator("#live-verdict").inner_text()
    assert serious_findings(page) == []
    # What is drawn is what was recorded.
    record = read_recording(next(ready.glob("acquired/1/*/record.csv")))
    force = page.locator("#live .lf-plot").last
    force.press("ArrowRight")
    said = page.locator("#live .lf-readout").last.inner_text()
    assert "test pin: time of the session" in said
    value = float(re.search(r"force (\S+) N", said)[1].replace("−", "-"))
    assert value == pytest.approx(record.force_mN[4, 0] / 1000, abs=0.002)
    page.locator("#live-record").click()
    until(lambda: "Touch-down" in page.locator("#trace-facts").inner_text())
    page.locator("#live").get_by_role("button", name="Close").click()
    assert not page.locator("#live").is_visible()
    until(lambda: page.locator("#strip .stage", has_text="traces").count())


@pytest.mark.slow
def test_a_killed_session_is_not_shown_as_live_and_a_stopped_one_says_why(ready, serve, open_page):
    page = open_page(serve(ready) + "#/traces")
    page.get_by_role("heading", name="Site 1").wait_for()
    with fitsocket(ready, "--speed", "5") as (address, _):
        killed = acquire(ready, address)
        until(lambda: seconds(page) > 0.5)
        killed.kill()
        killed.communicate()
        until(lambda: state(page) == "broken")
        assert "No new sample for" in page.locator("#live-note").inner_text()
        time.sleep(3)  # the device takes its host for gone, and comes home
        stopped = acquire(ready, address, "2")
        until(lambda: "Site 2" in page.locator("#live h2").inner_text() and seconds(page) > 0.5)
        stopped.terminate()
        stopped.communicate(timeout=60)
    until(lambda: state(page) == "stopped")
    assert "signal SIGTERM" in page.locator("#live-note").inner_text()
