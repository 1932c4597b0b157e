"""The view Start, of a folder without a study: files come in, and a study file is written."""

from typing import Annotated

from fastapi import APIRouter, Body
from pydantic import NonNegativeInt

from ..errors import InputError
from ..pipeline.commands.inputs import list_inputs
from ..shapes import SHAPES, Stl
from ..study.writing import NewStudy, create_study
from .folder import Json, resolve_inside
from .study_routes import Folder

router = APIRouter(prefix="/api/start")
INPUTS = "inputs"  # the folder, beside the study file, that files come into
Content = Annotated[bytes, Body(media_type="application/octet-stream")]


@router.get("")
def get_inputs(folder: Folder) -> Json:
    """What the folder holds (see `list_inputs`), and the shapes of indenters with their measures."""
    shapes = [
        {
            "name": shape.name,
            "measures": [["width_mm", 20.0], *([measure.key, measure.value] for measure in shape.measures)],
        }
        for shape in SHAPES
        if shape is not Stl  # needs a file: that is for an editor
    ]
    return {**list_inputs(folder.folder), "shapes": shapes}


@router.post("/files/{path:path}")
def post_file(folder: Folder, path: str, content: Content, offset: NonNegativeInt = 0) -> Json:
    """Store a part of a file from ``offset`` (bytes) on; returns its path below the folder.

    The same file may come again. Raises `InputError` where another one has its name.
    """
    file = resolve_inside(folder.folder, INPUTS, *path.split("/"), is_new=True)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.touch()
    with file.open("r+b") as stream:
        stream.seek(offset)
        before = stream.read(len(content))
        if before != content[: len(before)]:
            raise InputError(f"there is another file {INPUTS}/{path}", remedy="rename one of the two")
        stream.seek(offset)
        stream.write(content)
    return {"path": f"{INPUTS}/{path}"}


@router.post("/study")
def post_study(folder: Folder, new: NewStudy) -> Json:
    """Write the study file; the page then shows the study."""
    return {"file": create_study(folder.folder, new).name}
