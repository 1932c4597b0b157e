"""Nothing that identifies a patient leaves the inputs: not in what is stored, not in what is said."""

import gzip
import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pydicom
import pytest

from conftest import COARSE
from limbfit import load_study
from limbfit.pipeline.commands.run import run_record
from limbfit.pipeline.engine.store import write_result
from limbs import leg_image, rotation, write_dicom

IN_TAGS = {
    "PatientName": "QUIXOTE^ALONSO^MARKERX1",
    "PatientID": "PIDMARKERX2",
    "PatientBirthDate": "19470911",
    "PatientAddress": "MARKERX3 street",
    "InstitutionName": "MARKERX4 hospital",
    "InstitutionAddress": "MARKERX5",
    "ReferringPhysicianName": "MARKERX6^DR",
    "OperatorsName": "MARKERX7",
    "StationName": "MARKERX8",
    "DeviceSerialNumber": "MARKERX9",
    "AccessionNumber": "MARKERXA",
    "SeriesDescription": "MARKERXB",
    "StudyDescription": "MARKERXC",
    "ProtocolName": "MARKERXD",
    "PatientComments": "MARKERXE",
    "ImageComments": "MARKERXF",
    "StudyDate": "20310203",
    "SeriesDate": "20310204",
    "AcquisitionDate": "20310205",
    "StudyInstanceUID": "1.2.840.7777001",
    "FrameOfReferenceUID": "1.2.840.7777002",
}
SERIES_UID = "1.2.840.7777003"
PRIVATE = ("MARKERXG", "MARKERXH")
IN_PATHS = ("MARKERXP", "MARKERXQ", "MARKERXR", "MARKERXS")
TAG_SECRETS = [
    *(part for value in IN_TAGS.values() for part in value.replace("^", " ").split() if len(part) > 6),
    *PRIVATE,
]
STUDY = """
[study]
name = "leg"
[image]
path = "mri-MARKERXQ"
series = "{uid}"
[segmentation]
bias_correction = false
[geometry]
surface_edge_mm = 8.0
[[sites]]
name = "1"
depth_mm = 5.0
position = {place}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A study whose image carries an identity in tags, private tags, and names of files and folders."""
    folder = tmp_path_factory.mktemp("data") / "study-MARKERXP"
    image, labels = leg_image([3.3, 3.3, 4.1], (38, 39, 38), rotation(1))
    write_dicom(folder / "mri-MARKERXQ", image, prefix="MARKERXR", uid=SERIES_UID, **IN_TAGS)
    for file in (folder / "mri-MARKERXQ").iterdir():
        plant(file)
    middle = np.array(labels.size) // 2
    first = np.flatnonzero(labels.limb[middle[2], middle[1]])[0]
    skin = labels.index_to_point([first - 0.5, middle[1], middle[2]])
    text = STUDY.format(uid=SERIES_UID, place=[round(float(x), 2) for x in skin])
    (folder / "study.toml").write_text(text)
    return folder


def plant(file: Path) -> None:
    data = pydicom.dcmread(file)
    data.file_meta.SourceApplicationEntityTitle = PRIVATE[0]
    block = data.private_block(0x0011, "maker MARKERXG", create=True)
    block.add_new(0x01, "LO", PRIVATE[1])
    block.add_new(0x02, "PN", "QUIXOTE^ALONSO^MARKERX1")
    data.save_as(file)


def contents(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Every file below a folder as it is, and unpacked where something in it is packed."""
    for file in folder.rglob("*"):
        yield str(file.relative_to(folder)), b""
        if not file.is_file():
            continue
        raw = file.read_bytes()
        yield str(file.relative_to(folder)), raw
        if file.suffix == ".nrrd":
            _, _, packed = raw.partition(b"\n\n")
            yield f"{file.name} (voxels)", gzip.decompress(packed)
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as archive:
                for name in archive.namelist():
                    yield f"{file.name}/{name}", archive.read(name)


def leaks(text: bytes, secrets: list[str]) -> list[str]:
    low = text.lower()
    return [
        secret
        for secret in secrets
        if secret.lower().encode() in low or secret.lower().encode("utf-16-le") in low
    ]


def assert_private(folder: Path) -> None:
    secrets = [*TAG_SECRETS, *IN_PATHS, SERIES_UID, "7777001", "7777002"]
    found = {name: leaks(name.encode() + raw, secrets) for name, raw in contents(folder)}
    assert len(found) > 5
    assert {name: told for name, told in found.items() if told} == {}


def test_the_search_finds_what_is_planted(folder):
    """Of each kind of secret at least one is in the inputs where the search looks."""
    found = {secret for name, raw in contents(folder) for secret in leaks(name.encode() + raw, TAG_SECRETS)}
    assert found == set(TAG_SECRETS)


def test_nothing_of_it_is_stored_or_said(folder, limbfit_and_libraries):
    for words in (["series"], ["check"], ["run", "--until", "sites"], ["status", "--json"]):
        code, out, err = limbfit_and_libraries(*words, folder)
        assert code == 0, err
        assert leaks((out + err).encode(), TAG_SECRETS) == []
    study = load_study(folder)
    write_result(study.results / "run.json", run_record(study))
    assert_private(study.results)
    record = json.loads((study.results / "run.json").read_text())
    assert record["settings"]["image"]["path"].startswith("sha256:")
    assert set(record["inputs"]) == {"image.path"}


def copied(folder: Path, place: Path) -> tuple[Path, Path]:
    """A copy of the study without its results, and one of its slices."""
    copy = shutil.copytree(folder, place / "copy", ignore=shutil.ignore_patterns("results"))
    return copy, sorted((copy / "mri-MARKERXQ").iterdir())[3]


@pytest.mark.parametrize(
    "changes",
    [
        {"Modality": "MARKERX1"},
        {"SeriesNumber": "77", "Modality": "OT"},
        {"PixelSpacing": None},
        {"ImageOrientationPatient": [1, 0, 0, 0.5, 0.5, 0]},
        {"SamplesPerPixel": 3},
        {"PixelData": b"\0" * 100},
        {"Rows": 7},
    ],
)
@pytest.mark.usefixtures("commands_unasked")
def test_errors_tell_no_value_of_a_tag(folder, tmp_path, limbfit_and_libraries, changes):
    copy, file = copied(folder, tmp_path)
    data = pydicom.dcmread(file)
    for tag, value in changes.items():
        if value is None:
            delattr(data, tag)
        else:
            setattr(data, tag, value)
    data.save_as(file)
    check_silent(copy, limbfit_and_libraries)


@pytest.mark.parametrize(
    "old",
    [b"MARKERX1", b"DS\x10\x00", b"UI\x0e\x00", b"7777003", b"PN\x18\x00", b"19470911", b"CS\x02\x00MR"],
)
@pytest.mark.usefixtures("commands_unasked")
def test_damaged_tags_tell_no_value_either(folder, tmp_path, limbfit_and_libraries, old):
    """Bytes of values and of their lengths overwritten, which makes pydicom and GDCM complain of them."""
    copy, file = copied(folder, tmp_path)
    file.write_bytes(file.read_bytes().replace(old, bytes(reversed(old)), 1))
    check_silent(copy, limbfit_and_libraries)


def check_silent(folder: Path, limbfit) -> None:
    for verb in ("series", "check"):
        code, *shown = limbfit(verb, folder)
        told = "".join(shown)
        assert code in (0, 2), told
        assert leaks(told.replace("mri-MARKERXQ", "").encode(), [*TAG_SECRETS, "MARKERXR"]) == []
        assert "Traceback" not in told
    assert not list(folder.glob("results/*"))


@pytest.mark.slow
def test_no_path_is_in_the_results_of_a_whole_run(study, tmp_path, limbfit_and_libraries):
    """Calibration, predictions, report and a single simulation of a study with names in its paths."""
    place = study.rename(tmp_path / "study-MARKERXP")
    names = {"skin.stl": "MARKERXQ.stl", "tibia.stl": "b-MARKERXR.stl", "1.csv": "MARKERXS-1.csv"}
    text = (place / "study.toml").read_text() + COARSE
    for old, new in names.items():
        (place / old).rename(place / new)
        text = text.replace(f'"{old}"', f'"{new}"')
    (place / "study.toml").write_text(text)
    for words in (["run", place], ["simulate", place, "--site", "2"]):
        code, _, err = limbfit_and_libraries(*words)
        assert code == 0, err
    assert (place / "results" / "report" / "report.html").is_file()
    assert_private(place / "results")
