"""What a FEBio input asks to be written: the entries of ``<Output><logfile>``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath

from .tree import Node

KNOWN = {
    "node_data": ("x", "y", "z", "ux", "uy", "uz"),
    "element_data": ("x", "y", "z", "sx", "sy", "sz", "sxy", "syz", "sxz", "s1", "s2", "s3", "J"),
    "rigid_body_data": ("x", "y", "z", "Fx", "Fy", "Fz"),
}


@dataclass(frozen=True)
class Request:
    """One table per step: ``names`` of its columns, the ``items`` (FEBio's numbers; empty: all)."""

    kind: str
    names: tuple[str, ...]
    file: str
    delimiter: str
    items: tuple[tuple[int, int], ...]

    def wants(self, number: int) -> bool:
        """Whether the item of that number is asked for."""
        return not self.items or any(low <= number <= high for low, high in self.items)


def read_requests(section: Node | None) -> tuple[tuple[Request, ...], tuple[str, ...]]:
    """The requests that limbfit can answer, and a note for everything else."""
    requests, notes = [], list[str]()
    for output in section or ():
        if output.tag != "logfile":
            notes.append(f"{output.place}: not written")
            continue
        for entry in output:
            if entry.tag not in KNOWN or {"node_set", "elem_set"} & set(entry.attributes):
                notes.append(f"{entry.place}: not written")
                continue
            names = [name.strip() for name in entry.attribute("data").split(";")]
            known = tuple(name for name in names if name in KNOWN[entry.tag])
            unknown = [name for name in names if name not in known]
            if unknown:
                what = ", ".join(repr(name[:40]) for name in unknown)
                notes.append(f"{entry.place}: {what} not written; known are {', '.join(KNOWN[entry.tag])}")
            if known:
                file = PurePosixPath(entry.attributes.get("file", "").replace("\\", "/")).name
                requests.append(
                    Request(entry.tag, known, file, entry.attributes.get("delim", " "), _items(entry))
                )
    return tuple(requests), tuple(notes)


def _items(entry: Node) -> tuple[tuple[int, int], ...]:
    """Ranges of numbers: ``1,4,10:20`` (FEBio also knows ``10:20:2``, which is refused)."""
    ranges = []
    for text in filter(None, (part.strip() for part in entry.text.split(","))):
        low, _, high = text.partition(":")
        if not (low.isdecimal() and (high or low).isdecimal()):
            raise entry.refuse(f"{text[:40]!r} is neither a number nor a range of numbers")
        ranges.append((int(low), int(high or low)))
    return tuple(ranges)
