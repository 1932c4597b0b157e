"""DICOM-SEG and RTSTRUCT as label maps on the grid of their image."""

from dataclasses import replace

import numpy as np
import pydicom
import pytest
from damaging import write_rtstruct, write_seg
from test_labels import labels_on

from limbfit.anatomy.grid import SOFT_TISSUE
from limbfit.anatomy.imaging import read_labels
from limbfit.anatomy.labels.labelfiles import fill_even_odd
from limbfit.errors import LabelError
from limbs import DIRECTIONS, volume, write_dicom

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
@pytest.mark.parametrize("write", [lambda f, m: write_seg(f, m, RANDOM), write_rtstruct], ids=["SEG", "RT"])
def test_labels_land_on_the_voxels_they_were_drawn_on(tmp_path, direction, write):
    labels = labels_on(volume(direction))
    write(tmp_path / "labels.dcm", labels)
    back = read_labels(tmp_path / "labels.dcm", volume(direction))
    assert back.has_same_grid(labels)
    for name in (SOFT_TISSUE, "tibia", "bone-1"):
        assert np.array_equal(back.mask(name), labels.mask(name)), name


def test_a_folder_with_one_of_them_is_taken(tmp_path):
    image = volume(DIRECTIONS["oblique"])
    write_dicom(tmp_path, image)
    write_seg(tmp_path / "seg.dcm", labels_on(image), RANDOM)
    assert read_labels(tmp_path, image).bone_names == ("tibia", "bone-1")
    write_rtstruct(tmp_path / "rt.dcm", labels_on(image))
    with pytest.raises(LabelError, match="2 DICOM segmentations"):
        read_labels(tmp_path, image)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_segments_as_highdicom_writes_them(tmp_path, kind):
    """Another implementation: only filled slices, references to the source images, a frame of reference; a
    label map describes its background as a segment."""
    highdicom = pytest.importorskip("highdicom")
    from highdicom.seg import Segmentation, SegmentDescription
    from pydicom.sr.codedict import codes

    image = volume(DIRECTIONS["oblique"])
    write_dicom(
        tmp_path / "mri", image, PatientSex="", AccessionNumber="", StudyID="1", PatientPosition="FFS"
    )
    sources = [pydicom.dcmread(file) for file in (tmp_path / "mri").iterdir()]
    for n, source in enumerate(sources):
        source.StudyTime, source.InstanceNumber, source.ReferringPhysicianName = "120000", n + 1, ""
        source.PositionReferenceIndicator = ""
    normal = image.direction[:, 2]
    sources.sort(key=lambda source: float(np.array(source.ImagePositionPatient, float) @ normal))
    labels = labels_on(image)
    names = {1: "Soft_Tissue", 2: "Tibia"}
    masks = np.stack([labels.limb, labels.mask("tibia")], axis=-1).astype(np.uint8)
    tissue = codes.SCT.Tissue
    segmentation = Segmentation(
        source_images=sources,
        pixel_array=masks if kind == "BINARY" else masks.sum(axis=-1, dtype=np.uint8),
        segmentation_type=kind,
        segment_descriptions=[
            SegmentDescription(number, name, tissue, tissue, algorithm_type="MANUAL")
            for number, name in names.items()
        ],
        series_instance_uid=highdicom.UID(),
        series_number=9,
        sop_instance_uid=highdicom.UID(),
        instance_number=1,
        manufacturer="maker",
        manufacturer_model_name="model",
        software_versions="1",
        device_serial_number="1",
    )
    segmentation.save_as(tmp_path / "labels.dcm")
    back = read_labels(tmp_path / "labels.dcm", image)
    assert back.has_same_grid(image)
    assert np.array_equal(back.limb, labels.limb)
    assert np.array_equal(back.mask("tibia"), labels.mask("tibia"))


def test_even_odd_leaves_holes_and_fills_islands_in_them():
    def square(low: float, high: float) -> np.ndarray:
        return np.array([[low, low], [high, low], [high, high], [low, high]])

    filled = fill_even_odd([square(0.5, 9.5), square(2.5, 7.5), square(3.5, 5.5)], 12, 11)
    j, i = np.mgrid[:11, :12]

    def inside(low: float, high: float) -> np.ndarray:
        return (i > low) & (i < high) & (j > low) & (j < high)

    assert np.array_equal(filled, inside(0.5, 9.5) ^ inside(2.5, 7.5) ^ inside(3.5, 5.5))
    keyhole = np.array(
        [
            *([0.5, 0.5], [9.5, 0.5], [9.5, 9.5], [0.5, 9.5], [0.5, 0.5]),
            *([2.5, 2.5], [2.5, 7.5], [7.5, 7.5], [7.5, 2.5], [2.5, 2.5]),
        ]
    )
    assert np.array_equal(fill_even_odd([keyhole], 12, 11), inside(0.5, 9.5) ^ inside(2.5, 7.5))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"shift": 0.3}, "do not lie on the slices"),
        ({"shift": 40.0}, "outside the image"),
        ({"step": 2}, "slices without a contour"),
        ({"form": "POINT"}, "names no segment"),
    ],
)
def test_contours_of_another_image_are_refused(tmp_path, options, expected):
    image = volume(DIRECTIONS["oblique"])
    write_rtstruct(tmp_path / "labels.dcm", labels_on(image), **options)
    with pytest.raises(LabelError, match=expected):
        read_labels(tmp_path / "labels.dcm", image)


def test_structures_whose_names_become_one_are_refused(tmp_path):
    """As one structure a bone inside another, or drawn twice, would be a hole."""
    image = volume(DIRECTIONS["oblique"])
    write_rtstruct(tmp_path / "labels.dcm", labels_on(image))
    data = pydicom.dcmread(tmp_path / "labels.dcm")
    data.StructureSetROISequence[1].ROIName, data.StructureSetROISequence[2].ROIName = "Tibia", "tibia_"
    data.save_as(tmp_path / "labels.dcm")
    with pytest.raises(LabelError, match="two segments have the same name"):
        read_labels(tmp_path / "labels.dcm", image)


def test_contours_without_an_image_are_refused(tmp_path):
    write_rtstruct(tmp_path / "labels.dcm", labels_on(volume(np.eye(3))))
    with pytest.raises(LabelError, match="need the image"):
        read_labels(tmp_path / "labels.dcm")


def test_segments_on_another_grid_are_refused(tmp_path):
    image = volume(DIRECTIONS["oblique"])
    labels = labels_on(image)
    moved = replace(labels, origin=labels.index_to_point([0.5, 0, 0]))
    write_seg(tmp_path / "labels.dcm", moved, RANDOM)
    with pytest.raises(LabelError, match="different grid"):
        read_labels(tmp_path / "labels.dcm", image)
    write_seg(tmp_path / "labels.dcm", labels, RANDOM, SegmentationType="FRACTIONAL")
    with pytest.raises(LabelError, match="fractional"):
        read_labels(tmp_path / "labels.dcm", image)


def test_an_image_is_no_label_map(tmp_path):
    write_dicom(tmp_path, volume(np.eye(3)))
    with pytest.raises(LabelError, match="no segmentation and no structure set"):
        read_labels(next(tmp_path.iterdir()))
