"""Make one of the limbs of `everything.py` as a study folder, with records.

    python benchmarks/everything_limbs.py LIMB FOLDER [--phantom FOLDER] [--shared FOLDER]

Real limbs, and the thigh of surfaces, were never indented: four sites are drawn on the skin, `limbfit
simulate` indents them with the phantom's tissues, and what the robot would have written of that, with its
noise, becomes their records. ``labels`` and ``surfaces`` are the phantom of seed 0, in ``--phantom``, as it
comes from another program: its image with a label map in NIfTI, and the surfaces that limbfit itself stored.
"""

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from foreign_meshes import named_bodies
from numpy.typing import NDArray
from site_meshes import (
    CALF_PAD_MM,
    CALF_PLANE,
    INDENTER_MM,
    draw_random_sites,
    make_amputated_calf,
)

from limbfit.anatomy.imaging import LabelMap, write_labels
from limbfit.anatomy.sites.sites import measure_tissue_under
from limbfit.anatomy.surfaces.mending import build_closed_anatomy
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface, write_surface
from limbfit.phantom.build import draw_true_parameters
from limbfit.phantom.geometry import extract_contour, make_limb
from limbfit.phantom.mri import build_true_labels, make_grid
from limbfit.phantom.robot import Ramp, record

Array = NDArray[np.floating]

SHARED = Path(__file__).parents[1] / ".." / "shared"
SITES, FITTED, SEED = 4, 3, 0
DEEPEST_MM, SHARE, SPEED_MM_S = 6.0, 0.3, 0.96
THIGH_MM, FOREIGN_VALUE = 220.0, 10  # the thigh's length; the foreign map counts in tens


def thigh_bodies() -> dict[str, Surface]:
    """Skin and femur of a thigh cut above the knee: two round bodies along z, mm; both end in the cut."""

    def skin(p: Array) -> Array:
        return _rod(p, 0.0, 0.0, 55.0, 55.0 + 0.08 * p[..., 2])

    def femur(p: Array) -> Array:
        return _rod(p, 8.0, -4.0, 45.0, np.full(p.shape[:-1], 14.0))

    cut, out = THIGH_MM, THIGH_MM + 6.0
    return {
        "skin": extract_contour(skin, (-85.0, -85.0, -10.0), (85.0, 85.0, cut), 3.0),
        "femur": extract_contour(femur, (-30.0, -30.0, 20.0), (40.0, 30.0, out), 2.0),
    }


def _rod(p: Array, x: float, y: float, end: float, radius: Array) -> Array:
    """About the distance to a rod along z from ``end`` with a round tip; negative inside."""
    below = np.minimum(p[..., 2] - end, 0.0)
    return np.sqrt((p[..., 0] - x) ** 2 + (p[..., 1] - y) ** 2 + below**2) - radius


def write_bodies(folder: Path, parts: Mapping[str, Surface]) -> tuple[str, Anatomy]:
    """The bodies as STL; the study's head that names them, and what limbfit makes of them."""
    for name, surface in parts.items():
        write_surface(folder / f"{name}.stl", surface)
    bones = {name: surface for name, surface in parts.items() if name != "skin"}
    listed = ", ".join(f'{name} = "{name}.stl"' for name in bones)
    return f'[surfaces]\nskin = "skin.stl"\nbones = {{ {listed} }}\n', build_closed_anatomy(
        parts["skin"], bones
    )[0]


def write_calf(folder: Path, source: Path) -> tuple[str, Anatomy]:
    """The slices of the intact leg; the study's head that amputates it, and what limbfit makes of it."""
    shutil.copytree(source, folder / "mri")
    point, normal = (list(part) for part in CALF_PLANE)
    head = f'[image]\npath = "mri"\n\n[geometry]\namputation = {{ point = {point}, normal = {normal} }}\n'
    return f"{head}amputation_pad_mm = {CALF_PAD_MM}\n", make_amputated_calf(source)


def plan_sites(anatomy: Anatomy) -> list[dict[str, Any]]:
    """Sites on the skin, indented by a share of the tissue over bone."""
    return [
        {
            "name": str(i + 1),
            "region": f"quarter {i + 1}",
            "position": np.round(position, 2).tolist(),
            "depth_mm": round(
                min(DEEPEST_MM, SHARE * measure_tissue_under(anatomy, position, axis, INDENTER_MM)), 2
            ),
        }
        for i, (position, axis) in enumerate(draw_random_sites(anatomy, SITES, SEED))
    ]


def write_study(folder: Path, name: str, head: str, sites: list[dict[str, Any]]) -> None:
    text = f'[study]\nname = "{name}"\n\n{head}'
    for site in sites:
        text += "\n[[sites]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in site.items())
    (folder / "study.toml").write_text(text, encoding="utf-8")


def record_sites(folder: Path, name: str, head: str, sites: list[dict[str, Any]]) -> None:
    """Indent the planned sites by simulation, and make the robot's records of them the study's own."""
    write_study(folder, name, head, sites)
    truth = draw_true_parameters(SEED)
    values = ",".join(f"{value:g}" for tissue in truth.values() for value in tissue.values())
    recorded = []
    for i, site in enumerate(sites):
        ask_limbfit("simulate", str(folder), "--site", site["name"], "--parameters", values)
        curve = np.genfromtxt(
            folder / "results" / "simulate" / f"{site['name']}.csv", delimiter=",", names=True
        )
        force = partial(np.interp, xp=curve["time_s"], fp=curve["force_N"])
        made = record(Ramp(site["depth_mm"], SPEED_MM_S), force, np.random.default_rng([SEED, i]))
        made.write(folder / f"site-{site['name']}.csv")
        own = {key: value for key, value in site.items() if key != "depth_mm"}
        recorded.append(own | {"fitted": i < FITTED, "trace": f"site-{site['name']}.csv"})
    write_study(folder, name, head, recorded)
    (folder / "truth.json").write_text(json.dumps({"parameters": truth}, indent=1), encoding="utf-8")


def ask_limbfit(*words: str) -> None:
    """One command of limbfit; its refusal or failure is this script's."""
    done = subprocess.run([sys.executable, "-m", "limbfit", *words])
    if done.returncode:
        sys.exit(done.returncode)


def map_labels(folder: Path, phantom: Path) -> None:
    """The phantom with its true labels as another program writes them: NIfTI, values and names of its own."""
    shutil.copytree(phantom / "mri", folder / "mri")
    shutil.copytree(phantom / "traces", folder / "traces")
    limb = make_limb(SEED)
    own = build_true_labels(limb, make_grid(limb, "coarse", SEED))
    names = {FOREIGN_VALUE * value: name for value, name in own.names.items()}
    foreign = LabelMap(FOREIGN_VALUE * own.array, own.spacing, own.origin, own.direction, names)
    write_labels(folder / "labels.nii.gz", foreign)
    text = (phantom / "study.toml").read_text(encoding="utf-8")
    text = text.replace("[geometry]", '[segmentation]\nlabels = "labels.nii.gz"\n\n[geometry]', 1)
    (folder / "study.toml").write_text(text, encoding="utf-8")


def read_back(folder: Path, phantom: Path) -> None:
    """The surfaces that limbfit stored of the phantom, nothing else of its anatomy, and its records."""
    ask_limbfit("run", str(phantom), "--until", "sites")
    stored = phantom / "results" / "surfaces"
    bones = {}
    for file in sorted(stored.glob("*.stl")):
        shutil.copyfile(file, folder / file.name)
        if file.stem.startswith("bone-"):
            bones[file.stem.removeprefix("bone-")] = file.name
    shutil.copytree(phantom / "traces", folder / "traces")
    fitted = {site["name"]: site for site in json.loads((phantom / "truth.json").read_text())["sites"]}
    listed = ", ".join(f'{name} = "{file}"' for name, file in bones.items())
    sites = [
        {
            "name": site["site"],
            "region": fitted[site["site"]]["region"],
            "fitted": fitted[site["site"]]["fitted"],
            "trace": f"traces/site-{site['site']}.csv",
            "position": site["position_mm"],
        }
        for site in json.loads((phantom / "results" / "sites" / "sites.json").read_text())["sites"]
    ]
    write_study(folder, "surfaces", f'[surfaces]\nskin = "skin.stl"\nbones = {{ {listed} }}\n', sites)


def makers(shared: Path, phantom: Path) -> dict[str, Callable[[Path], None]]:
    """Name and maker of every limb that is no phantom."""
    data = shared / "data"
    stl = {f"limb-{i}": data / "limbs" / f"limb-{i}.stl" for i in (1, 9)}
    stl["openlimb"] = data / "residuum" / "openlimb_mean.stl"

    def recorded(name: str, write: Callable[[Path], tuple[str, Anatomy]]) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            head, anatomy = write(folder)
            record_sites(folder, name, head, plan_sites(anatomy))

        return make

    return {
        "thigh-surfaces": recorded("thigh", lambda folder: write_bodies(folder, thigh_bodies())),
        **{
            name: recorded(name, lambda folder, file=file: write_bodies(folder, named_bodies(file)))  # type: ignore[misc]
            for name, file in stl.items()
        },
        "calf": recorded("calf", lambda folder: write_calf(folder, data / "calf-mri")),
        "labels": lambda folder: map_labels(folder, phantom),
        "surfaces": lambda folder: read_back(folder, phantom),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("limb")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--phantom", type=Path, default=Path("phantom-0"), help="that of seed 0")
    parser.add_argument("--shared", type=Path, default=SHARED, help="the folder with data/")
    given = parser.parse_args()
    known = makers(given.shared, given.phantom)
    if given.limb not in known:
        parser.error(f"no limb is named {given.limb!r}; there are {', '.join(known)}")
    shutil.rmtree(given.folder, ignore_errors=True)
    given.folder.mkdir(parents=True)
    known[given.limb](given.folder)


if __name__ == "__main__":
    main()
