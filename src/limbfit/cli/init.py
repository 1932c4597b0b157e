"""A study file made by asking, for what lies in a folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, BadParameter, confirm, prompt

import limbfit

from .console import print_line


def init(folder: Annotated[Path, Argument(help="folder with images or surfaces, and records")]) -> None:
    """Make a study.toml by asking, for the images or surfaces, and the records in a folder."""
    found = limbfit.list_inputs(folder)
    images = [row for row in found["images"] if row.get("whole", True)]
    name = prompt("name of the study (no patient's name)", default=folder.resolve().name)
    content: dict[str, Any] = {"name": name}
    image = _choose("image of the limb", images, "none: the limb is given by surfaces")
    if image is None:
        content |= _ask_surfaces(found["surfaces"])
    else:
        content |= {"image": image["path"], "series": image.get("uid")}
        others = [row for row in images if row is not image]
        marked = _choose("image of the same limb with markers on the skin", others, "none", default=0)
        if marked is not None:
            content |= {"markers": marked["path"], "markers_series": marked.get("uid")}
    content["indenter"] = {"shape": prompt("shape of the indenter", default="square")}
    content["indenter"]["width_mm"] = prompt("its width in mm", default=20.0, type=float)
    records = [
        row["path"] for row in found["records"] if confirm(f"is {row['path']} a site's record?", default=True)
    ]
    content["sites"] = [_ask_site(path, "markers" in content) for path in records]
    file = limbfit.create_study(folder, limbfit.NewStudy.model_validate(content))
    print_line(f"{file} is written; next: limbfit check {folder}")
    if not content["sites"]:
        print_line(f"it has no site yet: limbfit run {folder} --until surfaces, then limbfit studio {folder}")


def _choose(what: str, rows: Sequence[Any], otherwise: str, default: int = 1) -> dict[str, Any] | None:
    """One of some files, by its number; 0: ``otherwise``."""
    if not rows:
        return None
    for number, row in enumerate(rows, 1):
        size = f", {row['columns']} x {row['rows']} x {row['slices']}" if "uid" in row else ""
        print_line(f"  {number}  {row['path']}{size}")
    print_line(f"  0  {otherwise}")
    chosen = prompt(f"{what} (number)", default=default, type=int)
    return rows[chosen - 1] if 0 < chosen <= len(rows) else None


def _ask_surfaces(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    skin = _choose("surface of the skin", rows, "none")
    ask = "name of the bone in {} (empty: no bone)"
    named = {prompt(ask.format(row["path"]), default=""): row["path"] for row in rows if row is not skin}
    bones = {name: path for name, path in named.items() if name}
    unit = prompt("unit of the surfaces", default="mm")
    return {"skin": skin and skin["path"], "bones": bones, "unit": unit}


def _ask_site(trace: str, marked: bool) -> dict[str, Any]:
    """The site of a record: its name, its place and whether it is fitted."""
    site: dict[str, Any] = {"name": prompt("  name of the site", default=Path(trace).stem), "trace": trace}
    what = "rough place of its marker" if marked else "its place on the skin"
    site["near" if marked else "position"] = prompt(f"  {what}: x y z in mm (LPS)", value_proc=_read_place)
    site["fitted"] = confirm("  fitted (otherwise it tests the prediction)?", default=True)
    return site


def _read_place(text: str) -> list[float]:
    try:
        x, y, z = map(float, text.replace(",", " ").split())
    except ValueError:
        raise BadParameter("give three numbers, such as 12.5 -48 30") from None
    return [x, y, z]


VERBS = (init,)
