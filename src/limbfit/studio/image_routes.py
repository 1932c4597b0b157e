"""The view Image: the image and its labels as NIfTI, surfaces for 3-D, and labels corrected by hand.

A label map that the stage ``segment`` made is saved over, as 3D Slicer would: the pipeline takes it as
corrected by hand from then on. Where the study names labels of its own, the corrected map is put
beside the study file, which then names that one: the given file stays as it is.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import SimpleITK as sitk  # noqa: N813
from fastapi import APIRouter, Response
from matplotlib.colors import to_hex
from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt

from ..anatomy.grid import Grid, LabelMap, Volume
from ..anatomy.imaging import read_labels, write_labels
from ..anatomy.labels.labelfiles import get_colour
from ..anatomy.surfaces.surfaces import read_surface
from ..errors import InputError, RunError
from ..pipeline.engine.digests import compute_file_digest
from ..pipeline.limb.segment import read_plain_image
from ..study import Study
from .editing import edit_study
from .folder import Json, StudyFolder
from .processes import find_running
from .study_routes import Folder

router = APIRouter(prefix="/api/image")
LABELS = "labels.seg.nrrd"
BESIDE = "corrected.seg.nrrd"
# Index axes to the right, to the front and up: the order in which the page counts voxels.
PAGE_AXES = np.diag([-1.0, -1.0, 1.0])
MAX_RUNS = 2_000_000
Label = Annotated[int, Field(ge=0, le=255)]


class Painting(BaseModel):
    """Painted voxels as runs ``[first, count, label]`` of the page's order, and on which labels they are."""

    base: Annotated[str, Field(min_length=1, max_length=80)]
    runs: Annotated[list[tuple[NonNegativeInt, PositiveInt, Label]], Field(min_length=1, max_length=MAX_RUNS)]


@router.get("")
def get_facts(folder: Folder) -> Json:
    """Names and colours of the labels, the stored surfaces, and where corrected labels are saved."""
    study = folder.load()
    if study.image is None:
        return {"has_image": False}
    surfaces = sorted(file.name for file in (folder.results / "surfaces").glob("*.stl"))
    facts: Json = {"has_image": True, "surfaces": surfaces, "labels": None}
    shown = _find_shown_labels(folder)
    if shown is not None:
        labels = _read_shown_labels(shown)
        facts["labels"] = {
            "base": shown.digest,
            "saved_to": shown.name_target(study),
            "names": [
                {"value": value, "name": name, "colour": to_hex(get_colour(name, n))}
                for n, (value, name) in enumerate(sorted(labels.names.items()))
            ],
        }
    return facts


@router.get("/volume")
def get_volume(folder: Folder) -> Response:
    """The image as NIfTI, its voxels in the page's order."""
    study = folder.load()
    if study.image is None:
        raise InputError("the study has no image", file=study.file, place="image")
    # As stored; only the stage ``segment`` checks that it shows one limb.
    return _respond_nifti(read_plain_image(study).align_axes(PAGE_AXES))


@router.get("/labels")
def get_labels(folder: Folder) -> Response:
    """The label map as NIfTI, voxels as in `get_volume`; the header ``X-Base`` names its content."""
    shown = _find_shown_labels(folder)
    if shown is None:
        raise FileNotFoundError(LABELS)
    answer = _respond_nifti(_read_shown_labels(shown).align_axes(PAGE_AXES))
    answer.headers["X-Base"] = shown.digest
    return answer


@router.post("/labels")
def post_labels(folder: Folder, painting: Painting) -> Json:
    """Save painted voxels into the study's label map; stages below it turn stale.

    It is refused where the labels are others than those that were painted on, and while a run goes on.
    """
    study, shown = folder.load(), _find_shown_labels(folder)
    if shown is None:
        raise FileNotFoundError(LABELS)
    if find_running(folder) is not None:
        raise RunError("a run of this study is in progress; stop it or wait for it before labels are saved")
    if shown.digest != painting.base:
        raise RunError("the labels have changed since they were opened here; open them and change them again")
    labels = _read_shown_labels(shown)
    painted = paint_runs(labels, painting.runs)
    changed = int((painted.array != labels.array).sum())
    if changed:
        _save_labels(folder, study, shown, painted)
    saved = _find_shown_labels(folder)
    assert saved is not None
    return {"changed_voxels": changed, "base": saved.digest, "saved_to": saved.name_target(folder.load())}


@router.get("/surfaces/{name}")
def get_surface(folder: Folder, name: str) -> Response:
    """A surface of the model as binary STL, in RAS millimetres as the page's 3-D view wants it."""
    surface = read_surface(folder.artefact("surfaces", name), "LPS")
    corners = (surface.points * [-1.0, -1.0, 1.0])[surface.faces].astype("<f4")
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["corners"] = corners
    head = b"RAS".ljust(80) + np.uint32(len(corners)).tobytes()
    return Response(head + rows.tobytes(), media_type="model/stl")


@dataclass(frozen=True)
class ShownLabels:
    """The label map on the page: its file and the digest of its content."""

    file: Path
    digest: str

    def name_target(self, study: Study) -> str:
        """The file that a correction is saved to, relative to the study."""
        return BESIDE if study.segmentation.is_given else f"results/segment/{LABELS}"


def _find_shown_labels(folder: StudyFolder) -> ShownLabels | None:
    """The corrected map beside the study where the study names it, else that of the stage ``segment``."""
    named = folder.load().segmentation.labels
    file = folder.results / "segment" / LABELS
    if named == Path(BESIDE) and (folder.folder / BESIDE).is_file():
        file = folder.folder / BESIDE
    return ShownLabels(file, compute_file_digest(file)) if file.is_file() else None


@lru_cache(maxsize=1)
def _read_shown_labels(shown: ShownLabels) -> LabelMap:
    """The label map on the page; the last one is kept: a page asks for its names, then for its voxels."""
    return read_labels(shown.file)


def _save_labels(folder: StudyFolder, study: Study, shown: ShownLabels, labels: LabelMap) -> None:
    """Write a corrected map to where the pipeline takes it from, in one piece."""
    place = folder.folder / shown.name_target(study)
    written = place.with_name(f".new-{place.name}")
    try:
        write_labels(written, labels)
        written.replace(place)
    finally:
        written.unlink(missing_ok=True)
    if study.segmentation.is_given and study.segmentation.labels != Path(BESIDE):
        with edit_study(folder.file) as document:
            table: Any = document["segmentation"]
            table.pop("contours", None)
            table["labels"] = BESIDE


def paint_runs(labels: LabelMap, runs: list[tuple[int, int, int]]) -> LabelMap:
    """The labels with runs of the page's voxels set; `InputError` for unknown labels and voxels outside."""
    turned = labels.align_axes(PAGE_AXES)
    flat = turned.array.ravel().copy()
    table = np.array(runs, dtype=np.int64)
    if (table[:, 0] + table[:, 1]).max() > flat.size:
        raise InputError("painted voxels lie outside of the label map")
    unknown = sorted(set(table[:, 2].tolist()) - {0, *labels.names})
    if unknown:
        raise InputError(f"the label map has no label {unknown[0]}")
    for first, count, value in table.tolist():
        flat[first : first + count] = value
    return turned.with_array(flat.reshape(turned.array.shape)).align_axes(labels.direction)


def _respond_nifti(grid: Volume | LabelMap) -> Response:
    array = grid.array
    if array.dtype != np.uint8 and np.array_equal(array, np.round(array)) and np.abs(array).max() < 2**15:
        array = array.astype(np.int16)
    with TemporaryDirectory() as place:
        file = Path(place) / "image.nii"
        sitk.WriteImage(Grid(array, *grid.geometry).to_sitk(), str(file))
        return Response(file.read_bytes(), media_type="application/octet-stream")
