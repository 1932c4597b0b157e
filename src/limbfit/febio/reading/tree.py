"""XML of untrusted origin read as a tree with line numbers, in bounded memory.

Python's own expat parser is used. A document type is refused, and with it every entity, external or nested.
Nothing is ever opened but the file itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

from ...errors import ProblemError, add_location

MAX_BYTES = 256 * 2**20  # some two million nodes
MAX_DEPTH = 40
_CHUNK = 2**20


@dataclass(slots=True, eq=False)
class XmlNode(list["XmlNode"]):
    """An element of the file: the list of its children; ``text`` is what else stands between its tags."""

    tag: str
    attributes: dict[str, str]
    line: int
    text: str = ""

    @property
    def place(self) -> str:
        """Its place in the file."""
        return f"line {self.line}, <{self.tag}>"

    def error(self, what: str, remedy: str | None = None) -> ProblemError:
        """Return the error that says what is wrong here."""
        return ProblemError(what, place=self.place, remedy=remedy)

    def find_all(self, tag: str) -> list[XmlNode]:
        """Return the children of that name."""
        return [child for child in self if child.tag == tag]

    def find(self, tag: str) -> XmlNode | None:
        """Return the one child of that name, if there is one."""
        found = self.find_all(tag)
        if len(found) > 1:
            raise found[1].error("is there twice")
        return found[0] if found else None

    def child(self, tag: str) -> XmlNode:
        """Return the one child of that name, which must exist."""
        found = self.find(tag)
        if found is None:
            raise self.error(f"has no <{tag}>")
        return found

    def attribute(self, name: str) -> str:
        value = self.attributes.get(name)
        if not value:
            raise self.error(f"has no attribute {name!r}")
        return value

    def string(self, tag: str, default: str | None = None) -> str:
        """Return the text of a child."""
        found = self.find(tag)
        if found is None and default is not None:
            return default
        return self.child(tag).text.strip()

    def number(self, tag: str, default: float | None = None) -> float:
        """Return the number in a child."""
        found = self.find(tag)
        if found is None and default is not None:
            return default
        return self.child(tag).scalar()

    def flag(self, tag: str) -> bool:
        """True if a child says 1; without the child it is False."""
        return self.number(tag, 0.0) != 0.0

    def scalar(self) -> float:
        """Return the number that this element holds."""
        return self.numbers(1)[0]

    def numbers(self, count: int) -> list[float]:
        """Return the ``count`` finite numbers, separated by commas, that this element holds."""
        try:
            values = [float(part) for part in self.text.split(",")]
        except ValueError:
            values = []
        if len(values) != count:
            raise self.error(f"{_shorten(self.text)} is not {count} numbers")
        if not all(map(math.isfinite, values)):
            raise self.error(f"{_shorten(self.text)} is not finite")
        return values

    def integers(self) -> list[int]:
        """Return the whole numbers, separated by commas, that this element holds."""
        try:
            return [int(part) for part in self.text.split(",")]
        except ValueError:
            raise self.error(f"{_shorten(self.text)} is not whole numbers") from None

    def identity(self) -> int:
        """Return the attribute ``id``."""
        text = self.attribute("id")
        if not text.isdecimal() or len(text) > 18:
            raise self.error(f"id {_shorten(text)} is not a whole number")
        return int(text)


def _shorten(text: str) -> str:
    text = text.strip()
    return repr(text if len(text) <= 40 else text[:37] + "...")


def read_tree(path: str | Path) -> XmlNode:
    """Read the root of an XML file.

    Raises `ProblemError` if the file is missing, too large or nested too deeply, is not well-formed, or
    has a document type.
    """
    file = Path(path)
    builder = _TreeBuilder()
    with add_location(file=file):
        try:
            with file.open("rb") as stream:
                if file.stat().st_size > MAX_BYTES:
                    size = f"{file.stat().st_size / 2**20:.0f} MB"
                    raise ProblemError(f"has {size}; no more than {MAX_BYTES // 2**20} are read")
                builder.parser.ParseFile(stream)
        except OSError as error:
            raise ProblemError(error.strerror or "cannot be read") from error
        except (expat.ExpatError, LookupError, ValueError) as error:
            what = f"is not well-formed XML: {error}"
            raise ProblemError(what, remedy="export it again") from None
    assert builder.root is not None  # expat has refused an empty document
    return builder.root


class _TreeBuilder:
    def __init__(self) -> None:
        self.root: XmlNode | None = None
        self.open: list[XmlNode] = []
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.buffer_size = _CHUNK
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.StartDoctypeDeclHandler = self._doctype

    def _doctype(self, *_: Any) -> None:
        what = "has a document type, which may hold entities; none is read"
        raise ProblemError(what, place=f"line {self.parser.CurrentLineNumber}", remedy="remove <!DOCTYPE>")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        node = XmlNode(tag, attributes, self.parser.CurrentLineNumber)
        if len(self.open) >= MAX_DEPTH:
            raise node.error(f"lies deeper than {MAX_DEPTH} elements")
        if self.open:
            self.open[-1].append(node)
        else:
            self.root = node
        self.open.append(node)

    def _end(self, _: str) -> None:
        self.open.pop()

    def _text(self, text: str) -> None:
        self.open[-1].text += text
