"""The model: surfaces, sites and volumes; and the mesh of each site."""

from ..drawing import pictures
from ..drawing.interactive import make_explorer
from ..page import Prose, Section, Table, make_bullets
from ..store import Results
from ..words import make_section, make_table


def make_model_section(store: Results) -> Section:
    """Surfaces, sites and volumes."""
    segment, surfaces = store.segment, store.surfaces
    return make_section(
        "model",
        Prose(f"Segmentation: {segment.method}.") if segment else None,
        make_explorer(store),
        pictures.draw_slices_figure(store),
        pictures.draw_surface_figure(store),
        pictures.draw_marker_figure(store),
        make_volume_table(store),
        make_table("places", store.sites, marked="fitted"),
        make_bullets((*(segment.warnings if segment else ()), *(surfaces.notes if surfaces else ()))),
    )


def make_volume_table(store: Results) -> Table | None:
    """Volumes from the label map and inside the surfaces."""
    labels, found = store.segment.volumes_cm3 if store.segment else {}, store.surfaces
    bodies = {"skin": found.skin, **found.bones, **found.regions} if found else {}
    closed = {name: body.volume_mm3 / 1000 for name, body in bodies.items()}
    names = list(dict.fromkeys([*labels, *closed]))
    rows = [{"name": name, "labels": labels.get(name), "closed": closed.get(name)} for name in names]
    return make_table("volumes", rows)


def make_mesh_section(store: Results) -> Section:
    """Cut meshes and their quality."""
    warnings = (
        f"Site {site}: {text}"
        for site, facts in store.mesh.items()
        for text in (*facts.repairs, *facts.warnings)
    )
    return make_section(
        "meshes",
        pictures.draw_mesh_figure(store, store.fitted[:4]),
        make_table("meshes", store.mesh.items(), marked=lambda row: row[0] in store.fitted),
        make_bullets(warnings),
    )
