"""The error of the steps in time over the force curve of a layer, whose exact force is known, and of a site.

    python benchmarks/time_steps.py                     # the layer
    python benchmarks/time_steps.py --site DEMO NAME     # one site of a finished demo

Prints root mean square and largest error over the whole curve in percent of the peak, as read between
the steps, and the number of steps and of Newton iterations.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from material_point import compute_curve_error, solve_layer, solve_reference_layer

from limbfit.fe import History, StepControl, solve
from limbfit.indentation import SiteModel, build_problem
from limbfit.mesh import read_vtu
from limbfit.phantom.robot import (
    INDENTER_EDGE_MM,
    INDENTER_MM,
    LOAD_STEPS,
    STIFFEST_PER_MM,
    UNLOAD_STEPS,
)
from limbfit.study import IndenterTable

T = 10.0  # s, one way
HISTORIES = {
    "ramp": History(np.array([0.0, T, 2 * T]), np.array([0.0, 1.0, 0.0])),
    "30 s hold": History(np.array([0.0, T, T + 30.0, 2 * T + 30.0]), np.array([0.0, 1.0, 1.0, 0.0])),
    "3 cycles": History(T * np.arange(7), np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0])),
}
CONTROLS = {
    "default": StepControl(),
    "truth": StepControl(load_steps=LOAD_STEPS, unload_steps=UNLOAD_STEPS),
    "default, linear": StepControl(stress="linear"),
}
TAUS = (0.1, 0.2, 0.32, 0.5, 1.0, 3.0)  # s


def layer_rows() -> None:
    """The layer: elastic force with the square of the depth, relaxing by three times that, one Prony term."""
    print("| history | steps | number | " + " | ".join(f"tau {tau:g} s" for tau in TAUS) + " |")
    for name, history in HISTORIES.items():
        exact = {tau: solve_reference_layer(history, prony=((3.0, tau),)) for tau in TAUS}
        for label, control in CONTROLS.items():
            found = {tau: solve_layer(history, control, ((3.0, tau),)) for tau in TAUS}
            errors = ["{:.2f} / {:.2f}".format(*compute_curve_error(found[tau], exact[tau])) for tau in TAUS]
            most = max(len(one.times) - 1 for one in found.values())
            print(f"| {name} | {label} | {most} | " + " | ".join(errors) + " |", flush=True)


def site_rows(folder: Path, name: str) -> None:
    """One site of a finished demo with its true tissues and ramp, against ten times as many steps."""
    results, truth = folder / "results", json.loads((folder / "truth.json").read_text())
    sites = json.loads((results / "sites" / "sites.json").read_text())["sites"]
    site = next(one for one in sites if one["site"] == name)
    true = next(one for one in truth["sites"] if one["name"] == name)
    depth, mesh = true["depth_mm"], results / "mesh" / f"{name}.vtu"
    ramp = depth / true["speed_mm_s"]
    model = SiteModel(
        name, mesh, "", tuple(site["position_mm"]), tuple(site["axis"]),
        (0.0, ramp, 2 * ramp), (0.0, depth, 0.0), element="tet10p0",
        indenter=IndenterTable(width_mm=INDENTER_MM, edge_radius_mm=INDENTER_EDGE_MM),
    )  # fmt: skip
    problem = build_problem(model, read_vtu(mesh), truth["parameters"])
    t, exact = np.linspace(0.0, 2 * ramp, 2001), None
    fine = StepControl(load_steps=80, unload_steps=100)
    print("| steps | made | Newton iterations | factorisations | error rms / worst |")
    for label, control in {"ten times": fine, **CONTROLS}.items():
        stated = replace(control, penalty=STIFFEST_PER_MM, hold_penalty=True)
        found = solve(problem, stated, store="none")
        facts, force = found.statistics, found.force_at(t)
        exact = force if exact is None else exact
        error = 100.0 * (force - exact) / exact.max()
        counts = f"{facts['steps']} | {facts['newton_iterations']} | {facts['factorisations']}"
        rms, worst = np.sqrt((error**2).mean()), np.abs(error).max()
        print(f"| {label} | {counts} | {rms:.3f} / {worst:.3f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--site", nargs=2, metavar=("DEMO", "NAME"), help="a folder of limbfit demo, a site")
    chosen = parser.parse_args()
    if chosen.site:
        site_rows(Path(chosen.site[0]), chosen.site[1])
    else:
        layer_rows()


if __name__ == "__main__":
    main()
