"""How far from the truth are sites that are found by skin markers?

    python benchmarks/markers.py --seeds 20 --coarseness 2 --json markers.json
    python benchmarks/markers.py --seeds 3 --coarseness 1

Every seed is a synthetic limb with 18 markers, scanned without and with them; between the scans it moves by
up to 5 mm and turns by up to 3 degrees.  Both ways to find markers are measured: with two images, and with
the one that has the markers on.  ``--coarseness`` is the size of voxels over the paper's
(1.18 x 1.15 x 1.00 mm).
"""

import argparse
import json
import resource
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from limbfit.anatomy.imaging import LabelMap, Volume
from limbfit.anatomy.sites.marked import extract_marked_skin, register_limb, remove_markers
from limbfit.anatomy.sites.sites import Marker, find_markers, match_markers
from limbfit.anatomy.surfaces.surfaces import Surface, build_anatomy
from limbfit.errors import SiteError
from limbfit.phantom.geometry import Limb, build_rotation, make_limb
from limbfit.phantom.mri import ScanGrid, make_grid
from limbfit.phantom.robot import TrueSite, build_markers, build_true_sites
from scanned import build_image

SHIFT_MM, TURN_DEG = 5.0, 3.0
EDGE_MM = 3.0


def moved(limb: Limb, seed: int) -> Limb:
    """The limb after a motion drawn evenly from a ball of 5 mm and one of 3 degrees."""
    random = np.random.default_rng([seed, 10])
    axis, way = random.normal(size=3), random.normal(size=3)
    turn, shift = np.cbrt(random.uniform(size=2)) * (np.deg2rad(TURN_DEG), SHIFT_MM)
    return limb.move(build_rotation(axis, turn), shift * way / np.linalg.norm(way))


def coarser(grid: ScanGrid, factor: float) -> ScanGrid:
    """The same box in larger voxels."""
    size = np.array(grid.shape[::-1])
    spacing = np.array(grid.spacing) * factor
    fewer = np.rint(size / factor).astype(int)
    middle = grid.origin + grid.direction @ (np.array(grid.spacing) * (size - 1) / 2)
    k, j, i = (int(n) for n in fewer[::-1])
    x, y, z = (float(s) for s in spacing)
    return ScanGrid(
        (k, j, i), (x, y, z), middle - grid.direction @ (spacing * (fewer - 1) / 2), grid.direction
    )


def skin_of(volume: Volume) -> tuple[Surface, NDArray[np.bool_]]:
    """The model's skin of an image without markers, and the limb's mask; bones do not matter here."""
    limb = extract_marked_skin(volume)[1]
    labels = LabelMap(limb.astype(np.uint8), volume.spacing, volume.origin, volume.direction)
    return build_anatomy(labels, EDGE_MM).skin, limb


def measured(found: Sequence[Marker], sites: Sequence[TrueSite]) -> dict[str, Any]:
    """Distances from the true sites, mm, by name; ``refused`` says why the markers were not matched."""
    try:
        matched = match_markers(found, {site.name: site.hint for site in sites})
    except SiteError as error:
        return {"found": len(found), "refused": str(error), "errors_mm": {}}
    errors = {s.name: float(np.linalg.norm(matched[s.name].position - s.position)) for s in sites}
    return {"found": len(found), "refused": None, "errors_mm": errors}


def measure(seed: int, coarseness: float) -> dict[str, Any]:
    """Both ways for one seed; processor seconds do not count the making of the images."""
    limb = make_limb(seed)
    second = moved(limb, seed)
    grid = coarser(make_grid(limb, "paper", seed), coarseness)
    sites, moved_sites = build_true_sites(limb, seed), build_true_sites(second, seed)
    plain = build_image(limb, grid, seed=seed)
    marked = build_image(second, grid, build_markers(moved_sites), seed=seed)
    start = _seconds()
    skin, mask = skin_of(plain)
    outline = extract_marked_skin(marked)[0]
    motion = register_limb(plain, marked, mask)
    two = find_markers(replace(outline, points=motion.apply(outline.points)), skin)
    between = _seconds()
    outline = extract_marked_skin(marked)[0]
    cleaned, _ = remove_markers(marked, outline)
    one = find_markers(outline, skin_of(cleaned)[0])
    back = motion.apply(np.array([site.position for site in moved_sites]))
    truth = np.array([site.position for site in sites])
    return {
        "seed": seed,
        "motion_error_mm": float(np.linalg.norm(back - truth, axis=1).max()),
        "two images": measured(two, sites) | {"cpu_s": round(between - start, 1)},
        "one image": measured(one, moved_sites) | {"cpu_s": round(_seconds() - between, 1)},
    }


def _seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def told(row: dict[str, Any], way: str) -> str:
    errors = list(row[way]["errors_mm"].values())
    if not errors:
        return f"{way}: {row[way]['refused']}"
    return f"{way}: {row[way]['found']} markers, mean {np.mean(errors):.2f} mm, largest {max(errors):.2f} mm"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="how many limbs")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--coarseness", type=float, default=2.0, help="voxel size over the paper's")
    parser.add_argument("--json", type=Path, help="also write every error there")
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.seeds):
        rows.append(measure(seed, options.coarseness))
        print(f"seed {seed}: {told(rows[-1], 'two images')}; {told(rows[-1], 'one image')}", flush=True)
    largest = 0.0
    for way in ("two images", "one image"):
        errors = np.array([e for row in rows for e in row[way]["errors_mm"].values()])
        refused = sum(row[way]["refused"] is not None for row in rows)
        largest = max(largest, float(errors.max(initial=0.0)), np.inf if refused else 0.0)
        cpu = np.mean([row[way]["cpu_s"] for row in rows])
        print(
            f"{way}: {len(errors)} sites, mean {errors.mean():.2f} mm, 95 % below "
            f"{np.percentile(errors, 95):.2f} mm, largest {errors.max():.2f} mm; {refused} limbs refused; "
            f"{cpu:.1f} CPU s each"
        )
    print(f"motion found to {max(row['motion_error_mm'] for row in rows):.2f} mm at the sites")
    if options.json:
        options.json.write_text(json.dumps({"coarseness": options.coarseness, "limbs": rows}, indent=1))
    return 0 if largest < 1.0 else 1


if __name__ == "__main__":
    sys.exit(main())
