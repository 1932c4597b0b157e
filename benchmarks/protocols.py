"""What the paper's protocol, a designed one and each ingredient alone determine of a limb with known truth.

    python benchmarks/protocols.py [--folder runs/protocols] [--only paper designed] [--seeds 0] [--json FILE]

The limb is the stump of `identification_cases`: its true records come from other meshes (edges of 1.8 mm),
finer surfaces, another element and more steps than the study has, with 0.05 N of noise; ultrasound, cameras
and elastography read as `limbfit phantom` has them. Four sites are fitted, two are held out with one ramp
each. Judged are how many of the eight parameters are determined (95 % interval of at most -20 to +25 %), how
many intervals hold the true value, the error at the held-out sites, and the patient's time: each record, 30 s
of rest after it, 60 s to prepare a site with an indenter. What is done is kept in the folder; a run that was
stopped goes on.
"""

import argparse
import json
import os
import resource
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from identification_cases import SPOTS, parameters_of
from protocols_limb import BALL_TABLE, SLOW, TISSUES, Limb, Take, write_case

from limbfit import load_study, plan_protocol, run_study
from limbfit.execution import SerialExecutor
from limbfit.identify.checks.design import (
    Budget,
    DesignTarget,
    NoiseModel,
    RecordOption,
    compute_factors_95,
    compute_information,
    compute_prior_information,
    plan_records,
)
from limbfit.identify.fit.objective import SiteResponse
from limbfit.indentation import to_vector
from limbfit.phantom.robot import NOTHING, ULTRASOUND_NOISE_MM, WAVES_NOISE_M_S, SecondaryMeasurements
from limbfit.pipeline.design.protocol import DETERMINED
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store, read_json
from limbfit.pipeline.identification.search import build_problem
from limbfit.pipeline.simulation.limb_geometry import build_site_model, coarsen_model
from limbfit.pipeline.simulation.simulations import (
    SimulationCache,
    build_curve_job,
)
from limbfit.study import Study

FAST, HOLD_S = 4.8, 30.0
REST_S, SETUP_S, MINUTES = 30.0, 60.0, 25.0
# Of linear theory: noise of a compared force, and the model's own error, which drifts along a record.
EXPECTED_N, EXPECTED_CORRELATION, MISFITS = 0.015, 0.95, (0.02, 0.01, 0.005, 0.002)
FITTED = tuple(spot.name for spot in SPOTS if spot.fitted)
HELD_OUT = tuple(Take(spot.name) for spot in SPOTS if not spot.fitted)
ULTRASOUND = SecondaryMeasurements(ultrasound=True)
RAMPS = tuple(Take(site) for site in FITTED)
INGREDIENTS: dict[str, tuple[Take, ...]] = {
    "paper": RAMPS,
    "prior": RAMPS,
    "hold": tuple(replace(one, hold_s=HOLD_S) for one in RAMPS),
    "speed": (*RAMPS, *(replace(one, speed=FAST) for one in RAMPS)),
    "indenter": (*RAMPS, *(replace(one, ball=True) for one in RAMPS)),
    "ultrasound": tuple(replace(one, seen=ULTRASOUND) for one in RAMPS),
    "surface": tuple(replace(one, seen=SecondaryMeasurements(surface=True)) for one in RAMPS),
    "shear waves": tuple(replace(one, seen=SecondaryMeasurements(shear_waves=True)) for one in RAMPS),
}
FITTED_ALONE = ("prior", "surface", "shear waves")  # linear theory is not asked of them
DESIGNED = {
    "designed": ULTRASOUND,
    "designed with shear waves": SecondaryMeasurements(ultrasound=True, shear_waves=True),
    "designed without ultrasound": NOTHING,
    "designed with prior": ULTRASOUND,
}
SHORT, SHORT_MINUTES = "8 minutes", 8.0  # the best at the true tissue
CASES = (*INGREDIENTS, *DESIGNED, SHORT)


def minutes_of(takes: Sequence[Take]) -> float:
    """How long a patient sits for these records."""
    places = {(take.site, take.ball) for take in takes}
    return (sum(take.knots[0][-1] + REST_S for take in takes) + SETUP_S * len(places)) / 60.0


def plan_study(folder: Path, limb: Limb, edge_mm: float | None) -> Study:
    """The fitted sites as they are before anybody is indented but for a ramp at each, with both indenters."""
    place = folder / "plan"
    if not (place / "study.toml").is_file():
        write_case(place, limb, RAMPS, edge_mm, True, ())
        text = (place / "study.toml").read_text()
        (place / "study.toml").write_text(text.replace("\n[[sites]]", f"{BALL_TABLE}\n[[sites]]", 1))
    study = load_study(place)
    run_study(study, until="mesh", listener=lambda event: None)
    return study


def designed(
    folder: Path, limb: Limb, edge_mm: float | None, seen: SecondaryMeasurements, depths_mm: Sequence[float]
) -> tuple[Take, ...]:
    """The protocol that limbfit designs before anybody is indented: at the start and two more tissues."""
    found = plan_protocol(
        plan_study(folder, limb, edge_mm),
        minutes=MINUTES,
        speeds_mm_s=(SLOW, FAST),
        holds_s=(0.0, HOLD_S),
        depths_mm=depths_mm,
        ultrasound_sd_mm=ULTRASOUND_NOISE_MM if seen.ultrasound else None,
        shear_waves_sd_m_s=WAVES_NOISE_M_S if seen.shear_waves else None,
    )
    return tuple(
        Take(
            row["site"],
            row["speed_mm_s"],
            row["hold_s"],
            row["indenter"] == "ball",
            round(row["depth_mm"], 2),
            seen,
        )
        for row in found["records"]
    )


def told_of(
    folder: Path, limb: Limb, edge_mm: float | None, takes: Sequence[Take], misfit: float
) -> dict[Take, RecordOption]:
    """What records tell of the true tissue where the model's own error is ``misfit`` of the largest value.

    With what ultrasound sees where there is some. Simulated on the study's meshes, once.
    """
    study = plan_study(folder, limb, edge_mm)
    context = Context(study, Store(study.results), SerialExecutor(), lambda event: None)
    truth = study.vector(parameters_of(limb.seed))
    force = NoiseModel(EXPECTED_N, misfit, EXPECTED_CORRELATION)
    layers = NoiseModel(ULTRASOUND_NOISE_MM, misfit, EXPECTED_CORRELATION)
    plain = [replace(take, seen=NOTHING) for take in takes]
    jobs = []
    for take in plain:
        site = study.site(take.site).model_copy(update={"indenter": "ball" if take.ball else None})
        model = coarsen_model(context, build_site_model(context, site, *take.knots, layers=TISSUES))
        jobs.append(build_curve_job(replace(model, name=take.name), study.tissues, truth))
    found = {}
    done = SimulationCache(folder / f"expected-{limb.seed}").run(jobs, context.executor)
    for take, one in zip(takes, done, strict=True):
        if not one.completed:
            raise SystemExit(f"{take.name} could not be simulated: {one.reason}")
        information = compute_information(SiteResponse(one.force_N, one.jacobian), truth, force)
        if take.seen.ultrasound:
            for lost, slopes in zip(one.observed, one.observed_jacobian, strict=True):
                information = information + compute_information(SiteResponse(lost, slopes), truth, layers)
        place = take.site, "ball" if take.ball else "punch"
        found[take] = RecordOption(place, take.knots[0][-1] + REST_S, information[None])
    return found


def wanted_of(folder: Path, limb: Limb, edge_mm: float | None) -> DesignTarget:
    """All eight parameters, given the study's bounds."""
    problem = build_problem(plan_study(folder, limb, edge_mm))
    return DesignTarget(compute_prior_information(problem.unknowns, problem.space), np.eye(8))


def best_at_truth(
    folder: Path,
    limb: Limb,
    edge_mm: float | None,
    minutes: float,
    misfit: float,
    seen: SecondaryMeasurements,
) -> tuple[Take, ...]:
    """The protocol of so many minutes that linear theory prefers at the true tissue."""
    ways = product(FITTED, (SLOW, FAST), (0.0, HOLD_S), (False, True))
    every = [Take(site, speed, hold, ball, seen=seen) for site, speed, hold, ball in ways]
    options = list(told_of(folder, limb, edge_mm, every, misfit).values())
    best = plan_records(options, Budget(60.0 * minutes, SETUP_S), wanted_of(folder, limb, edge_mm))
    return tuple(every[i] for i in best)


def expected(folder: Path, limb: Limb, edge_mm: float | None) -> list[dict[str, Any]]:
    """What linear theory expects of every protocol at the true tissue, by the size of the model's own error.

    The designed ones are the best that fit into the session; all within the study's bounds.
    """
    wanted, rows = wanted_of(folder, limb, edge_mm), []
    for misfit in MISFITS:
        chosen = {name: takes for name, takes in INGREDIENTS.items() if name not in FITTED_ALONE}
        for name, seen, minutes in (
            ("designed", ULTRASOUND, MINUTES),
            ("designed without ultrasound", NOTHING, MINUTES),
            (SHORT, ULTRASOUND, SHORT_MINUTES),
        ):
            chosen[name] = best_at_truth(folder, limb, edge_mm, minutes, misfit, seen)
        for name, takes in chosen.items():
            options = list(told_of(folder, limb, edge_mm, takes, misfit).values())
            (factors,) = compute_factors_95(wanted.compute_covariances(options, range(len(options)), 1))
            rows.append(
                {
                    "case": name,
                    "misfit_percent": 100 * misfit,
                    "records": len(takes),
                    "minutes": minutes_of(takes),
                    "determined": int(np.sum(factors <= DETERMINED)),
                    "factor_95": factors.tolist(),
                }
            )
    return rows


def judged(folder: Path, limb: Limb, takes: Sequence[Take]) -> dict[str, Any]:
    """What a study that was run to its prediction found, beside the truth."""
    store = Store(folder / "results")
    found, predicted = (
        read_json(store["calibrate"] / "calibration.json"),
        read_json(store["predict"] / "predict.json"),
    )
    truth, known = to_vector(parameters_of(limb.seed), TISSUES), found["uncertainty"]
    names = list(known["verdict"])
    intervals = [known["intervals_95"][tissue][key] for tissue, key in (n.split(".") for n in names)]
    inside = [bool(low <= value <= high) for value, (low, high) in zip(truth, intervals, strict=True)]
    factors = [float(np.sqrt(high / low)) for low, high in intervals]
    return {
        "records": len(takes),
        "minutes": minutes_of(takes),
        "determined": sum(verdict == "determined" for verdict in known["verdict"].values()),
        "inside": sum(inside),
        "names": names,
        "truth": truth.tolist(),
        "answer": to_vector(found["stages"][-1]["parameters"], TISSUES).tolist(),
        "factor_95": factors,
        "inside_by_parameter": inside,
        "error_fitted_percent": predicted["mean_error_fitted_percent"],
        "error_heldout_percent": predicted["mean_error_heldout_percent"],
        "misfit_percent": 100 * known["residuals"]["misfit_elsewhere"],
    }


def run_case(
    folder: Path, name: str, seed: int, edge_mm: float | None, depths_mm: Sequence[float]
) -> dict[str, Any]:
    limb = Limb(folder, seed)
    place = folder / f"{seed}-{name.replace(' ', '-')}"
    began = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    if name == SHORT:
        takes = best_at_truth(folder, limb, edge_mm, SHORT_MINUTES, MISFITS[0], ULTRASOUND)
    elif name in DESIGNED:
        takes = designed(folder, limb, edge_mm, DESIGNED[name], depths_mm)
    else:
        takes = INGREDIENTS[name]
    if not (place / "study.toml").is_file():
        write_case(place, limb, takes, edge_mm, "prior" in name, HELD_OUT)
    run_study(load_study(place), until="predict", listener=lambda event: None)
    spent = resource.getrusage(resource.RUSAGE_SELF).ru_utime - began
    return {"case": name, "seed": seed, "cpu_s": spent, **judged(place, limb, takes)}


def line(case: dict[str, Any]) -> str:
    widths = ", ".join(
        f"{name} x/{factor:.2f}{'' if held else ' (outside)'}"
        for name, factor, held in zip(
            case["names"], case["factor_95"], case["inside_by_parameter"], strict=True
        )
    )
    return (
        f"{case['case']}, seed {case['seed']}: {case['records']} records in {case['minutes']:.0f} min, "
        f"{case['determined']} of 8 determined, {case['inside']} of 8 inside, held-out error "
        f"{case['error_heldout_percent']:.2f} %; {widths}"
    )


def told(row: dict[str, Any]) -> str:
    factors = ", ".join(f"{factor:.2f}" for factor in row["factor_95"])
    return (
        f"{row['misfit_percent']:g} % of model error, {row['case']}: {row['records']} records in "
        f"{row['minutes']:.0f} min, {row['determined']} of 8 determined; x/ {factors}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("runs/protocols"))
    parser.add_argument("--only", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--edge", type=float, help="of the study's meshes near a site, mm; else limbfit's own"
    )
    parser.add_argument(
        "--depths", type=float, nargs="+", default=(), help="that a design chooses among, mm; else the ramps'"
    )
    parser.add_argument("--json", type=Path, help="write every case here; cases found there are kept")
    parser.add_argument("--expected", action="store_true", help="linear theory at the truth instead of fits")
    given = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    if given.expected:
        for seed in given.seeds:
            for row in expected(given.folder, Limb(given.folder, seed), given.edge):
                print(told(row), flush=True)
        return
    cases = json.loads(given.json.read_text()) if given.json and given.json.is_file() else []
    for seed in given.seeds:
        for name in given.only:
            known = next((one for one in cases if (one["case"], one["seed"]) == (name, seed)), None)
            if known is None:
                known = run_case(given.folder, name, seed, given.edge, given.depths)
                cases.append(known)
            print(line(known), flush=True)
            if given.json:
                given.json.write_text(json.dumps(cases, indent=1))


if __name__ == "__main__":
    main()
