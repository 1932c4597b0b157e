"""The stage ``sites``: where each indentation is on the skin, and its axis."""

from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.sites.sites import compute_indenter_axis, find_markers, match_markers, project_to_skin
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy, read_surface
from ...errors import SiteError
from ...results.limb import MarkerEvidence, PlacedSite, SitesResult
from ...study import Site, Study
from ..engine.context import Context, name_file_in_errors
from ..engine.store import MARKED_SKIN, write_result


def run_sites(context: Context, folder: Path) -> None:
    """Where each indentation is: on the skin, with the indenter's axis; markers matched to names."""
    study = context.study
    anatomy = load_anatomy(context.store["surfaces"])
    for note in study.notes:
        context.tell("sites", 0, 1, note)
    context.tell("sites", 0, 1, "placing sites")
    hints = {site.name: np.array(site.near) for site in study.sites if site.near is not None}
    markers = {}
    if hints:
        marked = read_surface(context.store["segment"] / MARKED_SKIN)
        markers = match_markers(find_markers(marked, anatomy.skin), hints)
    placed = [place_site(site, study, anatomy, markers.get(site.name)) for site in study.sites]
    write_result(folder / "sites.json", SitesResult(sites=placed))


def place_site(site: Site, study: Study, anatomy: Anatomy, marker: Any) -> PlacedSite:
    """A site on the skin with its axis; ``marker`` is what was matched to it, or None.

    Raises `SiteError` when the site is too far off the skin, or its stated axis points out of the limb.
    """
    wanted = np.array(site.position) if marker is None else marker.position
    with name_file_in_errors(study.file, f"sites.{site.name}"):
        point, off = project_to_skin(anatomy, wanted)
        edge = None if site.axis else site.edge  # which may be along the skin's normal where axis is stated
        normal = compute_indenter_axis(anatomy.open_skin, point, study.width_at(site), edge)
        axis = normal if site.axis is None else np.array(site.axis)
        if axis @ normal < 0:
            raise SiteError("the axis points out of the limb", remedy="negate it: it points into the limb")
    evidence = None
    if marker is not None:
        assert site.near is not None
        distance = float(np.linalg.norm(marker.position - np.array(site.near)))
        evidence = MarkerEvidence(
            height_mm=round(float(marker.height), 3), distance_to_hint_mm=round(distance, 3)
        )
    unit = axis / np.linalg.norm(axis)
    return PlacedSite(
        site=site.name,
        region=site.region,
        fitted=site.fitted,
        position_mm=point.tolist(),
        axis=unit.tolist(),
        off_skin_mm=round(float(off), 3),
        marker=evidence,
    )
