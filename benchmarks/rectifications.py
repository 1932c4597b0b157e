"""Can sockets of random rectifications be put on and loaded?

    python benchmarks/rectifications.py --cases 20 --json rectifications.json
    python benchmarks/rectifications.py --only mean/3 phantom/12

Two limbs: the true surfaces of the synthetic patient (``phantom``, seed 0) and the mean of 33 residual
limbs (``mean``, ``data/residuum`` of the folder ``--shared``).  Each is meshed once, with edges of 16 mm
under a liner of 6 mm.  A case draws a reduction of 0 to 6 % and three round areas, -4 (relief) to 6 mm deep,
20 to 40 mm in radius, with their middles anywhere on the limb 15 mm or more below the brim.  That socket
grows on in 2 s and is loaded by 800 N of single stance in 1 s, with tissues of people and friction 0.5;
nothing is held, which costs half of the steps.

A case follows from the seed, its limb and its number alone.  Its outcome is ``completed``, ``refused`` (no
such face can be drawn) or ``stopped`` (the simulation did not come to its end), with the words of limbfit.
Cases in the file of ``--json`` are not run again.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from foreign_meshes import named_bodies

import limbfit
from limbfit.anatomy.surfaces.surfaces import Surface, write_surface
from limbfit.errors import InputError, RunError
from limbfit.execution import SerialExecutor
from limbfit.mesh import Mesh
from limbfit.phantom.geometry import build_true_anatomy, make_limb
from limbfit.pipeline.commands.planning import choose_tissues
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.socket.shape import build_socket
from limbfit.pipeline.socket.simulation import SocketLimb, SocketRun, solve_run, summarise_run
from limbfit.socket import Socket
from limbfit.study.socket import SocketAreaTable

LIMBS = ("phantom", "mean")
SHARED = Path(__file__).parents[1] / ".." / "shared"
EDGE_MM = 16.0
REDUCTION_PERCENT, DEPTH_MM, RADIUS_MM, AREAS = (0.0, 6.0), (-4.0, 6.0), (20.0, 40.0), 3
BELOW_BRIM_MM = 15.0
STUDY = """
[study]
name = "{name}"
[surfaces]
skin = "skin.stl"
bones = {{ {bones} }}
{cut}
[[sites]]
name = "1"
position = [{at}]
depth_mm = 5.0
[socket]
edge_mm = {edge:g}
reduction_percent = 0.0
hold_s = 0.0
[[socket.loads]]
name = "single stance"
preset = "single stance"
hold_s = 0.0
"""


@dataclass(frozen=True)
class Bench:
    """A limb that is meshed, and its socket without rectification."""

    name: str
    study: limbfit.Study
    limb: SocketLimb
    mesh: Mesh
    plain: Socket


def write_study(name: str, folder: Path, shared: Path) -> None:
    """The surfaces of a limb, and a study of them."""
    cut = ""
    if name == "phantom":
        anatomy = build_true_anatomy(make_limb(0))
        skin, bones = anatomy.skin, dict(anatomy.bones)
        point, normal = anatomy.cut_point.tolist(), anatomy.cut_normal.tolist()
        cut = f"[geometry]\nproximal_cut = {{ point = {point}, normal = {normal} }}"
    else:
        bones = named_bodies(shared / "data" / "residuum" / "openlimb_mean.stl")
        skin = bones.pop("skin")
    folder.mkdir(parents=True, exist_ok=True)
    for part, surface in {"skin": skin, **bones}.items():
        write_surface(folder / f"{part}.stl", surface)
    listed = ", ".join(f'{part} = "{part}.stl"' for part in bones)
    at = ", ".join(f"{x:.2f}" for x in _lowest(skin))
    text = STUDY.format(name=name, bones=listed, cut=cut, at=at, edge=EDGE_MM)
    (folder / "study.toml").write_text(text)


def _lowest(skin: Surface) -> np.ndarray:
    """A point for the site that a study must have; nothing is indented."""
    return skin.points[skin.points[:, 2].argmin()]


def bench_of(name: str, folder: Path, shared: Path) -> Bench:
    """The limb of a name, meshed in its folder, or as found there."""
    if not (folder / "study.toml").is_file():
        write_study(name, folder, shared)
    study = limbfit.load_study(folder)
    limbfit.run_study(study, until="surfaces")
    context = Context(study, Store(study.results), SerialExecutor(), ignore_progress)
    limb = SocketLimb.from_store(study, context.store, print)
    plain = build_socket(study, limb.anatomy, limb.outer.skin)
    return Bench(name, study, limb, limb.mesh(folder, plain, print)[0], plain)


def drawn(bench: Bench, seed: int, case: int) -> limbfit.Study:
    """The study with the case's rectification."""
    random = np.random.default_rng([seed, LIMBS.index(bench.name), case])
    face, brim = bench.plain.surface, bench.plain.points[bench.plain.brim]
    middles = face.triangles.mean(axis=1)
    apart = np.linalg.norm(middles[:, None] - brim[None], axis=2).min(axis=1)
    share = np.where(apart > BELOW_BRIM_MM, face.face_areas, 0.0)
    reduction = float(random.uniform(*REDUCTION_PERCENT))
    areas = []
    for number in range(AREAS):
        at = middles[random.choice(len(middles), p=share / share.sum())]
        radius, depth = random.uniform(*RADIUS_MM), random.uniform(*DEPTH_MM)
        areas.append(
            SocketAreaTable(
                name=f"area {number + 1}", position=tuple(at.tolist()), radius_mm=radius, depth_mm=depth
            )
        )
    table = bench.study.socket.model_copy(update={"reduction_percent": reduction, "areas": tuple(areas)})
    return bench.study.model_copy(update={"socket": table})


def run(bench: Bench, seed: int, case: int) -> dict[str, Any]:
    """What became of a case."""
    study = drawn(bench, seed, case)
    table = study.socket
    row: dict[str, Any] = {
        "limb": bench.name,
        "case": case,
        "reduction_percent": table.reduction_percent,
        "areas": [area.model_dump(include={"position", "radius_mm", "depth_mm"}) for area in table.areas],
    }
    limb, started = replace(bench.limb, study=study), time.process_time()

    def told(time_s: float, end_s: float, words: str) -> None:
        print(f"  {words}", flush=True)

    try:
        socket = build_socket(study, limb.anatomy, limb.outer.skin)
    except InputError as error:
        return row | {"outcome": "refused", "words": error.what}
    row["deepest_mm"] = float(socket.offset(limb.outer.skin).max())
    donned = SocketRun("", limb.build_model(socket, bench.mesh), choose_tissues(study)[0])
    try:
        found = solve_run(donned, told)
    except RunError as error:
        return row | {
            "outcome": "stopped",
            "words": str(error),
            "cpu_s": round(time.process_time() - started, 1),
        }
    facts = summarise_run(donned, found)
    (load,) = facts["loads"]
    return row | {
        "outcome": "completed",
        "cpu_s": round(time.process_time() - started, 1),
        **facts["statistics"],
        "settling_mm": load["settling_mm"],
        "donned_peak_kPa": facts["donning"]["peak_kPa"],
        "peak_kPa": load["peak_kPa"],
        "balance_percent": facts["balance_percent"],
        "warnings": facts["warnings"],
    }


def line(row: dict[str, Any]) -> str:
    begin = f"{row['limb']}/{row['case']}: {row['outcome']}"
    if row["outcome"] != "completed":
        return f"{begin}: {row['words']}"
    return (
        f"{begin}, {row['cpu_s']:.0f} CPU s, {row['newton_iterations']} iterations in {row['steps']} steps, "
        f"{row['cuts']} cuts; settled by {row['settling_mm']:.1f} mm, peak {row['peak_kPa']:.0f} kPa"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cases", type=int, default=20, help="of each limb")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[], help="these alone, such as mean/3")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/rectifications"), help="of limbs and meshes"
    )
    parser.add_argument("--shared", type=Path, default=SHARED, help="the folder with data/residuum")
    parser.add_argument("--json", type=Path, help="write every case here; those found there are kept")
    asked = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if asked.json is not None and asked.json.exists():
        kept = json.loads(asked.json.read_text())
        if kept["seed"] != asked.seed:
            parser.error(f"{asked.json} holds cases of the seed {kept['seed']}; name another file")
        rows = kept["cases"]
    known = {f"{row['limb']}/{row['case']}" for row in rows}
    wanted = asked.only or [f"{limb}/{case}" for case in range(asked.cases) for limb in LIMBS]
    benches: dict[str, Bench] = {}
    for name in wanted:
        if name in known:
            continue
        limb, _, case = name.partition("/")
        if limb not in benches:
            benches[limb] = bench_of(limb, asked.folder / limb, asked.shared)
        rows.append(run(benches[limb], asked.seed, int(case)))
        print(line(rows[-1]), flush=True)
        if asked.json is not None:
            asked.json.write_text(json.dumps({"seed": asked.seed, "cases": rows}, indent=1) + "\n")
    for row in rows:
        print(line(row))
    return int(any(row["outcome"] == "stopped" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
