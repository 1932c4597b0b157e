"""The limb of a study as sockets are put on it: under its liner, with its regions, meshed whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ...anatomy.meshing.layers import LayerSpec, build_liner_surface
from ...anatomy.meshing.meshing import MeshSettings, mesh_limb
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...arrays import Array
from ...indentation import Direction
from ...mesh import Mesh, read_vtu
from ...results.limb import MeshMeasures
from ...results.socket import LinerFacts
from ...socket import Socket
from ...socket.landmarks import SkinRegion
from ...study import Study
from ..engine.context import Context
from ..limb.mesh import is_meshed, keep_mesh, mesh_settings, read_mesh_facts, read_stored_depth
from ..simulation.limb_geometry import find_fibre_directions
from .shape import LINER, build_regions, mesh_edge_mm

MESH = "limb.vtu"
BELOW_BRIM_MM = 15.0  # edges are short from so far above the brim on
FAR, GROWTH, FLATNESS = 3.5, 0.5, 1.6  # edges near the proximal cut over those below, and how elements grow


@dataclass(frozen=True, eq=False)
class SocketLimb:
    """What sockets are put on.

    Attributes
    ----------
    anatomy : skin and bones; ``outer`` has what the socket touches for its skin.
    depth : of the fat below that, where it is mapped.
    regions : of the skin, by name.
    fibres : their direction in each tissue that has some.
    """

    study: Study
    anatomy: Anatomy
    outer: Anatomy
    depth: Array | None
    regions: Mapping[str, SkinRegion]
    fibres: tuple[tuple[str, Direction], ...]

    @classmethod
    def of(cls, context: Context, name: str) -> SocketLimb:
        """That of a study whose surfaces are stored; ``name`` is the experiment's, for its progress."""
        study, surfaces = context.study, context.store["surfaces"]
        anatomy, thickness = load_anatomy(surfaces), study.socket.liner.thickness_mm
        outer, depth = anatomy, read_stored_depth(surfaces, anatomy, mesh_settings(study))
        if thickness:
            context.tell(name, 0, 0, f"a liner of {thickness:g} mm around the limb")
            outer, depth = build_liner_surface(anatomy, thickness, depth)
        regions, fibres = build_regions(study, anatomy), find_fibre_directions(context)
        return cls(study, anatomy, outer, depth, regions, fibres)

    def mesh(self, folder: Path, brim: Socket, report: Callable[[str], None]) -> tuple[Mesh, MeshMeasures]:
        """The whole limb's mesh and its facts; that of an interrupted run is kept."""
        file = folder / MESH
        if not is_meshed(file):
            report("a mesh of the whole limb")
            fine = BELOW_BRIM_MM - float(self.outer.height(brim.points).max())
            settings = self._choose_mesh_settings(mesh_edge_mm(self.study, brim))
            mesh, facts = mesh_limb(self.outer, settings, max(fine, 0.0), self.depth)
            keep_mesh(mesh, facts, file)
        return read_vtu(file), read_mesh_facts(file)

    def _choose_mesh_settings(self, edge_mm: float) -> MeshSettings:
        liner_mm, settings = self.study.socket.liner.thickness_mm, mesh_settings(self.study)
        liner = (LayerSpec(LINER, liner_mm),) if liner_mm else ()
        return replace(
            settings,
            element="tet10",
            layers=(*liner, *settings.layers),
            edge_near_mm=edge_mm,
            edge_far_mm=max(FAR * edge_mm, self.study.mesh.edge_far_mm),  # no pins press there
            growth=GROWTH,
            flatness=FLATNESS,
        )

    @property
    def liner(self) -> LinerFacts:
        """What is stored of the liner."""
        table = self.study.socket.liner
        return LinerFacts(thickness_mm=table.thickness_mm, material=table.material, **table.parameters)
