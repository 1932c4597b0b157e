"""The model: surfaces, sites and volumes; and the mesh of each site."""

from __future__ import annotations

from ..drawing import pictures
from ..drawing.interactive import make_explorer
from ..formats import NOTHING, count, format_duration, format_fixed
from ..page import Prose, Section, Table, make_bullets, make_section
from ..store import Json, Results
from ..tables import make_table, to_numeric


def make_model_section(store: Results) -> Section:
    """Surfaces, sites and volumes."""
    source = store.segment.get("method")
    section = make_section(
        "model",
        "The model",
        make_explorer(store),
        pictures.draw_slices_figure(store),
        pictures.draw_surface_figure(store),
        pictures.draw_marker_figure(store),
        make_volume_table(store),
        make_place_table(store) if store.sites else None,
        make_bullets((*(store.segment.get("warnings") or ()), *(store.surfaces.get("notes") or ()))),
        otherwise="No surfaces and sites are stored yet.",
    )
    method = Prose(f"Segmentation: {source}.") if source else None
    return make_section(section.name, section.title, method, section.blocks)


def make_volume_table(store: Results) -> Table | None:
    """Volumes from the label map and inside the surfaces."""
    labels = store.segment.get("volumes_cm3") or {}
    bones, regions = (store.surfaces.get(kind) or {} for kind in ("bones", "regions"))
    bodies = {"skin": store.surfaces.get("skin"), **bones, **regions}
    closed = {name: body["volume_mm3"] / 1000 for name, body in bodies.items() if body}
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
        ("Position, LPS (mm)", lambda row: to_numeric(_format_vector(row.get("position_mm"), 1))),
        ("Axis into the limb", lambda row: to_numeric(_format_vector(row.get("axis"), 3))),
        ("Off the skin (mm)", "off_skin_mm", 2),
        ("Marker", _describe_evidence),
    )
    caption = "Indentation sites in patient coordinates (LPS)."
    return make_table("places", caption, columns, store.sites, marked="fitted")


def _format_vector(values: list[float] | None, decimals: int) -> str:
    return ", ".join(format_fixed(value, decimals) for value in values or ()) or NOTHING


def _describe_evidence(row: Json) -> str:
    marker = row.get("marker")
    if not marker:
        return "position given in the study"
    height, distance = format_fixed(marker.get("height_mm")), format_fixed(marker.get("distance_to_hint_mm"))
    return f"{height} mm high, {distance} mm from the hint"


def make_mesh_section(store: Results) -> Section:
    """Cut meshes and their quality."""
    warnings = (
        f"Site {site}: {text}"
        for site, facts in store.mesh.items()
        for text in (*(facts.get("repairs") or ()), *(facts.get("warnings") or ()))
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
        ("Site", "site"),
        ("Element", "element"),
        ("Nodes", lambda facts: to_numeric(count(facts.get("nodes")))),
        ("Elements", lambda facts: to_numeric(count(facts.get("cells")))),
        ("Smallest dihedral (°)", "min_dihedral_deg", 1),
        ("Layers (mm)", lambda facts: to_numeric(_describe_layers(facts))),
        ("Bone trimmed (mm³)", _sum_trimmed_bone),
        ("Time", lambda facts: to_numeric(format_duration(facts.get("seconds")))),
    )
    caption = "Meshes. Layers are the mean ± standard deviation of their thickness, outermost first."
    rows = [{**facts, "site": site} for site, facts in store.mesh.items()]
    return make_table("meshes", caption, columns, rows, marked=lambda row: row["site"] in store.fitted)


def _sum_trimmed_bone(facts: Json) -> object:
    trimmed = (facts.get("trimmed_bone") or {}).values()
    return to_numeric(format_fixed(sum((bone.get("volume_mm3", 0.0) for bone in trimmed), 0.0), 0))


def _describe_layers(facts: Json) -> str:
    """Thickness of the layer, or of each by its name."""
    each = facts.get("layer_thickness_mm") or {}
    if len(each) < 2:
        return f"{format_fixed(facts.get('layer_mean_mm'), 2)} ± {format_fixed(facts.get('layer_std_mm'), 2)}"
    return ", ".join(
        f"{name} {format_fixed(values.get('mean'), 2)} ± {format_fixed(values.get('std'), 2)}"
        for name, values in each.items()
    )
