"""The tables of ``study.toml`` that say how sites are meshed, and how many cells that makes."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from .tables import Positive, TomlTable

MAX_CELLS = 3e6  # some 4 million nodes: more than a workstation solves
_MAX_DISTANCE_MM = 80.0  # the farthest tissue from a site that counts
_DEPTH_RATIO = 1.5  # the fine zone is an ellipsoid, shallower than wide by this ratio
_CELLS_PER_CUBE = 6.0 * np.sqrt(2.0)  # regular tetrahedra in the cube of their edge


def estimate_cells(edge_near_mm: float, edge_far_mm: float, near_radius_mm: float, growth: float) -> float:
    """Estimate how many tetrahedra the mesh of a site has: those that fill half an ellipsoid around it."""
    radius = np.linspace(0.0, _MAX_DISTANCE_MM, 2001)
    edge = np.minimum(edge_near_mm + growth * np.maximum(radius - near_radius_mm, 0.0), edge_far_mm)
    volume = np.diff(2.0 / 3.0 * np.pi * radius**3 / _DEPTH_RATIO)
    return float(np.sum(volume * _CELLS_PER_CUBE / ((edge[1:] + edge[:-1]) / 2) ** 3))


def _to_edges(*values: float) -> dict[str, float]:
    return dict(zip(("edge_near_mm", "edge_far_mm", "near_radius_mm", "growth", "flatness"), values))


# What ``mesh.accuracy`` stands for: a site's own mesh, and a coarse one where that is much cheaper. Edges far
# from the indenter, where tissue hardly strains, cost unknowns and change the force little
# (docs/convergence.md).
ACCURACIES: Mapping[str, tuple[dict[str, float], dict[str, float] | None]] = {
    "fast": (_to_edges(4.5, 30.0, 12.0, 0.9, 1.6), None),
    "standard": (_to_edges(3.5, 30.0, 14.0, 0.6, 1.6), None),
    "fine": (_to_edges(3.0, 24.0, 14.0, 0.6, 1.6), _to_edges(5.5, 30.0, 12.0, 0.9, 1.6)),
}
_DEFAULT_EDGES = ACCURACIES["standard"][0]
REFERENCE_WIDTH_MM = 20.0  # width of the indenter for which those edges are made


def list_indenter_widths(content: Mapping[str, Any]) -> list[float]:
    """List the indenter widths, mm, in a study file's ``content``; its tables refuse malformed ones."""
    more = content.get("indenters", {})
    tables = [content.get("indenter", {}), *(more.values() if isinstance(more, Mapping) else ())]
    widths = [table.get("width_mm", REFERENCE_WIDTH_MM) for table in tables if isinstance(table, Mapping)]
    known = [float(width) for width in widths if isinstance(width, int | float) and width > 0]
    return known or [REFERENCE_WIDTH_MM]


def replace_edges(mesh: Any, widths_mm: Sequence[float] = (REFERENCE_WIDTH_MM,)) -> Any:
    """The table ``mesh`` as stated, with the edge lengths that it leaves open.

    They are those of its accuracy. Near a site they are as much shorter as the narrowest of ``widths_mm`` is
    narrower than usual, and hold as much less far as the widest is.
    """
    if not isinstance(mesh, Mapping):  # a table already, or nothing that could be one
        return mesh
    narrow, wide = (min(1.0, width / REFERENCE_WIDTH_MM) for width in (min(widths_mm), max(widths_mm)))

    def scale_edges(edges: Mapping[str, float]) -> dict[str, float]:
        near, radius = narrow * edges["edge_near_mm"], wide * edges["near_radius_mm"]
        return {**edges, "edge_near_mm": round(near, 3), "near_radius_mm": round(radius, 3)}

    fine, second = ACCURACIES.get(str(mesh.get("accuracy", "standard")), ACCURACIES["standard"])
    coarse = None if second is None else scale_edges(second)
    near = mesh.get("edge_near_mm", 0.0)
    if coarse and isinstance(near, int | float) and near >= coarse["edge_near_mm"]:
        coarse = None  # it would be no coarser
    return {**scale_edges(fine), "coarse": coarse, **mesh}


class EdgesTable(TomlTable):
    """The edge lengths of a mesh; the defaults are those of ``mesh.accuracy = "standard"``."""

    edge_near_mm: Positive = _DEFAULT_EDGES["edge_near_mm"]
    edge_far_mm: Positive = _DEFAULT_EDGES["edge_far_mm"]
    near_radius_mm: Positive = _DEFAULT_EDGES["near_radius_mm"]
    growth: Positive = _DEFAULT_EDGES["growth"]
    flatness: Annotated[float, Field(ge=1, le=2)] = _DEFAULT_EDGES["flatness"]

    def check_keys(self) -> None:
        """Refuse edge lengths that make more than `MAX_CELLS` cells per site."""
        far, radius, growth = self.edge_far_mm, self.near_radius_mm, self.growth
        cells = estimate_cells(self.edge_near_mm, far, radius, growth)
        if cells <= MAX_CELLS:
            return
        counted = f"{cells / 1e9:.2g} billion" if cells > 5e8 else f"{cells / 1e6:.2g} million"
        where = f"edge_near_mm = {self.edge_near_mm:g} with edge_far_mm = {far:g}"
        edges = np.geomspace(0.01, 20.0, 400)
        # The shortest edge that keeps the mesh within the limit; the far edge follows.
        few = [estimate_cells(e, max(far, e), radius, growth) <= MAX_CELLS for e in edges]
        finest = np.ceil(100 * edges[np.argmax(few)]) / 100
        raise ValueError(
            f"{where} makes about {counted} cells per site, and {MAX_CELLS / 1e6:g} million are the most; "
            f"give edge_near_mm of {finest:g} or more (edge_far_mm no less), or a smaller near_radius_mm"
        )


class CoarseMeshTable(EdgesTable):
    """The second mesh of each site, on which the identification takes its derivatives: edge lengths."""

    edge_near_mm: Positive = 5.5
    near_radius_mm: Positive = 12.0
    growth: Positive = 0.9


class MeshTable(EdgesTable):
    """The mesh of each site: element and edge lengths near the indenter and far from it.

    ``accuracy`` sets all edge lengths; those that are stated go before it. With ``coarse``, parameters are
    searched on coarse meshes, whose forces these meshes correct.
    ``element``: linear tetrahedra, or quadratic ones with the pressure as it comes or constant in each.
    """

    accuracy: Literal["fast", "standard", "fine"] = Field(default="standard", exclude=True)  # edges say it

    element: Literal["tet4", "tet10", "tet10p0"] = "tet10p0"
    engine: Literal["mmg", "netgen"] = "mmg"
    time_limit_s: Positive = 600.0
    coarse: CoarseMeshTable | None = None

    def find_accuracy(self, widths_mm: Sequence[float]) -> str | None:
        """Find the ``accuracy`` that has these edges for such indenters; None if the study states others."""
        apart = {"element", "engine", "time_limit_s"}
        edges = self.model_dump(exclude=apart)
        for name in ACCURACIES:
            usual = MeshTable.model_validate(replace_edges({"accuracy": name}, widths_mm))
            if edges == usual.model_dump(exclude=apart):
                return name
        return None

    @property
    def cell_type(self) -> Literal["tet4", "tet10"]:
        """The cells of the mesh, whatever is solved on them."""
        return "tet4" if self.element == "tet4" else "tet10"
