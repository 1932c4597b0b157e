"""Are forces predicted, and true parameters held, for one synthetic patient after another?

    python benchmarks/patients.py --seeds 10 --folder runs/patients --json patients.json
    python benchmarks/patients.py --only 3 --detail paper

Every seed is another limb with other tissues: made, identified and predicted from its files by ``run_study``
in a folder of its own, which is kept, so that a run that was stopped goes on.  Told for each: the mean error
at the fitted and at the held-out sites in percent of the largest force, which true parameters lie within
their 95 % intervals, and how many of those that are called determined do; then the same over all patients.
Seeds in the file of ``--json`` are not run again.  A patient of the coarse detail costs half an hour of one
processor.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from limbfit import load_study, run_study
from limbfit.indentation import list_flat_names, to_vector
from limbfit.pipeline.commands.demo import make_phantom_study
from limbfit.pipeline.engine.context import Progress
from limbfit.pipeline.engine.store import Store, read_json

Record = dict[str, Any]


def tell(event: Progress) -> None:
    """The stages' ends only; nothing of what a simulation says."""
    if event.total and event.done == event.total:
        print(f"  {time.strftime('%H:%M:%S')} {event.stage} {event.text}", flush=True)


def run_patient(folder: Path, seed: int, detail: str) -> Record:
    """The patient of a seed, from its images and records to its predictions."""
    if not (folder / "truth.json").is_file():
        make_phantom_study(folder, detail=detail, seed=seed, listener=tell)
    study = load_study(folder)
    run_study(study, until="predict", listener=tell)
    store = Store(study.results)
    found, predicted = (
        read_json(store["calibrate"] / "calibration.json"),
        read_json(store["predict"] / "predict.json"),
    )
    truth = to_vector(read_json(folder / "truth.json")["parameters"], study.tissues)
    best = to_vector(found["stages"][-1]["parameters"], study.tissues)
    names = [f"{tissue}.{name}" for tissue, name in list_flat_names(study.tissues)]
    known = found["uncertainty"]
    low, high = np.array([known["intervals_95"][t][n] for t, n in list_flat_names(study.tissues)]).T
    return {
        "seed": seed,
        "error_fitted_percent": predicted["mean_error_fitted_percent"],
        "error_heldout_percent": predicted["mean_error_heldout_percent"],
        "error_percent_by_site": {row["site"]: row["error_percent"] for row in predicted["sites"]},
        "identified_over_truth": dict(zip(names, (best / truth).tolist(), strict=True)),
        "within": dict(zip(names, ((low <= truth) & (truth <= high)).tolist(), strict=True)),
        "verdict": known["verdict"],
        "forward_runs": found["forward_runs"],
        "flags": [flag["text"] for flag in predicted["flags"]],
    }


def line(one: Record) -> str:
    outside = [name for name, within in one["within"].items() if not within]
    return (
        f"seed {one['seed']}: fitted {one['error_fitted_percent']:.2f} %, "
        f"held out {one['error_heldout_percent']:.2f} %, {len(one['within']) - len(outside)} of "
        f"{len(one['within'])} true values within" + (f" (not {', '.join(outside)})" if outside else "")
    )


def summary(patients: list[Record]) -> Record:
    """Over all patients; the share of determined parameters is None where there are none."""
    heldout = np.array([one["error_heldout_percent"] for one in patients])
    within = [inside for one in patients for inside in one["within"].values()]
    determined = [
        one["within"][name]
        for one in patients
        for name, verdict in one["verdict"].items()
        if verdict == "determined" and name in one["within"]
    ]
    return {
        "patients": len(patients),
        "heldout_mean_percent": float(heldout.mean()),
        "heldout_largest_percent": float(heldout.max()),
        "within_percent": 100.0 * float(np.mean(within)),
        "determined": len(determined),
        "determined_within_percent": 100.0 * float(np.mean(determined)) if determined else None,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="patients of the seeds from 0")
    parser.add_argument("--only", type=int, nargs="+", help="these seeds alone")
    parser.add_argument("--detail", choices=("coarse", "paper"), default="coarse", help="of the patients")
    parser.add_argument("--folder", type=Path, default=Path("runs/patients"), help="of their studies")
    parser.add_argument("--json", type=Path, help="write every patient here; those found there are kept")
    options = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    patients: list[Record] = []
    if options.json is not None and options.json.exists():
        kept = json.loads(options.json.read_text())
        if kept["detail"] != options.detail:
            parser.error(f"{options.json} holds patients of the detail {kept['detail']}; name another file")
        patients = kept["patients"]
    known = {one["seed"] for one in patients}
    for one in patients:
        print(line(one))
    for seed in options.only or range(options.seeds):
        if seed in known:
            continue
        folder = options.folder / f"{options.detail}-{seed}"
        patients.append(run_patient(folder, seed, options.detail))
        print(line(patients[-1]), flush=True)
        if options.json is not None:
            content = {"detail": options.detail, "summary": summary(patients), "patients": patients}
            options.json.write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(summary(patients), indent=1))


if __name__ == "__main__":
    main()
