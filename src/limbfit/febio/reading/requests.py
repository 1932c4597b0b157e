"""The entries of ``<Output><logfile>``: what a FEBio input asks to be written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath

from .geometry import Geometry, find_node_set
from .tree import XmlNode

KNOWN_DATA = {
    "node_data": ("x", "y", "z", "ux", "uy", "uz"),
    "element_data": ("x", "y", "z", "sx", "sy", "sz", "sxy", "syz", "sxz", "s1", "s2", "s3", "J"),
    "rigid_body_data": ("x", "y", "z", "thx", "thy", "thz", "Fx", "Fy", "Fz", "Mx", "My", "Mz"),
}


@dataclass(frozen=True)
class Request:
    """One table per step: ``names`` of its columns, the ``items`` (ranges of FEBio's numbers; empty: all).

    ``members`` are the items if a set is asked for.
    """

    kind: str
    names: tuple[str, ...]
    file: str
    delimiter: str
    items: tuple[tuple[int, int], ...]
    members: frozenset[int] | None = None

    def includes(self, number: int) -> bool:
        """True if the item of that number is asked for."""
        if self.members is not None:
            return number in self.members
        return not self.items or any(low <= number <= high for low, high in self.items)


def read_requests(section: XmlNode | None, geometry: Geometry) -> tuple[tuple[Request, ...], tuple[str, ...]]:
    """Read the requests that limbfit can answer, with a note for everything else.

    Raises
    ------
    ProblemError
        For a set that does not exist, and for items that are no numbers.
    """
    requests, notes = [], list[str]()
    for output in section or ():
        if output.tag != "logfile":
            notes.append(f"{output.place}: not written")
            continue
        for entry in output:
            if entry.tag not in KNOWN_DATA:
                notes.append(f"{entry.place}: not written")
                continue
            names = [name.strip() for name in entry.attribute("data").split(";")]
            known = tuple(name for name in names if name in KNOWN_DATA[entry.tag])
            unknown = [name for name in names if name not in known]
            if unknown:
                what = ", ".join(repr(name[:40]) for name in unknown)
                notes.append(
                    f"{entry.place}: {what} not written; known are {', '.join(KNOWN_DATA[entry.tag])}"
                )
            if known:
                file = PurePosixPath(entry.attributes.get("file", "").replace("\\", "/")).name
                delimiter, members = entry.attributes.get("delim", " "), _find_members(entry, geometry)
                items = _read_items(entry) if members is None else ()
                requests.append(Request(entry.tag, known, file, delimiter, items, members))
    return tuple(requests), tuple(notes)


def _find_members(entry: XmlNode, geometry: Geometry) -> frozenset[int] | None:
    """Return the items of the set that an entry names, if it does."""
    node, element = entry.attributes.get("node_set"), entry.attributes.get("elem_set")
    if node is not None:
        return frozenset(geometry.node_ids[find_node_set(geometry, node, entry)].tolist())
    if element is None:
        return None
    if element not in geometry.element_sets:
        raise entry.error(f"there is no element set {element!r}")
    return frozenset(geometry.element_sets[element].tolist())


def _read_items(entry: XmlNode) -> tuple[tuple[int, int], ...]:
    """Read ranges of numbers: ``1,4,10:20`` (FEBio also has ``10:20:2``, which is refused)."""
    ranges = []
    for text in filter(None, (part.strip() for part in entry.text.split(","))):
        low, _, high = text.partition(":")
        if not (low.isdecimal() and (high or low).isdecimal()):
            raise entry.error(f"{text[:40]!r} is neither a number nor a range of numbers")
        ranges.append((int(low), int(high or low)))
    return tuple(ranges)
