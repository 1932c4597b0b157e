"""The labels that ``[geometry]`` needs of a label map."""

from __future__ import annotations

from ...anatomy.imaging import LabelMap
from ...anatomy.labels.naming import normalise_name
from ...anatomy.surfaces.thickness import check_fat
from ...study import Study
from .files import find_labelled_file, name_file_in_errors


def check_labels(study: Study, labels: LabelMap) -> None:
    """Refuse a given map without a label that ``[geometry]`` needs.

    Raises
    ------
    LabelError
    """
    with name_file_in_errors(find_labelled_file(study)):
        labels.with_regions(list_labelled_regions(study))
        if has_mapped_fat(study):
            check_fat(labels)


def list_labelled_regions(study: Study) -> dict[str, str]:
    """The label of each region that has one, by the region's name."""
    return {one.name: normalise_name(one.label) for one in study.geometry.regions if one.label is not None}


def has_mapped_fat(study: Study) -> bool:
    """True if a layer is as thick as the fat in the label map."""
    return any(layer.thickness == "map" for layer in study.geometry.model_layers)
