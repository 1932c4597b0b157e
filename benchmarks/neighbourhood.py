"""How near the tissue around a site comes to the whole limb, and what it saves.

    python benchmarks/neighbourhood.py STUDY --sites 05 10 15 --radii 40 50 55 60 75

STUDY is calibrated (``limbfit demo``). At each site force and derivatives are computed at the identified
parameters, on the whole mesh and on what of it is within each radius, and again with all of them moved by
some 15 %. Printed are the nodes, the factor that takes the part's force to the whole one's, how far the whole
force is from what the part so corrected expects at the moved parameters, the error of the corrected
derivatives, and processor seconds from rest and from first guesses.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limbfit import load_study
from limbfit.execution import SerialExecutor
from limbfit.identify.fit.multifidelity import MeshCorrection
from limbfit.indentation import SimulationJob, build_problem, simulate, to_parameters, to_vector
from limbfit.mesh import read_vtu
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.records.records import load_site_record, to_response

MOVED = np.array(
    [0.15, -0.15, 0.1, 0.1]
)  # logarithms of c, m, gamma, tau of the first tissue; then the opposite


def timed(job: SimulationJob) -> tuple[Any, float]:
    started = time.process_time()
    return to_response(simulate(job)), time.process_time() - started


def row(record: Any, best: np.ndarray, moved: np.ndarray, radius: float | None) -> dict[str, Any]:
    model = replace(record.model, within_mm=radius)
    part = replace(record, model=model)
    problem = build_problem(model, read_vtu(model.mesh), to_parameters(best, record.tissues))
    here, rest_s = timed(part.job(best))
    there, warm_s = timed(part.job(moved, starts=[best]))
    return {
        "nodes": len(problem.mesh.points),
        "here": here,
        "there": there,
        "rest_s": rest_s,
        "warm_s": warm_s,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path)
    parser.add_argument("--sites", nargs="+", required=True)
    parser.add_argument("--radii", nargs="+", type=float, default=[40.0, 50.0, 55.0, 60.0, 75.0])
    args = parser.parse_args()
    study = load_study(args.study)
    context = Context(study, Store(study.results), SerialExecutor(), lambda progress: None)
    stage = context.results.calibration.to_plain()["stages"][-1]
    best = to_vector(stage["parameters"], study.tissues)
    moved = best * np.exp(np.concatenate([(-1) ** i * MOVED for i in range(len(study.tissues))]))
    print(
        "| site | mm | nodes | factor | unexpected, % of the peak | derivatives off, % | s, rest | s, warm |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in args.sites:
        record = load_site_record(context, study.indentation(name))
        simulate(replace(record, model=replace(record.model, within_mm=40.0)).job(best))  # compiles
        whole = row(record, best, moved, None)
        print(
            f"| {name} | whole | {whole['nodes']:,} | | | | {whole['rest_s']:.1f} | {whole['warm_s']:.1f} |",
            flush=True,
        )
        for radius in args.radii:
            part = row(record, best, moved, radius)
            correction = MeshCorrection([part["here"]], [whole["here"]])
            expected = correction([part["there"]])[0]
            off = np.abs(expected.force_N - whole["there"].force_N).max() / whole["there"].force_N.max()
            slopes = [one.jacobian * best for one in (correction([part["here"]])[0], whole["here"])]
            wrong = np.linalg.norm(slopes[0] - slopes[1]) / np.linalg.norm(slopes[1])
            print(
                f"| {name} | {radius:g} | {part['nodes']:,} | {correction.scales[0]:.3f} | {100 * off:.2f} "
                f"| {100 * wrong:.1f} | {part['rest_s']:.1f} | {part['warm_s']:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
