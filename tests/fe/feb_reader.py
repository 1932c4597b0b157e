"""A reader for the few parts of a FEBio 4 input that the comparisons need: mesh, sets, materials, load."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from limbfit.fe import OgdenQLV


@dataclass(frozen=True)
class Feb:
    """Arrays of a `.feb`; nodes are renumbered from 0; ``elements`` by part name."""

    points: NDArray[np.float64]
    elements: dict[str, tuple[str, NDArray[np.int64], str]]  # part: type, cells, material
    node_sets: dict[str, NDArray[np.int64]]
    surfaces: dict[str, NDArray[np.int64]]
    materials: dict[str, OgdenQLV]
    load: NDArray[np.float64]
    root: ET.Element


def _numbers(text: str) -> NDArray[np.int64]:
    return np.array([int(v) for v in re.split(r"[,\s]+", text.strip())])


def _material(node: ET.Element) -> OgdenQLV:
    def value(path: str) -> float:
        return float(node.findtext(path))

    c = value("elastic/c1")
    return OgdenQLV(c, value("elastic/m1"), value("g1"), value("t1"), value("k") / c)


def read_feb(path: Path) -> Feb:
    root = ET.parse(path).getroot()
    mesh = root.find("Mesh")
    nodes = [n for group in mesh.findall("Nodes") for n in group]
    index = {int(n.get("id")): i for i, n in enumerate(nodes)}
    points = np.array([[float(v) for v in n.text.split(",")] for n in nodes])
    renumber = np.vectorize(index.__getitem__)
    owner = {d.get("name"): d.get("mat") for d in root.find("MeshDomains")}
    elements = {}
    for group in mesh.findall("Elements"):
        cells = renumber(np.array([_numbers(e.text) for e in group]))
        elements[group.get("name")] = (group.get("type"), cells, owner.get(group.get("name"), ""))
    sets = {s.get("name"): renumber(_numbers(s.text)) for s in mesh.findall("NodeSet")}
    surfaces = {
        s.get("name"): renumber(np.array([_numbers(f.text) for f in s])) for s in mesh.findall("Surface")
    }
    materials = {
        m.get("name"): _material(m)
        for m in root.find("Material")
        if m.get("type") == "uncoupled viscoelastic"
    }
    curve = root.find("LoadData/load_controller/points")
    load = np.array([[float(v) for v in p.text.split(",")] for p in curve])
    return Feb(points, elements, sets, surfaces, materials, load, root)


def read_log(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (n,) and values (n, k) of the first item of a FEBio log file."""
    times, rows = [], []
    for line in path.read_text().splitlines():
        if line.startswith("*Time"):
            times.append(float(line.split("=")[1]))
        elif line and not line.startswith("*"):
            rows.append([float(v) for v in line.split(",")[1:]])
    return np.array(times), np.array(rows)
