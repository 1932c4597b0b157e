"""Draw what the stages ``segment`` and ``surfaces`` stored of the calf study, and count slices.

    python pictures.py STUDY_FOLDER PICTURES_FOLDER

Writes ``slices.png`` (outline and bones over every fifth slice) and ``surfaces.png`` (the stump), and prints
in how many slices limb, tibia and fibula were found.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pyvista as pv

from limbfit.anatomy.imaging import LabelMap, Volume, read_labels, read_volume
from limbfit.anatomy.surfaces.surfaces import Anatomy, load_anatomy

COLOURS = {"limb": "#e34a33", "tibia": "#3bb2d0", "fibula": "#f4c542"}


def draw_slices(volume: Volume, labels: LabelMap, file: Path) -> None:
    """Contours over slices, posterior down; the last slices, where noise rises, all shown."""
    masks = {"limb": labels.limb, "tibia": labels.mask("tibia"), "fibula": labels.mask("fibula")}
    rows, columns = (np.flatnonzero(labels.limb.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    window = (slice(rows[0] - 4, rows[-1] + 5), slice(columns[0] - 4, columns[-1] + 5))
    shown = [*range(0, 50, 5), *range(50, 56, 1)]
    figure, axes = plt.subplots(4, 4, figsize=(8, 6.6))
    brightest = np.percentile(volume.array, 99.5)
    for axis, k in zip(axes.flat, shown):
        axis.imshow(volume.array[k][window], cmap="gray", vmax=brightest)
        for name, mask in masks.items():
            axis.contour(mask[k][window], [0.5], colors=COLOURS[name], linewidths=0.7)
        axis.set_title(f"slice {k + 1}", fontsize=7, pad=2)
        axis.axis("off")
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.96, 0.03, 0.12)
    figure.savefig(file, dpi=72)
    plt.close(figure)


def draw_surfaces(anatomy: Anatomy, file: Path) -> None:
    """The stump from the front and from the lateral side."""
    plotter = pv.Plotter(off_screen=True, shape=(1, 2), window_size=(900, 560), border=False)
    centre = anatomy.skin.points.mean(axis=0)
    for column, view in enumerate(((0.0, -1.0, 0.15), (-1.0, -0.1, 0.15))):
        plotter.subplot(0, column)
        plotter.add_mesh(anatomy.skin.to_pyvista(), color="#d9a38f", opacity=0.45, smooth_shading=True)
        for bone in anatomy.bones.values():
            plotter.add_mesh(bone.to_pyvista(), color="#f2e3c6", smooth_shading=True)
        plotter.camera_position = [centre + 480 * np.array(view), centre, (0, 0, 1)]
    plotter.screenshot(file)
    plotter.close()


def main(study: Path, pictures: Path) -> None:
    volume = read_volume(study / "mri")
    labels = read_labels(study / "results" / "segment" / "labels.seg.nrrd", volume)
    anatomy = load_anatomy(study / "results" / "surfaces")
    draw_slices(volume, labels, pictures / "slices.png")
    draw_surfaces(anatomy, pictures / "surfaces.png")
    for name, mask in (("limb", labels.limb), *((n, labels.mask(n)) for n in labels.bone_names)):
        found = int(mask.any(axis=(1, 2)).sum())
        print(f"{name}: {found} of {len(mask)} slices, {mask.sum() * labels.voxel_mm3 / 1000:.1f} cm3")
    for name, surface in (("stump", anatomy.skin), *anatomy.bones.items()):
        print(f"{name}: {len(surface.faces)} triangles, {surface.volume / 1000:.1f} cm3")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python pictures.py STUDY_FOLDER PICTURES_FOLDER")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
