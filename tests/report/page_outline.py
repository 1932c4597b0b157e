"""What a page of a report consists of."""

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

from limbfit.report.build import _render
from limbfit.report.page import Page, Section
from limbfit.report.sections.contents import build_summary, list_key_numbers
from limbfit.report.store import Results, load_store

VOID = {"meta", "link", "br", "img", "input", "hr", "path", "image", "use", "line", "circle"}


class Outline(HTMLParser):
    """Collects tags with attributes, identifiers, and checks that what opens also closes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.tags if name == tag]


def section_of(text: str, name: str) -> str:
    found = re.search(rf'<section id="{name}".*?</section>', text, re.DOTALL)
    assert found, name
    return found.group()


def table_of(text: str, name: str) -> str:
    found = re.search(rf'<table id="table-{name}">.*?</table>', text, re.DOTALL)
    assert found, name
    return found.group()


def cells_of(text: str, table: str) -> list[list[str]]:
    """What stands in a table, row by row."""
    rows = re.findall(r"<tr>\s*(.*?)\s*</tr>", table_of(text, table), re.DOTALL)
    return [re.findall(r">([^<]*)</t[hd]>", row) for row in rows]


def without_scripts(text: str) -> str:
    return re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


def render_sections(results: Path, *makers: Callable[[Results], Section]) -> str:
    """A page of its summary and those sections alone, as a whole report has them."""
    store = load_store(results)
    sections = tuple(make(store) for make in makers)
    return _render(Page("", "", list_key_numbers(store), build_summary(store), sections, ""))
