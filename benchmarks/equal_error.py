"""The time that limbfit and FEBio need for the same error of the largest force, each with its best element.

The posterior and the tibial site of ``convergence.py``, on meshes of decreasing size: limbfit with its
default element, steps and contact; FEBio itself with quadratic tetrahedra and the settings of limbfit's
export, on as many threads, one after the other. The error is that against the limit which `convergence.py`
found from both sides. Where no mesh of FEBio's comes so near, its longest run is a lower bound of its time.

    python benchmarks/equal_error.py FOLDER --site posterior --limbfit 6 4.5 3.5 --febio 3.5 --threads 2

FEBio is that of FEBIO_CMD, of the path, or beside the repository. Runs are kept in FOLDER and not done twice.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from convergence import SITES, Run, complete, in_own_process, make_mesh, problem_of

from limbfit.bench.parity import find_reference
from limbfit.febio import (
    FebSettings,
    build_result,
    compute_end_time,
    find_febio,
    read_log,
    run_febio,
    turn_to_indenter_frame,
    write_feb,
)
from limbfit.mesh import read_vtu

LIMITS_N = {"posterior": 3.98, "tibia": 5.98}  # docs/convergence.md
GOALS_PERCENT = (2.0, 1.0)


def run_febio_on(program: Path, run: Run, study: Path, folder: Path, limit_s: float) -> dict[str, Any]:
    """FEBio's largest force on the mesh of a run, N, and its seconds by the clock."""
    file = folder / run.mesh_name
    if not file.is_file():
        in_own_process(make_mesh, run, study, file)
    problem = turn_to_indenter_frame(problem_of(run, study, read_vtu(file)))
    with tempfile.TemporaryDirectory(prefix="limbfit-equal-") as scratch:
        place = Path(scratch)
        write_feb(problem, place / "model.feb", FebSettings())
        done = run_febio(
            program, place, compute_end_time(problem), "forces.txt", threads=run.threads, time_limit_s=limit_s
        )
        log = read_log(place / "forces.txt") if done.verdict.is_completed else None
    peak = None if log is None else float(build_result(problem, log, done.verdict, done.seconds).peak_force)
    return {
        "site": run.site,
        "size_mm": run.size_mm,
        "nodes": int(problem.mesh.points.shape[0]),
        "seconds": done.seconds,
        "peak_force_N": peak,
        "stopped": "" if done.verdict.is_completed else done.verdict.reason,
    }


def tell_times(site: str, ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> None:
    """Each run with its error, and the shortest time of each program within each goal."""
    limit = LIMITS_N[site]
    best: dict[tuple[str, float], float] = {}
    for name, rows in (("limbfit", ours), ("FEBio", theirs)):
        for row in rows:
            peak, seconds = row["peak_force_N"], row["seconds"]
            error = None if peak is None else 100.0 * (peak / limit - 1.0)
            said = row.get("stopped") or f"{peak:.4f} N, {error:+.2f} %"
            print(f"{site}, {name}, {row['size_mm']:g} mm, {row['nodes']} nodes: {seconds:.1f} s, {said}")
            for goal in GOALS_PERCENT:
                if error is not None and abs(error) <= goal:
                    best[name, goal] = min(seconds, best.get((name, goal), seconds))
    longest = max((row["seconds"] for row in theirs), default=0.0)
    for goal in GOALS_PERCENT:
        own, other = best.get(("limbfit", goal)), best.get(("FEBio", goal))
        if own is None:
            print(f"{site}: limbfit is not within {goal:g} %")
        elif other is None:
            print(
                f"{site}, within {goal:g} %: limbfit {own:.1f} s, FEBio over {longest:.0f} s: "
                f"over {longest / own:.0f}"
            )
        else:
            print(f"{site}, within {goal:g} %: limbfit {own:.1f} s, FEBio {other:.1f} s: {other / own:.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="of meshes and runs")
    parser.add_argument("--site", choices=SITES, default="posterior")
    parser.add_argument("--limbfit", type=float, nargs="*", default=[], help="sizes, mm", metavar="MM")
    parser.add_argument("--febio", type=float, nargs="*", default=[], help="sizes, mm", metavar="MM")
    parser.add_argument("--element", default="tet10p0", help="limbfit's")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--limit-s", type=float, default=1800.0, help="of one run of FEBio")
    parser.add_argument(
        "--reference", type=Path, help="folder of FEBio's results (default: shared/reference)"
    )
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    study = (chosen.reference or find_reference(Path.cwd())) / "openlimb-study"
    kept, febio_kept = chosen.folder / "runs.json", chosen.folder / "febio.json"
    rows = json.loads(kept.read_text()) if kept.is_file() else []
    theirs = json.loads(febio_kept.read_text()) if febio_kept.is_file() else []
    wanted = [Run(chosen.site, chosen.element, size, threads=chosen.threads) for size in chosen.limbfit]
    complete(rows, wanted, study, chosen.folder)
    done = {(row["site"], row["size_mm"]) for row in theirs}
    for size in chosen.febio:
        if (chosen.site, size) not in done:
            run = Run(chosen.site, "tet10", size, threads=chosen.threads)
            theirs.append(run_febio_on(find_febio(), run, study, chosen.folder, chosen.limit_s))
            febio_kept.write_text(json.dumps(theirs, indent=1))
    of_site = [[row for row in one if row["site"] == chosen.site] for one in (rows, theirs)]
    tell_times(chosen.site, *of_site)


if __name__ == "__main__":
    main()
