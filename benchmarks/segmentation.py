"""How far are the automatic segmentation and its surfaces from a phantom's truth?

    python benchmarks/segmentation.py --seeds 0 1 2 3 4 5 6 7 8 9 --json segmentation.json
    python benchmarks/segmentation.py --detail coarse --seeds 0          # a quick look
    python benchmarks/segmentation.py --voxels 2 1 0.5 --contrast CT     # how time and memory grow

Each seed is another limb in an image of the paper's resolution and noise. Surface errors are distances (mm)
of the triangulated surfaces' vertices to the implicit truth, at least 3 mm distal of the proximal cut; Dice
is over voxels whose centres lie inside. One process and one thread; seconds are CPU seconds.

With ``--voxels`` (mm) one limb is imaged in a field of 256 x 256 x 300 mm, which 0.5 mm make 512 x 512 x 600
voxels, and only cost is measured: of the check for one limb, labels, surfaces, and the facts about labels.
The largest memory is that of the process so far, so voxels go from large to small.
"""

import argparse
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk  # noqa: N813

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from limbfit.anatomy.grid import BONES, FAT, LabelMap
from limbfit.anatomy.labels.labelcheck import assess_labels
from limbfit.anatomy.segmentation.body import check_one_limb
from limbfit.anatomy.segmentation.segmentation import segment
from limbfit.anatomy.surfaces.surfaces import Anatomy, build_anatomy
from limbfit.phantom.geometry import Limb, build_true_anatomy, compute_gradient, make_limb
from limbfit.phantom.mri import CONTRASTS, DETAIL_GRIDS, ScanGrid, make_grid
from scanned import build_image

BELOW_CUT_MM = 3.0
FIELD_MM = np.array([300.0, 256.0, 256.0])  # k, j, i


def dice(a: np.ndarray, b: np.ndarray) -> float:
    return 2 * float((a & b).sum()) / max(float(a.sum() + b.sum()), 1.0)


def distances(points: np.ndarray, field: Any) -> np.ndarray:
    """First-order distances (n,) of points to the zero surface of a field, mm."""
    slopes = np.linalg.norm(compute_gradient(field, points), axis=-1)
    return np.abs(field(points)) / slopes


def truth_masks(limb: Limb, labels: LabelMap) -> dict[str, np.ndarray]:
    """``[k, j, i]`` inside skin, fat and bones, slice by slice to save memory."""
    j, i = np.mgrid[: labels.size[1], : labels.size[0]]
    masks = {name: np.zeros(labels.array.shape, dtype=bool) for name in ("limb", FAT, *BONES)}
    for k in range(labels.size[2]):
        points = labels.index_to_point(np.stack([i, j, np.full(i.shape, k)], axis=-1))
        depth = -limb.skin(points)
        masks["limb"][k] = depth > 0
        masks[FAT][k] = (depth > 0) & (depth < limb.layers_mm)
        for name in BONES:
            masks[name][k] = limb.bone(name, points) < 0
    return masks


def surface_errors(anatomy: Anatomy, limb: Limb) -> dict[str, dict[str, float]]:
    """RMS and 95th percentile of the found surfaces' distance to the truth, and of the truth's to them."""
    true = build_true_anatomy(limb, 3.0)
    fields = {"skin": limb.skin} | {
        name: lambda p, name=name: limb.bone(name, p)
        for name in BONES  # type: ignore[misc]
    }
    found = {"skin": anatomy.skin, **anatomy.bones}
    truth = {"skin": true.skin, **true.bones}
    errors = {}
    for name, field in fields.items():
        if name not in found:
            continue
        points = found[name].points
        points = points[anatomy.height(points) < -BELOW_CUT_MM]
        off = distances(points, field)
        there = truth[name].points
        low = (anatomy.height(there) < -BELOW_CUT_MM) & (
            (there - true.cut_point) @ true.cut_normal < -BELOW_CUT_MM
        )
        back = np.abs(found[name].signed_distance(there[low]))
        errors[name] = {
            "rms_mm": float(np.sqrt(np.mean(off**2))),
            "p95_mm": float(np.percentile(off, 95)),
            "back_rms_mm": float(np.sqrt(np.mean(back**2))),
        }
    return errors


def cover_field(limb: Limb, voxel_mm: float, seed: int) -> ScanGrid:
    """Cubic voxels in the whole field, which lies as the scanner's box does."""
    box = make_grid(limb, "paper", seed)
    shape = np.round(FIELD_MM / voxel_mm).astype(int)
    half = (np.array(box.shape) - 1)[::-1] / 2 * box.spacing - (shape - 1)[::-1] / 2 * voxel_mm
    size = (int(shape[0]), int(shape[1]), int(shape[2]))
    return ScanGrid(size, (voxel_mm,) * 3, box.origin + box.direction @ half, box.direction)


def measure_cost(voxel_mm: float, contrast: str, seed: int) -> dict[str, Any]:
    """CPU seconds of each step and the largest memory (GB) until its end."""
    limb = make_limb(seed)
    image = build_image(limb, cover_field(limb, voxel_mm, seed), seed=seed, levels=CONTRASTS[contrast])
    row: dict[str, Any] = {"voxel_mm": voxel_mm, "contrast": contrast, "seed": seed, "shape": image.size}
    start, begun = time.process_time(), time.perf_counter()

    def note(step: str) -> None:
        nonlocal start
        row[f"{step}_cpu_s"] = round(time.process_time() - start, 1)
        row[f"{step}_GB"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2, 2)
        start = time.process_time()

    check_one_limb(image)
    note("one_limb")
    labels = segment(image)
    note("segment")
    build_anatomy(labels)
    note("surfaces")
    assess_labels(labels)
    note("quality")
    row["wall_s"] = round(time.perf_counter() - begun, 1)
    return row


def one(detail: str, contrast: str, seed: int) -> dict[str, Any]:
    limb = make_limb(seed)
    image = build_image(limb, make_grid(limb, detail, seed), seed=seed, levels=CONTRASTS[contrast])
    start = time.process_time()
    labels = segment(image)
    labelled = time.process_time()
    anatomy = build_anatomy(labels)
    built = time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    truth = truth_masks(limb, labels)
    found = {name: labels.mask(name) for name in (*labels.bone_names, FAT)} | {"limb": labels.limb}
    return {
        "seed": seed,
        "contrast": contrast,
        "labels": sorted(labels.names.values()),
        "fat_volume_ratio": float(found[FAT].sum() / truth[FAT].sum()),
        "dice": {name: dice(found[name], mask) if name in found else 0.0 for name, mask in truth.items()},
        "surfaces": surface_errors(anatomy, limb),
        "segment_cpu_s": labelled - start,
        "surfaces_cpu_s": built - labelled,
        "peak_GB": peak,
    }


def show(row: dict[str, Any]) -> None:
    errors = " ".join(
        f"{name} {e['rms_mm']:.2f}/{e['back_rms_mm']:.2f}" for name, e in row["surfaces"].items()
    )
    dices = " ".join(f"{name} {value:.3f}" for name, value in row["dice"].items())
    print(
        f"seed {row['seed']}: Dice {dices}; RMS mm {errors}; "
        f"{row['segment_cpu_s']:.0f} + {row['surfaces_cpu_s']:.0f} CPU s; {row['peak_GB']:.1f} GB",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("--detail", choices=list(DETAIL_GRIDS), default="paper")
    parser.add_argument("--contrast", choices=list(CONTRASTS), default="UTE")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--voxels", type=float, nargs="+", default=[], help="mm; measure cost only")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(options.threads)
    rows = []
    for voxel_mm in options.voxels:
        rows.append(measure_cost(voxel_mm, options.contrast, options.seeds[0]))
        print(rows[-1], flush=True)
    for seed in [] if options.voxels else options.seeds:
        rows.append(one(options.detail, options.contrast, seed))
        show(rows[-1])
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
