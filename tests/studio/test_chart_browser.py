"""Curves in a real browser: a part is enlarged by drag, a double click shows all."""

import pytest

from browsing import until


@pytest.mark.slow
def test_a_part_of_a_curve_is_enlarged_and_all_shown_again(study, serve, open_page):
    page = open_page(serve(study) + "#/traces")
    touch, peak = (page.locator(f"[data-key={key}]").first for key in ("touch_down_s", "peak_s"))
    peak.wait_for()
    plot = page.locator(".u-over").first.bounding_box()

    def share() -> float:
        """Where the peak stands, of the plot's width."""
        box = peak.bounding_box()
        return (box["x"] + 8 - plot["x"]) / plot["width"]

    before = share()
    low, high = before - 0.2, before + 0.3
    page.mouse.move(plot["x"] + low * plot["width"], plot["y"] + 0.2 * plot["height"])
    page.mouse.down()
    page.mouse.move(plot["x"] + high * plot["width"], plot["y"] + 0.8 * plot["height"], steps=4)
    page.mouse.up()
    until(lambda: share() != before)
    assert share() == pytest.approx(0.4, abs=0.01)
    assert not touch.is_visible()
    page.mouse.dblclick(plot["x"] + 0.1 * plot["width"], plot["y"] + 0.5 * plot["height"])
    until(lambda: abs(share() - before) < 0.002)
    assert touch.is_visible()
