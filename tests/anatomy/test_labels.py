"""Label maps: the .seg.nrrd of 3D Slicer, layered, cropped or in RAS, and plain label images."""

import json
from dataclasses import replace

import nrrd
import numpy as np
import pytest
import slicerio

from limbfit.anatomy.grid import SOFT_TISSUE
from limbfit.anatomy.imaging import LabelMap, read_labels, write_labels, write_volume
from limbfit.errors import LabelError
from limbs import DIRECTIONS, volume

NAMES = {1: SOFT_TISSUE, 2: "tibia", 3: "fibula", 9: "bone-1"}


def labels_on(image, names=NAMES) -> LabelMap:
    """A tibia and another bone inside soft tissue."""
    array = np.zeros(image.array.shape, np.uint8)
    array[1:6, 1:5, 1:4] = 1
    array[2:4, 2:4, 1:3] = 2
    array[4, 2, 2] = 9
    return LabelMap(array, *image.geometry, names)


@pytest.mark.parametrize("suffix", [".seg.nrrd", ".nrrd", ".nii.gz", ".mha"])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
def test_round_trip_keeps_geometry_values_and_names(tmp_path, suffix, direction):
    image = volume(direction)
    labels = labels_on(image)
    write_labels(tmp_path / f"labels{suffix}", labels)
    back = read_labels(tmp_path / f"labels{suffix}", image)
    assert back.has_same_grid(labels)
    assert back.bone_names == ("tibia", "bone-1")
    for name in (SOFT_TISSUE, "tibia", "bone-1"):
        assert np.array_equal(back.mask(name), labels.mask(name))


def test_slicers_own_reader_finds_names_colours_and_place(tmp_path):
    labels = labels_on(volume(DIRECTIONS["oblique"]))
    write_labels(tmp_path / "labels.seg.nrrd", labels)
    seen = slicerio.read_segmentation(str(tmp_path / "labels.seg.nrrd"))
    assert np.allclose(seen["ijkToLPS"], labels.affine)
    assert [s["name"] for s in seen["segments"]] == list(NAMES.values())
    assert len({tuple(s["color"]) for s in seen["segments"]}) == len(NAMES)
    voxels = slicerio.segment_mask(seen, slicerio.segment_from_name(seen, "tibia"))
    assert np.array_equal(np.transpose(voxels, (2, 1, 0)).astype(bool), labels.mask("tibia"))


def slicer_header(affine, segments, **more):
    header = {
        "space": "left-posterior-superior",
        "kinds": ["domain"] * 3,
        "space directions": affine[:3, :3].T,
        "space origin": affine[:3, 3],
    }
    for n, (name, layer, value) in enumerate(segments):
        header |= {f"Segment{n}_ID": f"Segment_{n}", f"Segment{n}_Name": name}
        header |= {f"Segment{n}_Layer": str(layer), f"Segment{n}_LabelValue": str(value)}
    return header | more


def test_cropped_segmentation_returns_to_the_images_grid(tmp_path):
    image = volume(DIRECTIONS["oblique"])
    labels = labels_on(image)
    crop = (slice(1, 6), slice(1, 5), slice(1, 4))
    affine = image.affine.copy()
    affine[:3, 3] = image.index_to_point([1, 1, 1])
    segments = [("Soft_Tissue", 0, 1), ("Tibia", 0, 2), ("bone-1", 0, 9)]
    voxels = np.transpose(labels.array[crop], (2, 1, 0))
    nrrd.write(str(tmp_path / "cropped.seg.nrrd"), voxels, slicer_header(affine, segments))
    back = read_labels(tmp_path / "cropped.seg.nrrd", image)
    assert back.array.shape == image.array.shape
    assert np.array_equal(back.mask("tibia"), labels.mask("tibia"))
    assert np.array_equal(back.mask(SOFT_TISSUE), labels.mask(SOFT_TISSUE))
    assert np.array_equal(back.mask("bone-1"), labels.mask("bone-1"))


def test_overlapping_layers_leave_the_bone_on_top(tmp_path):
    image = volume(DIRECTIONS["oblique"])
    labels = labels_on(image)
    layers = np.zeros((2, *image.size), np.uint8)
    layers[0][np.transpose(labels.array > 0, (2, 1, 0))] = 1
    layers[1][np.transpose(labels.mask("tibia"), (2, 1, 0))] = 1
    header = slicer_header(image.affine, [("tibia", 1, 1), ("limb", 0, 1)])
    header["kinds"] = ["list", *header["kinds"]]
    header["space directions"] = np.vstack([np.full(3, np.nan), header["space directions"]])
    nrrd.write(str(tmp_path / "layers.seg.nrrd"), layers, header)
    back = read_labels(tmp_path / "layers.seg.nrrd", image)
    assert np.array_equal(back.mask("tibia"), labels.mask("tibia"))
    assert np.array_equal(back.limb, labels.limb)
    assert back.bone_names == ("tibia",)


def test_ras_is_turned_to_lps(tmp_path):
    image = volume(DIRECTIONS["flipped rows"])
    labels = labels_on(image)
    ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine
    header = slicer_header(ras, [("tibia", 0, 2)], space="right-anterior-superior")
    nrrd.write(str(tmp_path / "ras.seg.nrrd"), np.transpose(labels.array, (2, 1, 0)), header)
    assert np.array_equal(read_labels(tmp_path / "ras.seg.nrrd", image).limb, labels.mask("tibia"))


def moved(labels: LabelMap, how: str) -> LabelMap:
    if how == "shifted by half a voxel":
        return replace(labels, origin=labels.index_to_point([0.5, 0, 0]))
    if how == "of another spacing":
        return replace(labels, spacing=labels.spacing * 1.05)
    if how == "turned":
        return replace(labels, direction=DIRECTIONS["oblique"])
    return replace(labels, array=np.pad(labels.array, 2))


@pytest.mark.parametrize("how", ["shifted by half a voxel", "of another spacing", "turned", "larger"])
@pytest.mark.parametrize("suffix", [".seg.nrrd", ".nii.gz"])
def test_another_grid_is_refused(tmp_path, how, suffix):
    image = volume(np.eye(3))
    write_labels(tmp_path / f"other{suffix}", moved(labels_on(image), how))
    with pytest.raises(LabelError, match="different grid") as caught:
        read_labels(tmp_path / f"other{suffix}", image)
    assert "export" in str(caught.value)


def test_plain_image_without_names_takes_the_default_ones(tmp_path):
    image = volume(np.eye(3))
    array = np.zeros(image.array.shape, np.float32)
    array[3, 3, 2], array[3, 3, 3] = 1, 4
    write_volume(tmp_path / "plain.nii.gz", image.with_array(array))
    assert read_labels(tmp_path / "plain.nii.gz", image).bone_names == ("femur",)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("labels.seg.nrrd", "no nrrd", "cannot be read"),
        ("labels.nii.gz", "no nifti", "cut short"),
        ("none.nrrd", None, "no such image"),
    ],
)
def test_unreadable_maps_are_refused(tmp_path, name, text, expected):
    if text:
        (tmp_path / name).write_text(text)
    with pytest.raises(LabelError, match=expected):
        read_labels(tmp_path / name)


def test_empty_fractional_and_nameless_maps_are_refused(tmp_path):
    image = volume(np.eye(3))
    write_volume(tmp_path / "empty.nrrd", image.with_array(image.array * 0))
    with pytest.raises(LabelError, match="empty"):
        read_labels(tmp_path / "empty.nrrd")
    write_volume(tmp_path / "grey.nrrd", image)
    with pytest.raises(LabelError, match="whole numbers"):
        read_labels(tmp_path / "grey.nrrd")
    bare = slicer_header(image.affine, [])
    nrrd.write(str(tmp_path / "bare.seg.nrrd"), np.ones(image.size, np.uint8), bare)
    with pytest.raises(LabelError, match="names no segment"):
        read_labels(tmp_path / "bare.seg.nrrd")


def test_unreadable_sidecar_is_named(tmp_path):
    image = volume(np.eye(3))
    write_labels(tmp_path / "labels.nrrd", labels_on(image))
    (tmp_path / "labels.nrrd.json").write_text("[1, 2]")
    with pytest.raises(LabelError, match=r"labels\.nrrd\.json"):
        read_labels(tmp_path / "labels.nrrd")


def test_a_named_background_is_no_bone(tmp_path):
    image = volume(np.eye(3))
    labels = labels_on(image)
    named = {0: "background", **labels.names}
    write_volume(tmp_path / "labels.nrrd", image.with_array(labels.array))
    (tmp_path / "labels.nrrd.json").write_text(json.dumps(named))
    assert read_labels(tmp_path / "labels.nrrd", image).bone_names == labels.bone_names
    write_labels(tmp_path / "labels.seg.nrrd", replace(labels, names=named))
    assert read_labels(tmp_path / "labels.seg.nrrd", image).bone_names == labels.bone_names


def test_two_values_of_one_name_are_refused_with_the_file(tmp_path):
    image = volume(np.eye(3))
    write_volume(tmp_path / "labels.nrrd", image.with_array(labels_on(image).array))
    (tmp_path / "labels.nrrd.json").write_text('{"1": "soft tissue", "2": "Tibia", "7": "tibia"}')
    with pytest.raises(LabelError, match=r"labels\.nrrd: two labels have the same name"):
        read_labels(tmp_path / "labels.nrrd")


def test_a_label_is_one_region():
    with pytest.raises(LabelError, match="two regions have one label"):
        labels_on(volume(np.eye(3))).with_regions({"scar": "tibia", "tendon": "tibia"})
