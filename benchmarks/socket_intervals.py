"""Are the intervals of a socket's pressures and settling those of re-simulated parameters?

    python benchmarks/socket_intervals.py STUDY --draws 12 --json intervals.json
    python benchmarks/socket_intervals.py STUDY --identified OTHER --json intervals.json
    python benchmarks/socket_intervals.py STUDY --identified OTHER --draws 0 --truth 0 --json paper.json

STUDY has identified parameters, or takes those of OTHER with their covariance.  Its socket is put on and
loaded once with derivatives, and then with parameters drawn from the lognormal distribution of that
covariance (by the seed and the number of the draw alone).  Told for the mean pressure of every region and
the settling: the standard deviation by derivatives and of the draws, how far the draws are from what the
derivatives foresee (rms), and how many lie within the 95 % interval, simulated and foreseen; and how many of
the second half lie within those that the first half widens (``limbfit socket --samples``).  Also the change
for a coefficient of friction 10 % larger, which counts as known; left out without draws.  ``--truth``: also
what the tissues of the synthetic patient of that seed do, and whether it lies within the intervals.  Draws
in the file of ``--json`` are not run again.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import limbfit
from limbfit.execution import SerialExecutor
from limbfit.identify.fit.prediction import NORMAL_95
from limbfit.indentation import list_flat_names, to_parameters, to_vector
from limbfit.mesh import Mesh
from limbfit.phantom.build import draw_true_parameters
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.engine.store import Store, read_json
from limbfit.pipeline.socket.intervals import ParameterSpread, draw_step, predict_change
from limbfit.pipeline.socket.shape import build_socket
from limbfit.pipeline.socket.simulation import SocketLimb, SocketRun, solve_run, summarise_run
from limbfit.socket import Socket

SETTLING = "settling (mm)"
FRICTION = 1.1  # times the study's


class Bench:
    """A study's limb and socket, and what is known of its tissues."""

    def __init__(self, study: limbfit.Study, identified: limbfit.Study, folder: Path) -> None:
        limbfit.run_study(study, until="surfaces")
        context = Context(study, Store(study.results), SerialExecutor(), ignore_progress)
        found = read_json(Store(identified.results)["calibrate"] / "calibration.json")
        self.study = study
        self.covariance = np.array(found["uncertainty"]["covariance_log"])
        self.centre = to_vector(found["stages"][-1]["parameters"], study.tissues)
        self.off = np.log(to_vector(found["uncertainty"]["most_probable"], study.tissues) / self.centre)
        self.limb = SocketLimb.from_store(study, context.store, print)
        self.socket: Socket = build_socket(study, self.limb.anatomy, self.limb.outer.skin)
        self.mesh: Mesh = self.limb.mesh(folder, self.socket, print)[0]

    def run(self, parameters: np.ndarray, *, known: bool = False, friction: float = 1.0) -> dict[str, Any]:
        """Means and settling at parameters; ``known``: with their deviations by derivatives."""
        table = self.study.socket
        if friction != 1.0:
            table = table.model_copy(update={"friction": friction * float(table.friction)})
        study = self.study.model_copy(update={"socket": table})
        limb, started = replace(self.limb, study=study), time.process_time()
        values = to_parameters(parameters, study.tissues)
        run = SocketRun("", limb.build_model(self.socket, self.mesh), values, sensitivities=known)
        found = solve_run(run, lambda *_: None)
        around = ParameterSpread(self.covariance, np.zeros_like(self.centre)) if known else None
        load = summarise_run(run, found, around)["loads"][-1]
        row = {"values": {one["region"]: one["mean_kPa"] for one in load["regions"]}}
        row["values"][SETTLING] = load["settling_mm"]
        row["cpu_s"] = round(time.process_time() - started, 1)
        if known:
            high = {one["region"]: one["interval_kPa"][1] for one in load["regions"]}
            high[SETTLING] = load["settling_interval_mm"][1]
            row["sd"] = {name: (high[name] - value) / NORMAL_95 for name, value in row["values"].items()}
            row["from"] = {one["region"]: one["interval_from"] for one in load["regions"]}
            row["from"][SETTLING] = load["settling_interval_from"]
            row["change"] = {one["region"]: one["change_kPa"] for one in load["regions"]}
            row["change"][SETTLING] = load["settling_change_mm"]
        return row

    def foreseen(self, centre: dict[str, Any], name: str, step: np.ndarray) -> float:
        """A value of a draw, by the derivatives at the centre."""
        keys = [f"{tissue}.{key}" for tissue, key in list_flat_names(self.study.tissues)]
        row = {"change_kPa": centre["change"][name]}
        return float(centre["values"][name]) + predict_change(
            row, "", "kPa", dict(zip(keys, step, strict=True))
        )


def told(bench: Bench, rows: dict[str, Any], seed: int) -> list[dict[str, Any]]:
    """Of each region, and settling."""
    centre, draws = rows["centre"], {int(name): row for name, row in rows.items() if name.isdigit()}
    steps = [draw_step(bench.covariance, number, seed) for number in draws]
    found = []
    for name, value in centre["values"].items():
        sample, sd = np.array([draw["values"][name] for draw in draws.values()]), centre["sd"][name]
        linear = np.array([bench.foreseen(centre, name, step) for step in steps])
        first, percent = next(iter(centre["from"][name].items()))
        probable = bench.foreseen(centre, name, bench.off)
        true = rows["truth"]["values"][name] if "truth" in rows else None
        found.append(
            {
                "of": name,
                "value": value,
                "sd": sd,
                "sd_drawn": float(sample.std(ddof=1)) if len(sample) > 1 else None,
                "off_linear": float(np.sqrt(np.mean((sample - linear) ** 2))) if len(sample) else None,
                "within": int((np.abs(sample - value) <= NORMAL_95 * sd).sum()),
                "within_linear": int((np.abs(linear - value) <= NORMAL_95 * sd).sum()),
                "draws": len(sample),
                "within_widened": _within_widened(sample, linear, value, sd),
                "mostly_from": f"{first} {percent:.0f} %",
                "liner_c": centre["change"][name].get("liner.c_kPa"),
                "friction": rows["friction"]["values"][name] - value if "friction" in rows else None,
                **({} if true is None else {"truth": true, "inside": _covers(value, probable, sd, true)}),
            }
        )
    return found


def _covers(value: float, probable: float, sd: float, true: float) -> bool:
    """Whether the interval around the simulated and the most probable value holds the true one."""
    low, high = sorted((value, probable))
    return bool(low - NORMAL_95 * sd <= true <= high + NORMAL_95 * sd)


def _within_widened(sample: np.ndarray, linear: np.ndarray, value: float, sd: float) -> int | None:
    """How many draws of the second half lie within the interval that those of the first half widen."""
    half = len(sample) // 2
    if half < 2:
        return None
    missed = sample[:half] - linear[:half]
    middle, width = value + missed.mean(), NORMAL_95 * np.hypot(sd, missed.std(ddof=1))
    return int((np.abs(sample[half:] - middle) <= width).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--identified", type=Path, help="the study whose parameters and covariance are taken")
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", type=int, help="seed of the synthetic patient whose tissues are true")
    parser.add_argument("--folder", type=Path, default=Path("runs/socket-intervals"), help="of the mesh")
    parser.add_argument("--json", type=Path, required=True)
    asked = parser.parse_args()
    study = limbfit.load_study(asked.study)
    asked.folder.mkdir(parents=True, exist_ok=True)
    identified = study if asked.identified is None else limbfit.load_study(asked.identified)
    bench = Bench(study, identified, asked.folder)
    rows: dict[str, Any] = json.loads(asked.json.read_text())["rows"] if asked.json.exists() else {}
    wanted = ["centre"] if asked.truth is None else ["centre", "truth"]
    wanted += ["friction"] if asked.draws and isinstance(study.socket.friction, float) else []
    for name in (*wanted, *map(str, range(asked.draws))):
        if name not in rows:
            if name.isdigit():
                rows[name] = bench.run(
                    bench.centre * np.exp(draw_step(bench.covariance, int(name), asked.seed))
                )
            elif name == "truth":
                rows[name] = bench.run(to_vector(draw_true_parameters(asked.truth), study.tissues))
            else:
                rows[name] = bench.run(
                    bench.centre, known=name == "centre", friction=FRICTION if name == "friction" else 1.0
                )
            print(f"{name}: {rows[name]['cpu_s']:.0f} CPU s", flush=True)
            asked.json.write_text(json.dumps({"seed": asked.seed, "rows": rows}, indent=1) + "\n")
    for row in told(bench, rows, asked.seed):
        print(json.dumps(row))


if __name__ == "__main__":
    main()
