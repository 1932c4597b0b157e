"""A stage of the geometry done and shown: what a person wants to know of it, and a picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.sites.sites import find_thinnest_tissue
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...errors import InputError
from ...report.drawing.stage_pictures import draw_stage
from ...study import Study
from ..engine.context import Listener, Progress, build_executor, ignore_progress
from ..engine.store import Store, lock
from .run import run_study

SHOWN = ("segment", "surfaces", "sites", "mesh")


def show_stage(study: Study, stage: str, *, listener: Listener = ignore_progress) -> dict[str, Any]:
    """Run a study until a stage of the geometry, and say what came of it.

    Parameters
    ----------
    study : a checked study.
    stage : one of ``segment``, ``surfaces``, ``sites``, ``mesh``.
    listener : is told of progress.

    Returns
    -------
    dict
        ``study``, ``stage``, ``picture`` (path of a PNG, or None where the stage makes none), and facts by
        stage; lengths in mm, volumes in cm3, angles in degrees, positions LPS.

    Raises
    ------
    InputError
        For another stage, ``segment`` of a study without an image, or inputs that cannot be used.
    """
    if stage not in SHOWN:
        raise InputError(f"no stage {stage!r} can be shown", remedy="stages are " + ", ".join(SHOWN))
    if stage == "segment" and study.image is None:
        raise InputError(
            "the study has surfaces and no image, so there is nothing to segment",
            file=study.file,
            remedy="see its surfaces with: limbfit surfaces",
        )
    run_study(study, until=stage, listener=listener)
    store = Store(study.results)
    facts = _FACTS[stage](study, store)
    picture = store["segment"] / "quality.png"
    if stage != "segment":
        picture = store[stage] / f"{stage}.png"
        _draw(study, stage, picture, listener)
    shown = str(picture) if picture.is_file() else None
    return {"study": study.study.name, "stage": stage, "picture": shown, **facts}


def _draw(study: Study, stage: str, file: Path, listener: Listener) -> None:
    """On the executor: graphics libraries can crash, and a worker that dies is an error in words."""
    listener(Progress(stage, 0, 1, "drawing"))
    with lock(study.results), build_executor(study) as executor:
        list(executor.map(_draw_one, [(study.results, stage, file)]))
    listener(Progress(stage, 1, 1, "drawn"))


def _draw_one(job: tuple[Path, str, Path]) -> None:
    draw_stage(*job)


def _segment_facts(study: Study, store: Store) -> dict[str, Any]:
    return {**store.results.segment.to_plain(), "labels": str(store["segment"] / "labels.seg.nrrd")}


def _describe_surfaces(study: Study, store: Store) -> dict[str, Any]:
    anatomy = load_anatomy(store["surfaces"])
    plane = study.geometry.amputation
    bodies = {"skin": anatomy.skin, **anatomy.bones, **anatomy.regions}
    return {
        "volumes_cm3": {name: round(body.volume / 1000, 2) for name, body in bodies.items()},
        "triangles": {name: len(body.faces) for name, body in bodies.items()},
        "closed_bodies": len(bodies),
        "thinnest_mm": {name: _describe_thinnest(anatomy, name) for name in anatomy.bones},
        "cut_point": anatomy.cut_point.tolist(),
        "cut_normal": anatomy.cut_normal.tolist(),
        "amputation": None if plane is None else _describe_amputation(study, anatomy),
    }


def _describe_thinnest(anatomy: Anatomy, name: str) -> dict[str, Any]:
    """Where a bone comes nearest to the skin: thickness of the tissue and the place on the bone."""
    thickness, place = find_thinnest_tissue(anatomy, name)
    return {"tissue_mm": round(thickness, 2), "at": np.round(place, 1).tolist()}


def _describe_amputation(study: Study, anatomy: Anatomy) -> dict[str, Any]:
    """How far skin and bones reach beyond the plane of the virtual amputation."""
    plane = study.geometry.amputation
    assert plane is not None
    normal = np.asarray(plane.normal) / np.linalg.norm(plane.normal)
    ends = {
        name: round(float(-((body.points - np.asarray(plane.point)) @ normal).min()), 2)
        for name, body in {"skin": anatomy.skin, **anatomy.bones}.items()
    }
    return {"pad_mm": study.geometry.amputation_pad_mm, "beyond_plane_mm": ends}


def _describe_sites(study: Study, store: Store) -> dict[str, Any]:
    return store.results.sites.to_plain()


def _mesh_facts(study: Study, store: Store) -> dict[str, Any]:
    return store.results.mesh.to_plain()


_FACTS: dict[str, Callable[[Study, Store], dict[str, Any]]] = {
    "segment": _segment_facts,
    "surfaces": _describe_surfaces,
    "sites": _describe_sites,
    "mesh": _mesh_facts,
}
