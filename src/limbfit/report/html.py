"""A page as one HTML file: the packaged Jinja2 templates with everything inlined."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from .page import Page


def render(page: Page) -> str:
    """The page as HTML text: one file, no requests, every text escaped."""
    environment = Environment(
        loader=PackageLoader("limbfit.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    source, _, _ = environment.loader.get_source(environment, "report.css")  # type: ignore[union-attr]
    return environment.get_template("report.html.j2").render(page=page, css=Markup(source))
