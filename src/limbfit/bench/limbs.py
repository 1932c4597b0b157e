"""The limbs that benchmarks mesh: phantoms of several seeds, a mean residuum, a real calf cut virtually."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..anatomy.grid import Grid
from ..anatomy.imaging import read_volume
from ..anatomy.segmentation.amputation import amputate_limb, label_map
from ..anatomy.segmentation.segmentation import segment
from ..anatomy.sites.sites import compute_indenter_axis
from ..anatomy.surfaces.surfaces import Anatomy, build_anatomy, check_anatomy, read_surface
from ..arrays import Array
from ..errors import InputError
from ..phantom.geometry import make_limb
from ..phantom.mri import make_grid

SEEDS = (0, 1, 2)
SLAB = 16
INDENTER_MM = 20.0
BELOW_CUT_MM = 25.0  # sites keep this far from the proximal cut
CALF_PLANE = (-36.7, 13.3, -94.4), (-0.10164, -0.16645, 0.98080)
CALF_PAD_MM = 15.0
OPENLIMB_CUT = (0.0, 0.0, 5.0), (0.0, 0.0, 1.0)


def list_limbs(shared: Path) -> dict[str, Callable[[], Anatomy]]:
    """Name and maker of five limbs; ``shared`` is the folder with ``data`` and ``reference``.

    Raises
    ------
    InputError
        Where that folder lacks the real limbs.
    """
    openlimb, calf = shared / "reference" / "openlimb-study", shared / "data" / "calf-mri"
    for folder in (openlimb, calf):
        if not folder.is_dir():
            raise InputError("the real limbs are not there", file=folder, remedy="give --shared")
    phantoms = {f"phantom {seed}": lambda seed=seed: make_phantom_limb(seed) for seed in SEEDS}
    return {
        **phantoms,
        "openlimb": lambda: make_openlimb_mean(openlimb),
        "calf": lambda: make_amputated_calf(calf),
    }


def make_phantom_limb(seed: int, detail: str = "paper") -> Anatomy:
    """The surfaces of a phantom as a label map on its scanner's grid shows them."""
    limb, grid = make_limb(seed), make_grid(make_limb(seed), detail, seed)
    skin, *bones = np.zeros((1 + len(limb.bone_names), *grid.shape), dtype=bool)
    for k in range(0, grid.shape[0], SLAB):
        slab = slice(k, min(k + SLAB, grid.shape[0]))
        points = grid.points(slab, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        skin[slab] = limb.skin(points) < 0
        for bone, name in zip(bones, limb.bone_names):
            bone[slab] = limb.bone(name, points) < 0
    voxels = Grid(skin, np.array(grid.spacing), grid.origin, grid.direction)
    return _check_limb(build_anatomy(label_map(voxels, skin, dict(zip(limb.bone_names, bones)))))


def make_openlimb_mean(folder: Path) -> Anatomy:
    """The mean residuum of 33 limbs (OpenLimb), as the example uses it."""
    bones = {name: read_surface(folder / f"{name}.stl") for name in ("tibia", "fibula")}
    point, normal = (np.array(part) for part in OPENLIMB_CUT)
    return _check_limb(Anatomy(read_surface(folder / "skin.stl"), bones, point, normal))


def make_amputated_calf(folder: Path) -> Anatomy:
    """The calf MRI, segmented automatically and amputated as in the example."""
    labels = amputate_limb(segment(read_volume(folder)), *CALF_PLANE, pad_mm=CALF_PAD_MM)
    return _check_limb(build_anatomy(labels))


def _check_limb(anatomy: Anatomy) -> Anatomy:
    check_anatomy(anatomy)
    return anatomy


def draw_random_sites(anatomy: Anatomy, count: int, seed: int = 0) -> list[tuple[Array, Array]]:
    """Positions (3,) spread evenly over the skin below the cut, and the indenter's axis (3,) at each."""
    random = np.random.default_rng(seed)
    corners, area = anatomy.skin.triangles, anatomy.skin.face_areas
    area = np.where(anatomy.height(corners).max(axis=1) < -BELOW_CUT_MM, area, 0.0)
    faces = random.choice(len(area), count, p=area / area.sum())
    points = np.einsum("ni,nij->nj", random.dirichlet(np.ones(3), count), corners[faces])
    return [(point, compute_indenter_axis(anatomy.skin, point, INDENTER_MM)) for point in points]
