"""The model: surfaces, sites and volumes; and the mesh of each site."""

from __future__ import annotations

from ...results.base import Vector
from ...results.limb import MeshMeasures, PlacedSite
from ..drawing import pictures
from ..drawing.interactive import make_explorer
from ..formats import count, format_duration, format_fixed
from ..page import Prose, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import make_table, to_numeric


def make_model_section(store: Results) -> Section:
    """Surfaces, sites and volumes."""
    segment, surfaces = store.segment, store.surfaces
    section = make_section(
        "model",
        "The model",
        make_explorer(store),
        pictures.draw_slices_figure(store),
        pictures.draw_surface_figure(store),
        pictures.draw_marker_figure(store),
        make_volume_table(store),
        make_place_table(store) if store.sites else None,
        make_bullets((*(segment.warnings if segment else ()), *(surfaces.notes if surfaces else ()))),
        otherwise="No surfaces and sites are stored yet.",
    )
    method = Prose(f"Segmentation: {segment.method}.") if segment else None
    return make_section(section.name, section.title, method, section.blocks)


def make_volume_table(store: Results) -> Table | None:
    """Volumes from the label map and inside the surfaces."""
    labels, found = store.segment.volumes_cm3 if store.segment else {}, store.surfaces
    bodies = {"skin": found.skin, **found.bones, **found.regions} if found else {}
    closed = {name: body.volume_mm3 / 1000 for name, body in bodies.items()}
    names = list(dict.fromkeys([*labels, *closed]))
    rows = [{"name": name, "labels": labels.get(name), "closed": closed.get(name)} for name in names]
    columns = (
        ("Structure", "name"),
        ("Label map (cm³)", "labels", 1),
        ("Inside the surface (cm³)", "closed", 1),
    )
    caption = "Volumes of the segmented structures and of the smooth surfaces."
    return make_table("volumes", caption, columns, rows) if rows else None


def make_place_table(store: Results) -> Table:
    """Where each site lies, and on what evidence."""
    columns = (
        ("Site", "site"),
        ("Region", "region"),
        ("Position, LPS (mm)", lambda row: to_numeric(_format_vector(row.position_mm, 1))),
        ("Axis into the limb", lambda row: to_numeric(_format_vector(row.axis, 3))),
        ("Off the skin (mm)", "off_skin_mm", 2),
        ("Marker", _describe_evidence),
    )
    caption = "Indentation sites in patient coordinates (LPS)."
    return make_table("places", caption, columns, store.sites, marked="fitted")


def _format_vector(values: Vector, decimals: int) -> str:
    return ", ".join(format_fixed(value, decimals) for value in values)


def _describe_evidence(row: PlacedSite) -> str:
    if row.marker is None:
        return "position given in the study"
    height, distance = format_fixed(row.marker.height_mm), format_fixed(row.marker.distance_to_hint_mm)
    return f"{height} mm high, {distance} mm from the hint"


def make_mesh_section(store: Results) -> Section:
    """Cut meshes and their quality."""
    warnings = (
        f"Site {site}: {text}"
        for site, facts in store.mesh.items()
        for text in (*facts.repairs, *facts.warnings)
    )
    return make_section(
        "meshes",
        "Meshes",
        pictures.draw_mesh_figure(store, store.fitted[:4]),
        make_mesh_table(store) if store.mesh else None,
        make_bullets(warnings),
        otherwise="No meshes are stored yet.",
    )


def make_mesh_table(store: Results) -> Table:
    """Size and quality of every site's mesh, and what the bone policy trimmed."""
    columns = (
        ("Site", lambda row: row[0]),
        ("Element", lambda row: row[1].element),
        ("Nodes", lambda row: to_numeric(count(row[1].nodes))),
        ("Elements", lambda row: to_numeric(count(row[1].cells))),
        ("Smallest dihedral (°)", lambda row: to_numeric(format_fixed(row[1].min_dihedral_deg))),
        ("Layers (mm)", lambda row: to_numeric(_describe_layers(row[1]))),
        ("Bone trimmed (mm³)", lambda row: _sum_trimmed_bone(row[1])),
        ("Time", lambda row: to_numeric(format_duration(row[1].seconds))),
    )
    caption = "Meshes. Layers are the mean ± standard deviation of their thickness, outermost first."
    return make_table(
        "meshes", caption, columns, store.mesh.items(), marked=lambda row: row[0] in store.fitted
    )


def _sum_trimmed_bone(facts: MeshMeasures) -> object:
    return to_numeric(format_fixed(sum(bone.volume_mm3 for bone in facts.trimmed_bone.values()), 0))


def _describe_layers(facts: MeshMeasures) -> str:
    """Thickness of the layer, or of each by its name."""
    each = facts.layer_thickness_mm
    if len(each) < 2:
        return f"{format_fixed(facts.layer_mean_mm, 2)} ± {format_fixed(facts.layer_std_mm, 2)}"
    return ", ".join(
        f"{name} {format_fixed(values.mean, 2)} ± {format_fixed(values.std, 2)}"
        for name, values in each.items()
    )
