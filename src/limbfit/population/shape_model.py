"""Shape models: the mean of limbs in correspondence, and the modes in which they differ.

Limbs x_i (3 n numbers, all bodies together, so that bones move with the skin) are brought over one another
by rotation and translation (generalised Procrustes; size is part of shape). With the mean m the centred
limbs are U S V', and mode k moves the mean by s_k v_k, s_k = S_k / sqrt(N - 1), for one standard deviation
(Cootes et al. 1995, Comput Vis Image Underst 61, 38).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..anatomy.surfaces.files import UNITS_MM
from ..arrays import Array, Indices
from ..errors import InputError
from ..results.population import ShapeModelResult
from .bodies import LimbBodies, read_bodies, register_limbs

MAX_ROUNDS, STILL_MM = 50, 1e-6  # of the alignment to the mean
SPECIFICITY_DRAWS = 200
FACES = "faces_"  # before the name of a body, in the file


@dataclass(frozen=True, eq=False)
class ShapeModel:
    """A mean limb, its bodies in LPS mm with n points in all, and its modes.

    ``modes`` (k, n, 3) are in mm, each of one standard deviation. ``figures``: how good the model is, as it
    was made.
    """

    mean: LimbBodies
    modes: Array
    figures: ShapeModelResult

    def draw(self, scores: Array) -> LimbBodies:
        """The limb whose modes have the ``scores (k,)``, in standard deviations."""
        points = self.mean.points + np.tensordot(scores, self.modes[: len(scores)], axes=1)
        return LimbBodies(points, self.mean.faces)

    def write(self, file: Path) -> None:
        """Write ``mean``, ``modes``, ``figures`` (JSON), and ``faces_<body>`` as arrays of NumPy (.npz)."""
        arrays = {f"{FACES}{name}": faces for name, faces in self.mean.faces.items()}
        figures = np.array(json.dumps(self.figures.to_plain()))
        np.savez_compressed(file, mean=self.mean.points, modes=self.modes, figures=figures, **arrays)  # type: ignore[arg-type]

    @classmethod
    def read(cls, file: Path) -> ShapeModel:
        """Read what `write` has written. Raises `InputError` for a file that it has not."""
        try:
            with np.load(file, allow_pickle=False) as stored:
                names = [key for key in stored.files if key.startswith(FACES)]
                faces: dict[str, Indices] = {key.removeprefix(FACES): stored[key] for key in names}
                figures = ShapeModelResult.model_validate(json.loads(str(stored["figures"])))
                return cls(LimbBodies(stored["mean"], faces), stored["modes"], figures)
        except (OSError, ValueError, KeyError) as error:
            is_there = not isinstance(error, FileNotFoundError)
            what = f"this is no shape model: {error}" if is_there else "no such shape model"
            raise InputError(what, file=file, remedy="limbfit shapes model makes one") from None


def build_shape_model(
    limbs: Sequence[str | Path],
    *,
    unit: str = "mm",
    register: bool = False,
    mean: str | Path | None = None,
    at: float = 2.0,
) -> ShapeModel:
    """Build a shape model of limbs.

    Raises `InputError` for too few limbs, an unknown unit, and as `read_bodies` and `register_limbs`.

    Parameters
    ----------
    limbs : files with all bodies of a limb in each, or folders with a file for each body; z is proximal.
    unit : of the files.
    register : they are not in correspondence: bend the first one onto the others.
    mean : they are no people but ``at`` standard deviations of the modes of a model with this mean, to
        either side or to one.
    """
    if unit not in UNITS_MM:
        raise InputError(f"unknown unit {unit!r}", remedy=f"use one of {', '.join(UNITS_MM)}")
    paths = [Path(path) for path in (*([mean] if mean is not None else []), *limbs)]
    if len(paths) < (2 if mean is not None else 3):
        raise InputError(f"{len(limbs)} limbs are too few", remedy="give three or more, or a mean and one")
    found, distances = register_limbs(paths, unit) if register else (read_bodies(paths, unit), [])
    sizes = [float(np.linalg.norm(np.ptp(one.points, axis=0))) for one in found]
    odd = next((i for i, size in enumerate(sizes) if not 0.2 < size / np.median(sizes) < 5.0), None)
    if odd is not None:
        what = f"{sizes[odd]:.3g} mm from end to end, where the others are {np.median(sizes):.3g} mm"
        raise InputError(what, file=paths[odd], remedy="bring all limbs to one unit")
    points = np.stack([one.points for one in found])
    if mean is None:
        aligned, middle = find_mean(points)
        modes = find_modes(aligned - middle, len(points) - 1)
        left_out, specificity = measure_left_out(aligned), measure_specificity(aligned, middle, modes)
    else:
        aligned, middle = np.stack([move_onto(one, points[0]) for one in points[1:]]), points[0]
        modes = find_modes(weigh_sides((aligned - middle) / at), 1.0)
        left_out, specificity = None, None
    variance = (modes**2).sum(axis=(1, 2))
    figures = ShapeModelResult(
        limbs=len(limbs),
        bodies=list(found[0].faces),
        points=len(middle),
        explained=(np.cumsum(variance) / variance.sum()).tolist(),
        deviation_mm=np.sqrt(variance / len(middle)).tolist(),
        left_out_mm=left_out,
        specificity_mm=specificity,
        registration_rms_mm=max((float(np.sqrt((one**2).mean())) for one in distances), default=None),
        registration_p95_mm=max((float(np.percentile(one, 95)) for one in distances), default=None),
    )
    return ShapeModel(LimbBodies(middle, found[0].faces), modes, figures)


def move_onto(points: Array, target: Array) -> Array:
    """Points (n, 3) turned and moved to be nearest to those of the target (Kabsch)."""
    middle = target.mean(axis=0)
    own = points - points.mean(axis=0)
    return Rotation.align_vectors(target - middle, own)[0].apply(own) + middle


def find_mean(limbs: Array) -> tuple[Array, Array]:
    """Limbs (N, n, 3) over their mean, and the mean (n, 3), by generalised Procrustes without scaling."""
    mean = limbs[0]
    for _ in range(MAX_ROUNDS):
        limbs = np.stack([move_onto(one, mean) for one in limbs])
        new = move_onto(limbs.mean(axis=0), mean)
        moved, mean = np.abs(new - mean).max(), new
        if moved < STILL_MM:
            break
    return limbs, mean


def find_modes(deviations: Array, degrees: float) -> Array:
    """Modes (k, n, 3) of deviations (N, n, 3) from a mean, largest first; those of no size are left out."""
    flat = deviations.reshape(len(deviations), -1)
    _, sizes, rows = np.linalg.svd(flat, full_matrices=False)
    kept = sizes > 1e-6 * sizes[0]
    scaled = (sizes[kept] / np.sqrt(degrees))[:, None] * rows[kept]
    return scaled.reshape(-1, *deviations.shape[1:])


def weigh_sides(deviations: Array) -> Array:
    """Deviations (N, n, 3) by one standard deviation, where a mode may be there to both sides: each half."""
    flat = deviations.reshape(len(deviations), -1)
    cosines = flat @ flat.T / np.outer(*[np.linalg.norm(flat, axis=1)] * 2)
    weights = np.where((cosines < -0.5).any(axis=1), 0.5, 1.0)
    return deviations * np.sqrt(weights)[:, None, None]


def measure_left_out(limbs: Array) -> list[float]:
    """RMS distance (mm) of points of a limb from the nearest shape of the others' model with 1, 2, ... modes,
    over all limbs (N, n, 3).
    """
    squares = np.zeros((len(limbs), len(limbs) - 2))
    for i, limb in enumerate(limbs):
        others = np.delete(limbs, i, axis=0)
        mean = others.mean(axis=0)
        rows = find_modes(others - mean, 1.0).reshape(-1, mean.size)
        left = (move_onto(limb, mean) - mean).ravel()
        for k in range(squares.shape[1]):
            if k < len(rows):
                unit = rows[k] / np.linalg.norm(rows[k])
                left = left - (left @ unit) * unit
            squares[i, k] = left @ left / len(limb)
    return [float(value) for value in np.sqrt(squares.mean(axis=0))]


def measure_specificity(limbs: Array, mean: Array, modes: Array) -> float:
    """Mean RMS distance (mm) of drawn shapes from the nearest of the limbs (N, n, 3)."""
    scores = np.random.default_rng(0).standard_normal((SPECIFICITY_DRAWS, len(modes)))
    flat, drawn = (limbs - mean).reshape(len(limbs), -1), modes.reshape(len(modes), -1)
    # |s D - x|^2 by inner products: no drawn shape is built.
    gram, cross = drawn @ drawn.T, drawn @ flat.T
    squares = ((scores @ gram) * scores).sum(axis=1)[:, None] - 2 * scores @ cross + (flat**2).sum(axis=1)
    return float(np.sqrt(np.clip(squares.min(axis=1), 0, None) / len(mean)).mean())
