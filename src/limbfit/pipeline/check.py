"""Read every input of a study and say what is wrong with it, before anything runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..anatomy.imaging import Volume
from ..indentation import read_indenter
from ..study import Study
from .context import Listener, Progress
from .geometry_stages import given_anatomy, place_site
from .inputs import marked_image, study_image, study_labels
from .traces_stage import read_site_trace


def check_study(study: Study, *, listener: Listener) -> dict[str, Any]:
    """Facts about a study's inputs; raises at the first that cannot be used.

    Returns
    -------
    dict
        ``study``, ``facts`` (sentences), ``sites`` (peak force, depth, touch-down per recorded site).

    Raises
    ------
    InputError
        For an image, label map, surface, site or record that cannot be used.
    """
    facts = list(study.notes)
    listener(Progress("check", 0, 2, "geometry"))
    facts += _image_facts(study) if study.image is not None else _surface_facts(study)
    if study.indenter.file is not None:
        table = study.indenter.model_copy(update={"file": study.path(study.indenter.file)})
        width = read_indenter(table, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), None).width
        facts.append(f"indenter: {study.indenter.file}, {width:.1f} mm wide")
    listener(Progress("check", 1, 2, "records"))
    sites = {site.name: read_site_trace(study, site)[2] for site in study.sites if site.trace is not None}
    for name, record in sites.items():
        facts.append(
            f"site {name}: peak force {record['peak_force_N']:.2f} N at {record['depth_mm']:.2f} mm, "
            f"touch-down after {record['touch_down_mm']:.2f} +- {record['touch_down_uncertainty_mm']:.2f} mm"
        )
    facts.append(f"{len(study.fitted)} of {len(study.sites)} sites are fitted")
    listener(Progress("check", 2, 2))
    return {"study": study.study.name, "facts": facts, "sites": sites}


def _image_facts(study: Study) -> list[str]:
    volume = study_image(study)
    facts = [_sampling("image", volume)]
    marked = marked_image(study)
    if marked is not None:
        facts.append(_sampling("image with markers", marked))
    given = study_labels(study, volume)
    if given is not None:
        labels, notes = given
        facts.append("corrected labels: " + ", ".join(labels.names.values()))
        facts += [f"label map: {note}" for note in notes]
    return facts


def _sampling(name: str, volume: Volume) -> str:
    size = " x ".join(str(n) for n in volume.size)
    spacing = " x ".join(f"{s:.3g}" for s in volume.spacing)
    return f"{name}: {size} voxels of {spacing} mm"


def _surface_facts(study: Study) -> list[str]:
    anatomy = given_anatomy(study)
    facts = [
        f"{name}: {surface.volume / 1000:.1f} cm3, {len(surface.faces)} triangles"
        for name, surface in {"skin": anatomy.skin, **anatomy.bones}.items()
    ]
    for site in study.sites:
        place_site(site, study, anatomy, None)
    largest = np.ptp(anatomy.skin.points, axis=0)
    return [*facts, "extent of the skin: " + " x ".join(f"{x:.0f}" for x in largest) + " mm"]
