"""A stage of the geometry done and shown: what a person wants to know of it, and a picture."""

from functools import partial
from typing import Any

import numpy as np

from ...anatomy.sites.sites import find_thinnest_tissue
from ...anatomy.surfaces.surfaces import load_anatomy
from ...errors import InputError
from ...report.drawing.stage_pictures import draw_stage
from ...study import Study
from ..engine.context import Listener, Progress, build_executor, ignore_progress
from ..engine.store import Store, lock
from .run import run_study

SHOWN = ("segment", "surfaces", "sites", "mesh")


def show_stage(study: Study, stage: str, *, listener: Listener = ignore_progress) -> dict[str, Any]:
    """Run a study until a stage of the geometry, and say what came of it.

    Returns ``study``, ``stage``, ``picture`` (path of a PNG, or None where the stage makes none), and facts
    by stage; lengths in mm, volumes in cm3, angles in degrees, positions LPS. Raises `InputError` for another
    stage, ``segment`` of a study without an image, or inputs that cannot be used.

    ``stage``: one of ``segment``, ``surfaces``, ``sites``, ``mesh``.
    """
    if stage not in SHOWN:
        raise InputError(f"no stage {stage!r} can be shown", remedy="stages are " + ", ".join(SHOWN))
    if stage == "segment" and study.image is None:
        what = "the study has surfaces and no image, so there is nothing to segment"
        raise InputError(what, file=study.file, remedy="see its surfaces with: limbfit surfaces")
    run_study(study, until=stage, listener=listener)
    store = Store(study.results)
    if stage == "segment":
        picture = store["segment"] / "quality.png"
        facts = {**store.results.segment.to_plain(), "labels": str(store["segment"] / "labels.seg.nrrd")}
    else:
        picture = store[stage] / f"{stage}.png"
        listener(Progress(stage, 0, 1, "drawing"))
        # On the executor: graphics libraries can crash, and a worker that dies is an error in words.
        with lock(study.results), build_executor(study) as executor:
            list(executor.map(partial(draw_stage, study.results, stage), [picture]))
        listener(Progress(stage, 1, 1, "drawn"))
        if stage == "surfaces":
            facts = _describe_surfaces(study, store)
        else:
            facts = getattr(store.results, stage).to_plain()
    shown = str(picture) if picture.is_file() else None
    return {"study": study.study.name, "stage": stage, "picture": shown, **facts}


def _describe_surfaces(study: Study, store: Store) -> dict[str, Any]:
    anatomy = load_anatomy(store["surfaces"])
    plane = study.geometry.amputation
    bodies, amputation = {"skin": anatomy.skin, **anatomy.bones, **anatomy.regions}, None
    if plane is not None:
        normal = np.asarray(plane.normal) / np.linalg.norm(plane.normal)
        # How far skin and bones reach beyond the plane.
        ends = {
            name: round(float(-((body.points - np.asarray(plane.point)) @ normal).min()), 2)
            for name, body in {"skin": anatomy.skin, **anatomy.bones}.items()
        }
        amputation = {"pad_mm": study.geometry.amputation_pad_mm, "beyond_plane_mm": ends}
    return {
        "volumes_cm3": {name: round(body.volume / 1000, 2) for name, body in bodies.items()},
        "triangles": {name: len(body.faces) for name, body in bodies.items()},
        "closed_bodies": len(bodies),
        # Where each bone comes nearest to the skin.
        "thinnest_mm": {
            name: {"tissue_mm": round(thickness, 2), "at": np.round(place, 1).tolist()}
            for name in anatomy.bones
            for thickness, place in [find_thinnest_tissue(anatomy, name)]
        },
        "cut_point": anatomy.cut_point.tolist(),
        "cut_normal": anatomy.cut_normal.tolist(),
        "amputation": amputation,
    }
