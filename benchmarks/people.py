"""65 people predicted one by one by the solver: how far each layer of their legs is compressed under a probe.

    python benchmarks/people.py FOLDER            # coverage of 90 % intervals, by layer and site
    python benchmarks/people.py FOLDER --check    # and the interpolation against the solver at ten people
    python benchmarks/people.py FOLDER --outline oblong     # a probe of the same area, 45 by 15 mm

Reads shared/data/multis (skin, fat, muscle and forces of 65 people at four sites) and keeps its simulations
in FOLDER. Everybody is left out once: the mixed model of the others (`population_fit`), with the solver
(`solved_layers`) in place of linear theory, says how stiff the layers of a new person are, and the solver
what their compressions are under the recorded force. Results: docs/validation.md.
"""

import argparse
from pathlib import Path

import numpy as np
from layer_compressions import Footprint
from numpy.typing import NDArray
from population_fit import FORCE_N, SITES, Fit, Legs, fit, predict_held_out, within
from solved_layers import SolvedDesign, SolvedFootprint, press_layers, read_compressions

from population import DATA, LOWER_LEG, OBLONG, SQUARE, THREE, TWO, Model, viscosity

Array = NDArray[np.float64]

OUTLINES = {"square": (SQUARE, 48, 1), "oblong": (OBLONG, 32, 2)}  # probe, simulations, seed of the design
M = 6.91  # the median of the prior of m; others by --m
STILL = 0.05  # of the mixed model: places whose reading says nothing never quite settle
DRAWS = 300


def check(probe: SolvedFootprint, footprint: Footprint, legs: Legs, found: Fit) -> None:
    """Ten people, one site each, at the moduli of their site: the solver itself and what stands for it."""
    chosen = np.linspace(0, len(legs.site) - 1, 10).astype(int)
    ten = legs.of(np.isin(np.arange(len(legs.site)), chosen))
    logs = found.effects[:, ten.site].T + np.log(ten.force_N / FORCE_N)[:, None] * found.effects[:, 4]
    interpolated = ten.force_N[:, None] * probe.under(ten.thickness_mm, ten.force_N).compressions(
        np.exp(logs)
    )
    off = []
    for thickness, force, moduli, stood in zip(
        ten.thickness_mm, ten.force_N, np.exp(logs), interpolated, strict=True
    ):
        solved = read_compressions(*press_layers(thickness, footprint, moduli, probe.m, force), force)[1][-1]
        off.append(stood - solved)
        print(
            f"  {np.round(thickness, 1)} mm, {force:.1f} N: solver {np.round(solved, 2)}, "
            f"interpolated {np.round(stood, 2)}"
        )
    print("  root mean square difference, mm:", np.round(np.sqrt(np.mean(np.square(off), axis=0)), 3))


def report(name: str, legs: Legs, drawn: Array) -> None:
    """Coverage, width and error of the predictions of one model."""
    inside, median = within(drawn, legs.compression_mm), np.median(drawn, axis=0)
    half = np.diff(np.quantile(drawn, [0.05, 0.95], axis=0), axis=0)[0] / 2
    total = within(drawn.sum(axis=2), legs.compression_mm.sum(axis=1))
    error = np.median(np.abs(median - legs.compression_mm), axis=0)
    print(
        f"{name}: inside {100 * inside.mean():.1f} % ("
        + ", ".join(f"{100 * v:.1f}" for v in inside.mean(axis=0)),
        end="",
    )
    print(f"), their sum {100 * total.mean():.1f} %; median error, mm {np.round(error, 2)}", end="")
    measured = np.median(legs.compression_mm, axis=0)
    print(f", half width {np.round(np.median(half, axis=0), 2)}, measured {np.round(measured, 2)}")
    for number, site in enumerate(SITES):
        at = legs.site == number
        low = (legs.compression_mm < np.quantile(drawn, 0.05, axis=0))[at].mean(axis=0)
        shares = [f"{100 * v:.0f}" for v in (*inside[at].mean(axis=0), total[at].mean())]
        print(f"  {site}: inside {', '.join(shares)} %; below {', '.join(f'{100 * v:.0f}' for v in low)} %")


def constants(found: Fit, model: Model) -> None:
    """The long-term c, kPa, of the lower leg that the fit implies (docs/priors.md)."""
    slow, _ = viscosity()
    for layer, names in enumerate(model.layers):
        middle = 1e3 * np.exp(found.effects[layer, LOWER_LEG].mean() - slow)
        sites = np.round(1e3 * np.exp(found.effects[layer, :4]), 2)
        spreads = f"between {found.between[layer]:.2f}, within {found.within[layer]:.2f}"
        print(
            f"  {'+'.join(names)}: long-term c {middle:.2f} kPa; at {SITES} after a second {sites};", end=" "
        )
        print(f"{spreads}, force {found.effects[layer, 4]:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="keeps simulations")
    parser.add_argument("--data", type=Path, default=DATA, help="the table of measurements")
    parser.add_argument("--outline", choices=tuple(OUTLINES), default="square", help="of the probe")
    parser.add_argument("--m", type=float, default=M, help="exponent of Ogden's law")
    parser.add_argument("--folds", type=int, default=66, help="66: everybody alone")
    parser.add_argument("--check", action="store_true", help="against the solver at ten people")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    footprint, runs, seed = OUTLINES[options.outline]
    design = SolvedDesign.simulate(
        footprint,
        THREE.legs(options.data).thickness_mm,
        runs,
        options.folder / f"{options.outline}.npz",
        seed,
    )
    off = design.leave_out(footprint)
    print(f"interpolation, a simulation left out: {np.round(off, 2)} mm (root mean square)", flush=True)
    probe = SolvedFootprint(footprint, design, options.m)
    for model in (TWO, THREE):
        legs, name = model.legs(options.data), ", ".join("+".join(layer) for layer in model.layers)
        found = fit(legs, probe, model.known, STILL)
        constants(found, model)
        if options.check and model is THREE:
            check(probe, footprint, legs, found)
        report(name, legs, predict_held_out(legs, probe, model.known, options.folds, DRAWS, STILL))


if __name__ == "__main__":
    main()
