"""Locking: error of the peak force against unknowns and CPU time, for every element.

A quarter of a block of 60 x 60 x 30 mm, 3 mm of skin on muscle with the parameters of the tests, pushed
in by 6 mm in 6.25 s by a 20 mm square punch with an edge radius of 2 mm.  All elements have the same nodes on
a level: linear cells are half as large as quadratic ones.  The reference is the Richardson limit of tet10 on
its three finest levels, the last of which (``--finest``) only tet10 solves.

    python benchmarks/locking.py [--levels 1 2] [--finest 3] [--output folder]

writes locking.json and locking.png into the folder; without one it prints the table only.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import brentq

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fe"))
from blocks import quarter_punch

from limbfit.fe import ELEMENTS, StepControl, solve

STEPS = StepControl(load_steps=4)


def measure(element: str, level: int) -> dict:
    """Peak force (N) of the whole block, unknowns and CPU seconds of one simulation."""
    refinement = level if ELEMENTS[element].cell_type == "tet10" else 2 * level
    started = time.process_time()
    result = solve(quarter_punch(element, refinement), STEPS)
    return {
        "element": element,
        "level": level,
        "unknowns": result.statistics["unknowns"],
        "peak_force_N": 4 * result.peak_force,
        "cpu_seconds": time.process_time() - started,
        "newton_iterations": result.statistics["newton_iterations"],
        "penetration_mm": float(result.penetration.max()),
        "completed": result.completed,
    }


def richardson(levels: list[int], forces: list[float]) -> tuple[float, float]:
    """Limit and order of ``F(h) = F_0 + C h^p`` through three levels, ``h = 1/level``."""
    h, F = 1.0 / np.array(levels[-3:], dtype=float), np.array(forces[-3:])
    wanted = (F[0] - F[1]) / (F[1] - F[2])

    def miss(p: float) -> float:
        return (h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - wanted

    if miss(0.2) * miss(8.0) > 0:
        raise SystemExit(f"the forces {F} do not converge monotonically: no Richardson limit")
    order = brentq(miss, 0.2, 8.0)
    slope = (F[1] - F[2]) / (h[1] ** order - h[2] ** order)
    return float(F[2] - slope * h[2] ** order), float(order)


def run(levels: list[int], finest: int) -> dict:
    """All elements on all levels, and their errors against the limit."""
    for element in ELEMENTS:
        measure(element, 1)  # compile
    rows = []
    for element, level in [*((e, level) for level in levels for e in ELEMENTS), ("tet10", finest)]:
        rows.append(measure(element, level))
        print(
            "{element:9s} {unknowns:7d} {peak_force_N:8.4f} N {cpu_seconds:7.1f} s".format(**rows[-1]),
            flush=True,
        )
    best = [row["peak_force_N"] for row in rows if row["element"] == "tet10"]
    limit, order = richardson([*levels, finest], best)
    for row in rows:
        row["error_percent"] = 100 * (row["peak_force_N"] / limit - 1)
    return {"limit_N": limit, "order": order, "rows": rows}


def table(found: dict) -> str:
    """The rows as Markdown."""
    lines = ["| element | unknowns | peak force N | error % | CPU s |", "|---|---|---|---|---|"]
    for row in sorted(found["rows"], key=lambda row: (row["element"], row["unknowns"])):
        cells = "{element} | {unknowns} | {peak_force_N:.3f} | {error_percent:+.1f} | {cpu_seconds:.1f}"
        lines.append(f"| {cells.format(**row)} |")
    return "\n".join(lines)


def draw(found: dict, path: Path) -> None:
    """Error against unknowns and against CPU seconds."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for element in ELEMENTS:
        rows = [row for row in found["rows"] if row["element"] == element]
        errors = [abs(row["error_percent"]) for row in rows]
        for axis, key in zip(axes, ("unknowns", "cpu_seconds")):
            axis.loglog([row[key] for row in rows], errors, "o-", label=element)
    axes[0].set(xlabel="unknowns", ylabel="error of the peak force, %")
    axes[1].set(xlabel="CPU seconds, one thread")
    axes[0].legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--finest", type=int, default=3)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    found = run(options.levels, options.finest)
    print(f"limit {found['limit_N']:.4f} N, order {found['order']:.2f}\n{table(found)}")
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "locking.json").write_text(json.dumps(found, indent=1))
        draw(found, options.output / "locking.png")


if __name__ == "__main__":
    main()
