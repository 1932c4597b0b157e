"""A designed session, recorded by `limbfit acquire` from a virtual FitSocket and identified: end to end.

    python benchmarks/acquired_protocol.py [--folder runs/acquired] [--seed 0] [--minutes 25] [--workers 2]

A synthetic patient's six sites are planned without a record, and `limbfit design --protocol` chooses the
records. The virtual device's limb is simulated on the patient's true surfaces, with other meshes, element and
steps than the study has: a fast ramp, a hold of 30 s and a slow ramp at each site, which the device makes a
force for any history of. `limbfit acquire` makes the records, and `limbfit run` identifies. Told are how many
of the eight parameters are determined, how many intervals hold the true value, and the errors; what is done
is kept in the folder.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import limbfit
from limbfit.execution import SerialExecutor
from limbfit.indentation import to_vector
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.engine.store import Store, read_json, write_curves
from limbfit.pipeline.simulation.limb_geometry import build_site_model
from limbfit.pipeline.simulation.simulations import SimulationCache, build_curve_job

COMMAND = (sys.executable, "-m", "limbfit")
SPEEDS_MM_S, HOLD_S, REST_S = (4.8, 0.96), 30.0, 10.0
BEYOND = 1.15  # of the deepest record of a site, to which the limb is known
FASTER = 50  # than the wall's clock
TRUE_LIMB = """
[study]
name = "the limb in the device"
[surfaces]
{surfaces}
[geometry]
skin_layer_mm = 3.0
{cut}
[indenter]
shape = "square"
width_mm = 20.0
edge_radius_mm = 2.0
[mesh]
edge_near_mm = 3.0
element = "tet10"
[solver]
load_steps = 12
unload_steps = 20
"""
SITE = """
[[sites]]
name = "{name}"
position = {position}
depth_mm = {depth}
fitted = false
"""


def limbfit_says(*words: str) -> str:
    """What a command prints; it must succeed."""
    done = subprocess.run([*COMMAND, *words], check=False, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"limbfit {' '.join(words)}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


def planned(folder: Path, seed: int) -> Path:
    """The patient's study before anybody was indented: sites, and how deep each may be pressed."""
    patient, plan = folder / "patient", folder / "plan"
    if not plan.is_dir():
        limbfit_says("phantom", str(patient), "--seed", str(seed))
        shutil.copytree(patient / "mri", plan / "mri")
        text = (patient / "study.toml").read_text().replace("fitted = true", "fitted = false")

        def depth(found: re.Match[str]) -> str:
            rows = np.loadtxt(patient / found[1], delimiter=",", skiprows=1, usecols=1)
            return f"depth_mm = {np.floor(10 * (rows.max() - rows.min() - 1.5)) / 10:g}"

        (plan / "study.toml").write_text(re.sub(r'trace = "(.+)"', depth, text))
    return plan


def true_limb(folder: Path, plan: Path) -> Path:
    """A study of the true surfaces whose stored simulations the device takes for its limb."""
    place, patient = folder / "device", folder / "patient"
    if (place / "results" / "simulate").is_dir():
        return place
    place.mkdir(exist_ok=True)
    facts = json.loads((patient / "truth" / "surfaces.json").read_text())
    for file in (patient / "truth").glob("*.stl"):
        shutil.copy(file, place)
    bones = ", ".join(f'{name} = "bone-{name}.stl"' for name in facts["bones"])
    text = TRUE_LIMB.format(
        surfaces=f'skin = "skin.stl"\nbones = {{ {bones} }}',
        cut=f"proximal_cut = {{ point = {facts['cut_point']}, normal = {facts['cut_normal']} }}",
    )
    study = limbfit.load_study(plan)
    store = Store(study.results)
    placed = {row["site"]: row for row in read_json(store["sites"] / "sites.json")["sites"]}
    designed = read_json(store["protocol"] / "protocol.json")["records"]
    for site in study.sites:
        depths = [site.depth_mm or 0.0, *(row["depth_mm"] for row in designed if row["site"] == site.name)]
        text += SITE.format(name=site.name, position=placed[site.name]["position_mm"], depth=max(depths))
    (place / "study.toml").write_text(text)
    limb = limbfit.load_study(place)
    limbfit.run_study(limb, until="mesh", listener=ignore_progress)
    context = Context(limb, Store(limb.results), SerialExecutor(), ignore_progress)
    truth = json.loads((patient / "truth.json").read_text())["parameters"]
    jobs = []
    for site in limb.sites:
        depth, times = BEYOND * float(site.depth_mm or 0.0), [0.0]
        fast, slow = (depth / speed for speed in SPEEDS_MM_S)
        for duration in (fast, HOLD_S, fast, REST_S, slow, slow):
            times.append(times[-1] + duration)
        model = build_site_model(context, site, times, [0.0, depth, depth, 0.0, 0.0, depth, 0.0])
        job = build_curve_job(replace(model, name=site.name), limb.tissues, to_vector(truth, limb.tissues))
        fine = np.unique(np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(times)]))
        jobs.append(replace(job, times_s=tuple(map(float, fine))))
    found = SimulationCache(place / "runs").run(jobs, context.executor)
    (place / "results" / "simulate").mkdir()
    for job, one in zip(jobs, found, strict=True):
        if not one.completed:
            raise SystemExit(f"{one.site} could not be simulated: {one.reason}")
        depths = np.interp(job.times_s, job.model.knots_s, job.model.knots_mm)
        write_curves(
            place / "results" / "simulate" / f"{one.site}.csv",
            time_s=np.array(job.times_s), displacement_mm=depths, force_N=one.force_N,
        )  # fmt: skip
    return place


def record(plan: Path, device: Path) -> None:
    """Every record of the plan that is not made yet, from a virtual device of its own."""
    served = subprocess.Popen(
        [*COMMAND, "virtual-fitsocket", str(device), "--port", "0", "--speed", str(FASTER)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert served.stdout is not None
        address = None
        for line in served.stdout:
            print(line, end="", flush=True)
            address = re.search(r"tcp://[\w.:]+", line)
            if address:
                break
        if address is None:
            raise SystemExit("the virtual device did not start")
        limbfit_says("acquire", str(plan), "--unattended", "--device", address[0])
    finally:
        served.terminate()
        served.wait()


def judged(folder: Path, plan: Path) -> dict[str, Any]:
    """What the identification found, beside the truth."""
    store = Store(limbfit.load_study(plan).results)
    found, predicted = (
        read_json(store["calibrate"] / "calibration.json"),
        read_json(store["predict"] / "predict.json"),
    )
    truth = json.loads((folder / "patient" / "truth.json").read_text())["parameters"]
    known = found["uncertainty"]
    rows = {}
    for name, verdict in known["verdict"].items():
        tissue, key = name.split(".")
        low, high = known["intervals_95"][tissue][key]
        value = found["stages"][-1]["parameters"][tissue][key]
        true = truth[tissue][key]
        rows[name] = {
            "value": value, "true": true, "factor_95": float(np.sqrt(high / low)),
            "inside": bool(low <= true <= high), "determined": verdict == "determined",
        }  # fmt: skip
    return {
        "records": len(limbfit.load_study(plan).indentations),
        "determined": sum(row["determined"] for row in rows.values()),
        "inside": sum(row["inside"] for row in rows.values()),
        "error_fitted_percent": predicted["mean_error_fitted_percent"],
        "parameters": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("runs/acquired"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--draws", type=int, default=3, help="tissues at which the records are chosen")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    asked.folder.mkdir(parents=True, exist_ok=True)
    plan = planned(asked.folder, asked.seed)
    file = plan / "study.toml"
    if "[[records]]" not in file.read_text():
        words = ("--protocol", "--minutes", f"{asked.minutes:g}", "--draws", str(asked.draws))
        limbfit_says("design", str(plan), *words)
        records = (plan / "results" / "protocol" / "records.toml").read_text()
        true_limb(asked.folder, plan)
        text = re.sub(r"depth_mm = .*\n", "", file.read_text()).replace("fitted = false", "fitted = true")
        file.write_text(f"{text}\n{records}")
    record(plan, true_limb(asked.folder, plan))
    limbfit_says("run", str(plan), "--workers", str(asked.workers))
    print(json.dumps(judged(asked.folder, plan), indent=1))


if __name__ == "__main__":
    main()
