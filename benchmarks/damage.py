"""A whole study of the synthetic patient, and the list of ways in which its inputs can be damaged.

A kind of damage is a function ``(random, whole, folder) -> Inputs`` that writes inputs into a folder, and
what must come of it:

refused    exit code 2 and one line
same       exit code 0 and the surfaces of the undamaged study
repaired   the same, and a sentence that says what was done
either     refused or same: damage drawn so freely that both are right
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from limbfit import load_study, run_study
from limbfit.anatomy.imaging import LabelMap, Volume, read_labels, read_volume
from limbfit.anatomy.surfaces.surfaces import Anatomy, load_anatomy
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.mri import make_grid, write_series

EDGE_MM = 10.0
SAME_MM = 0.3  # triangles of 10 mm of the same body that were remeshed another way


@dataclass(frozen=True)
class Whole:
    """The undamaged inputs; ``folder`` holds the series as ``mri``, and what came of it in ``results``."""

    folder: Path
    image: Volume
    labels: LabelMap
    anatomy: Anatomy

    def study(self, inputs: Inputs) -> str:
        """The text of a study file for some inputs made from these."""
        cut = (self.anatomy.cut_point.tolist(), self.anatomy.cut_normal.tolist())
        return Study(inputs, self.anatomy.skin.points[0].tolist(), cut).text

    @property
    def series(self) -> Path:
        return self.folder / "mri"

    def copy_series(self, folder: Path) -> list[Path]:
        """A copy of the DICOM series in ``folder/mri``; its files in the order of slices."""
        shutil.copytree(self.series, folder / "mri")
        return sorted((folder / "mri").iterdir())


@dataclass(frozen=True)
class Inputs:
    """What the study names, relative to its folder; ``stated`` are further lines of the surfaces' table."""

    image: str = ""
    labels: str = ""
    surfaces: tuple[str, dict[str, str]] | None = None
    stated: str = ""


@dataclass(frozen=True)
class Kind:
    """A way to damage inputs and what must come of it; ``says`` is in the error or in the repair.

    ``by_check`` is whether ``limbfit check`` refuses it too, which builds no surfaces.
    """

    name: str
    room: str
    expected: str
    make: Callable[[np.random.Generator, Whole, Path], Inputs]
    says: str = ""
    within_mm: float = SAME_MM
    by_check: bool = True


KINDS: dict[str, Kind] = {}


def kind(
    room: str, expected: str, says: str = "", within_mm: float = SAME_MM, by_check: bool = True
) -> Callable:
    """Register a function as a kind under its name."""

    def register(make: Callable) -> Callable:
        KINDS[make.__name__] = Kind(make.__name__, room, expected, make, says, within_mm, by_check)
        return make

    return register


def make_whole(folder: Path, seed: int) -> None:
    """Write the coarse phantom of a seed, its DICOM series, and run the undamaged study of it."""
    limb = make_limb(seed)
    write_series(folder / "mri", limb, make_grid(limb, "coarse", seed), seed=seed)
    (folder / "study.toml").write_text(Study(Inputs(image="mri")).text)
    run_study(load_study(folder), until="surfaces", listener=lambda event: None)


def read_whole(folder: Path) -> Whole:
    """What :func:`make_whole` wrote."""
    labels = read_labels(folder / "results" / "segment" / "labels.seg.nrrd")
    return Whole(folder, read_volume(folder / "mri"), labels, load_anatomy(folder / "results" / "surfaces"))


@dataclass(frozen=True)
class Study:
    """The text of a study file for some inputs."""

    inputs: Inputs
    site: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    cut: tuple[list[float], list[float]] = ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])

    @property
    def text(self) -> str:
        inputs = self.inputs
        lines = ["[study]", 'name = "damaged"']
        if inputs.image:
            lines += ["[image]", f'path = "{inputs.image}"']
        if inputs.labels:
            lines += ["[segmentation]", f'labels = "{inputs.labels}"']
        elif inputs.surfaces is None:
            lines += ["[segmentation]", "bias_correction = false"]  # it takes most of the time
        lines += ["[geometry]"]
        if inputs.surfaces is None:
            lines += [f"surface_edge_mm = {EDGE_MM}"]
        else:
            skin, bones = inputs.surfaces
            point, normal = self.cut
            named = ", ".join(f'"{name}" = "{file}"' for name, file in bones.items())
            lines += [f"proximal_cut = {{ point = {point}, normal = {normal} }}"]
            lines += ["[surfaces]", f'skin = "{skin}"', f"bones = {{ {named} }}", inputs.stated]
        lines += ["[[sites]]", 'name = "1"', "depth_mm = 5.0", f"position = {self.site}", ""]
        return "\n".join(lines)
