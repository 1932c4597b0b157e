"""Where the limbs of people come from: the phantom, a shape model, or a folder of limbs.

Each source maps numbers of [0, 1), one for each of its ``names``, to a limb.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from scipy.stats import truncnorm

from ..anatomy.surfaces.files import SUFFIXES
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import InputError
from ..phantom.geometry import LIMBS, Limb, LimbShape, build_true_anatomy, compute_surface_point
from .bodies import read_bodies
from .shape_model import ShapeModel
from .trial import Trial

FARTHEST = 2.5  # standard deviations of a mode: beyond, shapes cross themselves and nobody has them
_AROUND, _ALONG = 72, 50  # points of the phantom's skin that correspond


@dataclass(frozen=True, eq=False)
class DrawnLimb:
    """Skin and bones (LPS mm) by name; ``skin_points`` (n, 3) correspond in all limbs, where any do."""

    surfaces: Mapping[str, Surface]
    skin_points: Array | None


class LimbSource(ABC):
    """Limbs by numbers; ``names`` are what the numbers, made into inputs, are called.

    ``mean_skin`` is the skin of the mean limb, whose points correspond to ``skin_points``, where any do.
    """

    names: tuple[str, ...]
    mean_skin: Surface | None = None

    @abstractmethod
    def to_inputs(self, numbers: Array) -> Array:
        """The inputs (d,) of numbers (d,) in [0, 1)."""

    @abstractmethod
    def build(self, inputs: Array) -> DrawnLimb:
        """The limb of inputs (d,)."""


class PhantomLimbs(LimbSource):
    """The phantom's limbs: every size of its shape is uniform around its default."""

    def __init__(self, kind: str) -> None:
        self.shape: LimbShape = LIMBS[kind]
        self.sizes = fields(self.shape)
        self.names = tuple(size.name for size in self.sizes)
        rows, around = np.arange(_ALONG - 1)[:, None] * _AROUND, np.arange(_AROUND)
        a, b = rows + around, rows + np.roll(around, -1)
        corners = [[a, b, b + _AROUND], [a, b + _AROUND, a + _AROUND]]
        faces = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in corners])
        self.mean_skin = Surface(self._list_points(self.shape), faces)

    def to_inputs(self, numbers: Array) -> Array:
        middle = np.array([getattr(self.shape, name) for name in self.names])
        reach = np.array([size.metadata["variation"] for size in self.sizes])
        return np.asarray(middle + reach * (2.0 * numbers - 1.0), dtype=np.float64)

    def build(self, inputs: Array) -> DrawnLimb:
        shape = replace(self.shape, **dict(zip(self.names, map(float, inputs), strict=True)))
        anatomy = build_true_anatomy(Limb(shape, np.eye(3), np.zeros(3)))
        return DrawnLimb({"skin": anatomy.skin, **anatomy.bones}, self._list_points(shape))

    def _list_points(self, shape: LimbShape) -> Array:
        angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
        height = shape.datum * np.linspace(0.002, 1.15, _ALONG)
        points = compute_surface_point(shape, *np.meshgrid(angle, height))
        return np.asarray(points, dtype=np.float64).reshape(-1, 3)


class ModelLimbs(LimbSource):
    """Limbs of a shape model: scores of its modes are normal, cut off at `FARTHEST`."""

    def __init__(self, file: Path, modes: int | None) -> None:
        self.model = ShapeModel.read(file)
        self.mean_skin = self.model.mean.extract("skin")
        there = len(self.model.modes)
        if modes is not None and modes > there:
            raise InputError(f"the model has {there} modes", file=file, remedy="lower shapes.modes")
        self.names = tuple(f"mode {k + 1}" for k in range(modes or there))

    def to_inputs(self, numbers: Array) -> Array:
        return np.asarray(truncnorm.ppf(numbers, -FARTHEST, FARTHEST))

    def build(self, inputs: Array) -> DrawnLimb:
        limb = self.model.draw(inputs)
        surfaces = {name: limb.extract(name) for name in limb.faces}
        return DrawnLimb(surfaces, surfaces["skin"].points)


class FolderLimbs(LimbSource):
    """The limbs of a folder, each as likely as the others."""

    names = ("limb",)

    def __init__(self, folder: Path, unit: str) -> None:
        self.unit = unit
        files = [path for path in folder.iterdir() if path.is_dir() or path.suffix.lower() in SUFFIXES]
        self.files = sorted(path for path in files if not path.name.startswith("."))
        if not self.files:
            remedy = "put a file or a folder of bodies there for each limb"
            raise InputError("no limbs are there", file=folder, remedy=remedy)

    def to_inputs(self, numbers: Array) -> Array:
        return 1.0 + np.floor(numbers * len(self.files))

    def build(self, inputs: Array) -> DrawnLimb:
        limb = read_bodies([self.files[int(inputs[0]) - 1]], self.unit)[0]
        return DrawnLimb({name: limb.extract(name) for name in limb.faces}, None)


def open_limb_source(trial: Trial) -> LimbSource:
    """Where a trial's limbs come from. Raises `InputError` for a model or folder that is none."""
    table = trial.shapes
    if table.phantom is not None:
        return PhantomLimbs(table.phantom)
    if table.model is not None:
        return ModelLimbs(trial.path(table.model), table.modes)
    assert table.folder is not None
    return FolderLimbs(trial.path(table.folder), table.unit)
