"""A page as one HTML file: the packaged Jinja2 templates with styles and scripts put inside."""

from __future__ import annotations

import json
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ..web.assets import asset, inline_script, integrity
from .page import Page

SCRIPTS = (
    "vendor/three.min.js",
    "vendor/uPlot.min.js",
    "arrays.js",
    "colours.js",
    "overlay.js",
    "camera.js",
    "volume.js",
    "viewer.js",
    "chart.js",
)
STYLES = ("vendor/uPlot.min.css", "web.css")


def render(page: Page) -> str:
    """The page as HTML text: one file, no requests, every text escaped.

    Its policy lets one script run, told by its digest, and lets nothing be loaded or sent.
    """
    environment = Environment(
        loader=PackageLoader("limbfit.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data"] = _data

    def source(name: str) -> str:
        return environment.loader.get_source(environment, name)[0]  # type: ignore[union-attr]

    moves = any(block.kind == "interactive" for section in page.sections for block in section.blocks)
    script = f"(() => {{\n{inline_script(*SCRIPTS)}\n{source('report.js')}}})();" if moves else ""
    style = "\n".join([source("report.css"), *(asset(name) for name in STYLES if moves)])
    return environment.get_template("report.html.j2").render(
        page=page, css=Markup(style), script=Markup(script), script_source=integrity(script) if moves else ""
    )


def _data(content: Any) -> Markup:
    """JSON that cannot end the element that holds it, whatever its texts are."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
