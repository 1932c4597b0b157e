"""The stage ``surfaces``: label map, or surfaces of the study, to a checked anatomy."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...anatomy.grid import find_proximal_end
from ...anatomy.imaging import read_labels
from ...anatomy.labels.labelfiles import normalise_name
from ...anatomy.segmentation.amputation import amputate_anatomy, amputate_limb
from ...anatomy.surfaces.mending import build_closed_anatomy, orient_outward
from ...anatomy.surfaces.surfaces import Anatomy, build_anatomy, check_anatomy, read_surface, save_anatomy
from ...anatomy.surfaces.thickness import measure_fat_depth, write_thickness
from ...study import Study
from ..engine.context import Context, name_file_in_errors
from ..engine.store import THICKNESS, find_labelled_file


def run_surfaces(context: Context, folder: Path) -> None:
    """Label map or the study's own surfaces to a checked anatomy: closed skin, closed bones, proximal cut."""
    study = context.study
    context.tell("surfaces", 0, 2, "building surfaces")
    if study.surfaces is not None:
        anatomy, notes = read_given_anatomy(study)
    else:
        anatomy, notes = _build_imaged_anatomy(context, folder)
    for note in notes:
        context.tell("surfaces", 1, 2, note)
    save_anatomy(folder, anatomy, notes)


def _build_imaged_anatomy(context: Context, folder: Path) -> tuple[Anatomy, tuple[str, ...]]:
    """The anatomy of the segment stage's label map, after the virtual amputation where there is one."""
    study, geometry = context.study, context.study.geometry
    cut, plane = geometry.proximal_cut, geometry.amputation
    with name_file_in_errors(find_labelled_file(study)):
        labels = read_labels(context.store["segment"] / "labels.seg.nrrd")
        labels = labels.with_regions(list_labelled_regions(study))
    proximal = None if cut is None else np.array(cut.normal)
    if plane is not None:
        proximal = find_proximal_end(labels.limb, labels, normal=proximal).direction(labels)
        with name_file_in_errors(study.file, "geometry.amputation"):
            labels = amputate_limb(labels, plane.point, plane.normal, geometry.amputation_pad_mm, proximal)
    with name_file_in_errors(find_labelled_file(study)):
        anatomy = build_anatomy(
            labels,
            edge_mm=geometry.surface_edge_mm,
            proximal_cut=None if cut is None else (cut.point, cut.normal),
            proximal=proximal,
        )
    anatomy, files, notes = _add_given_regions(study, anatomy)
    with name_file_in_errors(find_labelled_file(study)):
        check_anatomy(anatomy, files)
    if has_mapped_fat(study):
        depth = measure_fat_depth(labels, anatomy, geometry.surface_edge_mm)
        write_thickness(folder / THICKNESS, anatomy.skin, depth)
    return anatomy, notes


def _add_given_regions(study: Study, anatomy: Anatomy) -> tuple[Anatomy, dict[str, Path], tuple[str, ...]]:
    """The anatomy with the regions that come as surfaces, in the study's order, their files by name, and
    what was mended in them."""
    files = {one.name: study.path(one.surface) for one in study.geometry.regions if one.surface is not None}
    tables = study.surfaces
    coordinates, unit = (None, "mm") if tables is None else (tables.coordinates, tables.unit)
    mended = {
        name: orient_outward(read_surface(file, coordinates, unit), name) for name, file in files.items()
    }
    found = {name: surface for name, (surface, _) in mended.items()} | dict(anatomy.regions)
    order = [one.name for one in study.geometry.regions]
    notes = tuple(note for _, told in mended.values() for note in told)
    return replace(anatomy, regions={name: found[name] for name in order}), files, notes


def read_given_anatomy(study: Study) -> tuple[Anatomy, tuple[str, ...]]:
    """The checked anatomy of given surfaces, after the virtual amputation where there is one.

    Returns
    -------
    anatomy : without a stated cut it ends just inside the skin's open end, or at the highest (z) of the skin.
    notes : what was mended to close the surfaces.
    """
    assert study.surfaces is not None
    tables, geometry = study.surfaces, study.geometry
    files = {name: study.path(path) for name, path in {"skin": tables.skin, **tables.bones}.items()}
    surfaces = {name: read_surface(path, tables.coordinates, tables.unit) for name, path in files.items()}
    skin, cut = surfaces.pop("skin"), geometry.proximal_cut
    with name_file_in_errors(study.file):
        anatomy, notes = build_closed_anatomy(
            skin, surfaces, None if cut is None else (cut.point, cut.normal), files
        )
    if geometry.regions:
        anatomy, region_files, told = _add_given_regions(study, anatomy)
        notes += told
        check_anatomy(anatomy, files | region_files)
    if geometry.amputation is None:
        return anatomy, notes
    plane, pad = geometry.amputation, geometry.amputation_pad_mm
    with name_file_in_errors(study.file, "geometry.amputation"):
        stump = amputate_anatomy(anatomy, plane.point, plane.normal, pad, geometry.surface_edge_mm)
        check_anatomy(stump)
    return stump, notes


def list_labelled_regions(study: Study) -> dict[str, str]:
    """The label of each region that has one, by the region's name."""
    return {one.name: normalise_name(one.label) for one in study.geometry.regions if one.label is not None}


def has_mapped_fat(study: Study) -> bool:
    """True if a layer is as thick as the fat in the label map."""
    return any(layer.thickness == "map" for layer in study.geometry.model_layers)
