"""Published indentations rebuilt from what their texts state, and their figures beside limbfit's.

    python benchmarks/published_indentations.py              # all four; needs shared/data/multis, or --data
    python benchmarks/published_indentations.py sengeh       # one: sengeh, thighs, bone, sphere

Every input that a text states is a row of `STATED`, with the place where it is stated; what no text states is
varied. Results and what could not be rebuilt: docs/validation.md.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from layer_compressions import Footprint
from numpy.typing import NDArray
from population_fit import SITES, read_legs
from solved_layers import LAYER_MM, layered_quarter, probe_of, quarter_problem

from limbfit.fe import History, Indenter, NeoHookean, Ogden, OgdenQLV, Problem, StepControl, solve
from population import DATA, SQUARE

Array = NDArray[np.float64]

SENGEH = "Sengeh and others 2016, J Mech Behav Biomed Mater 59:379"
FOUGERON = "Fougeron and others 2020, J Biomech Eng 142(9), doi 10.1115/1.4046444"
LU = "Lu and Zheng 2004, Med Biol Eng Comput 42:535"
ODDES = "Oddes and Solav 2023, J Mech Behav Biomed Mater, 105708; github SolavLab/indentify"
AFFAGARD = "Affagard and others, in Dao and Ho Ba Tho, Appl Bionics Biomech 2018, 7631818"
# Study, quantity, value, where it is stated.
STATED = (
    (SENGEH, "indenter", "20 x 20 mm, not rounded", "section 2.1.2"),
    (SENGEH, "speed", "0.96 mm/s", "section 2.1.2"),
    (SENGEH, "skin and fat", "3 mm", "section 2.2.1"),
    (SENGEH, "skin: c, m, gamma, tau", "5.22 kPa, 4.79, 3.57, 0.32 s", "table 1"),
    (SENGEH, "muscle: c, m, gamma, tau", "5.20 kPa, 4.78, 3.47, 0.34 s", "table 1"),
    (
        SENGEH,
        "tibia (taken for site 2): depth, peak force",
        "3.5 mm, 8.1 N",
        "section 3.2, figure 7, table 2",
    ),
    (
        SENGEH,
        "posterior wall (taken for site 17): depth, peak force",
        "7 mm, 12.21 N",
        "section 3.2, figure 7, table 2",
    ),
    (SENGEH, "lower leg, elastography: shear modulus", "3.73 to 7.53 kPa; 4.13 kPa", "section 4"),
    (FOUGERON, "thigh, relaxed: Ogden's modulus and exponent", "3.2 +- 1.3 kPa, 10 +- 1", "abstract"),
    (AFFAGARD, "thigh: C10, softest and stiffest muscle", "1.75, 3.75 kPa", "table 2"),
    (LU, "Poisson's ratio", "0.45", "abstract"),
    (LU, "error of Young's modulus at a/h = 1, bone's curvature a/R from 0 to 0.38", "21.2 %", "abstract"),
    (LU, "error at a/R = 0.18, a/h from 0.2 to 2", "6.0 to 18.2 %", "abstract"),
    (ODDES, "cylinder: radius, height", "60, 60 mm", "AxisymIndent_main.m"),
    (ODDES, "sphere: radius; depth", "15 mm; 10 mm", "AxisymIndent_main.m, runIndentation.m"),
    (ODDES, "law, moduli, exponents", "Ogden, 1 to 51 kPa, 1 to 37", "AxisymIndent_main.m, README"),
    (ODDES, "bulk modulus over the shear modulus", "1000", "AxisymIndent_main.m"),
)
THICKNESSES_MM = (6.0, 9.0, 13.0, 20.0, 35.0, 60.0)  # of all tissue, where a text states none
SPEED_MM_S, SKIN_MM = 0.96, 3.0
PEAKS = {"tibia": (3.5, 8.1), "posterior wall": (7.0, 12.21)}  # depth in mm, force in N
CURVED = ((1.0, 0.38, "21.2"), (0.2, 0.18, "6.0"), (2.0, 0.18, "18.2"))  # a/h, a/R, error in %
RAMP_S = 1.0  # of the hand-held probe, stated nowhere (docs/priors.md)
INCOMPRESSIBLE = 100.0


def peak_force(problem: Problem, steps: int = 7) -> float:
    """N, of the whole; the problem is a quarter."""
    result = solve(problem, StepControl(load_steps=steps))
    if not result.completed:
        raise RuntimeError(result.reason)
    return 4.0 * float(result.force[-1])


def rebuild_sengeh(data: Path) -> None:
    """How thick a flat layer has to be for their tissue to give their force."""
    skin = OgdenQLV(c=5.22e-3, m=4.79, gamma=3.57, tau=0.32)
    muscle = OgdenQLV(c=5.20e-3, m=4.78, gamma=3.47, tau=0.34)
    square = Footprint(20.0, 20.0)
    indenter = replace(probe_of(square), edge_radius=0.0)
    for name, (depth, stated) in PEAKS.items():
        thick = [h for h in THICKNESSES_MM if depth < 0.6 * h]
        history = History(np.array([0.0, depth / SPEED_MM_S]), np.array([0.0, depth]))
        forces = []
        for h in thick:
            mesh, _ = layered_quarter(np.array([SKIN_MM, h - SKIN_MM]), square)
            forces.append(
                peak_force(quarter_problem(mesh, {"layer1": skin, "layer2": muscle}, indenter, history))
            )
        fits = np.exp(np.interp(-np.log(stated), -np.log(forces), np.log(thick)))
        told = ", ".join(f"{h:g} mm {force:.1f} N" for h, force in zip(thick, forces, strict=True))
        print(f"{name}: {told}; stated {stated} N, as of {fits:.1f} mm", flush=True)


def one_term(modulus_kPa: float, exponent: float) -> Ogden:
    """Ogden's first order of that shear modulus: 2 mu / m^2 in front, c is twice the modulus."""
    return Ogden(((2e-3 * modulus_kPa, exponent),), (), kappa_ratio=INCOMPRESSIBLE)


def rebuild_thighs(data: Path) -> None:
    """What published tissue makes of the median leg of 65 other people under the median force."""
    legs = read_legs(data, (("skin", "fat", "muscle"),))
    sengeh = OgdenQLV(c=5.2e-3, m=4.78, gamma=3.47, tau=0.34)
    tissues = {
        "LL": {
            "Sengeh": sengeh,
            "elastography, 3.73 kPa": NeoHookean(3.73e-3),
            "elastography, 7.53 kPa": NeoHookean(7.53e-3),
        },
        "UL": {
            "Fougeron": one_term(3.2, 10.0),
            "Fougeron, 1.9 kPa": one_term(1.9, 10.0),
            "Fougeron, 4.5 kPa": one_term(4.5, 10.0),
            "Affagard, softest": NeoHookean(3.5e-3),
            "Affagard, stiffest": NeoHookean(7.5e-3),
        },
    }
    for number, site in enumerate(SITES):
        of = legs.of(legs.site == number)
        thickness, force = float(np.median(of.thickness_mm)), float(np.median(of.force_N))
        strain = of.compression_mm[:, 0] / of.thickness_mm[:, 0]
        low, middle, high = 100 * np.quantile(strain, [0.05, 0.5, 0.95])
        print(f"{site}: {thickness:.0f} mm, {force:.1f} N; measured {middle:.0f} % ({low:.0f} to {high:.0f})")
        upper = np.ceil(thickness / LAYER_MM / 3.0) * LAYER_MM  # of two layers of one tissue, meshed evenly
        mesh, axis = layered_quarter(np.array([upper, thickness - upper]), SQUARE)
        history = History(np.array([0.0, RAMP_S]), force=np.array([0.0, force / 4]))
        for name, tissue in tissues[site[:2]].items():
            problem = quarter_problem(
                mesh, dict.fromkeys(mesh.region_names, tissue), probe_of(SQUARE), history
            )
            result = solve(problem, StepControl(load_steps=7), store="all")
            down = -result.states[-1].u[axis[0], 2]
            print(
                f"  {name}: {100 * down / thickness:.0f} %",
                "" if result.completed else "(not to the end)",
                flush=True,
            )


def rebuild_bone(data: Path) -> None:
    """How much softer tissue over a curved bone is than over a flat one; a may be a radius or a diameter."""
    for over_thickness, over_bone, stated in CURVED:
        told = []
        for words, radius in (("radius", 10.0), ("diameter", 5.0)):
            a = 10.0
            for bone in ("ball", "rod"):
                flat, curved = (
                    curved_force(radius, a / over_thickness, curvature, bone == "ball")
                    for curvature in (0.0, over_bone / a)
                )
                told.append(f"{100 * (1 - curved / flat):.1f} (a a {words}, bone a {bone})")
        print(
            f"a/h {over_thickness:g}, a/R {over_bone:g}: {', '.join(told)} % less; stated {stated} %",
            flush=True,
        )


def curved_force(radius: float, thickness: float, curvature: float, ball: bool) -> float:
    """Under a flat rod of that radius, mm, pressed by 2 % of the tissue over bone of that curvature, 1/mm."""
    mesh, _ = layered_quarter(np.array([0.4, 0.6]) * thickness, Footprint(2 * radius, 2 * radius))
    x, y, z = mesh.points.T
    across = x**2 + y**2 if ball else y**2
    deeper = np.minimum(0.5 * curvature * across, 4 * thickness + 20.0)
    points = mesh.points + np.column_stack([0 * x, 0 * y, z / thickness * deeper])
    tissue = NeoHookean(5e-3, kappa_ratio=2 * 1.45 / (3 * 0.1))  # Poisson's ratio 0.45
    problem = quarter_problem(
        replace(mesh, points=points),
        dict.fromkeys(mesh.region_names, tissue),
        Indenter("cylinder", 2 * radius, 0.05 * radius),
        History(np.array([0.0, 1.0]), np.array([0.0, 0.02 * thickness])),
    )
    return peak_force(problem, 2)


def rebuild_sphere(data: Path) -> None:
    """What force alone and force with the surface's displacement tell of modulus and exponent."""
    mesh, _ = layered_quarter(np.array([18.0, 42.0]), Footprint(15.0, 15.0))
    tops = np.unique(mesh.face_sets["skin"])
    history = History(np.linspace(0.0, 1.0, 6), np.linspace(0.0, 10.0, 6))
    for c, m in ((10.0, 4.0), (10.0, 10.0)):
        tissue = Ogden(((1e-3 * c, m),), (), kappa_ratio=1000.0)
        problem = quarter_problem(
            mesh, dict.fromkeys(mesh.region_names, tissue), Indenter("sphere", 30.0), history
        )
        result = solve(problem, StepControl(load_steps=6), sensitivities=True, store="all")
        values = np.array([1e-3 * c, m])
        force = joined(result.force_sensitivity) * values / result.force[-1]
        places = [joined(state.sensitivity[tops]).reshape(-1, 2) * values for state in result.states]
        told = (
            4.0 * result.force[-1],
            *(
                deviations(rows)
                for rows in ([force / 0.01], [force / 0.01, *(place / 0.05 for place in places)])
            ),
        )
        print(
            f"c {c:g} kPa, m {m:g}: {told[0]:.1f} N; force alone {told[1]}; with the surface {told[2]}",
            flush=True,
        )


def joined(slopes: Array) -> Array:
    """(..., 2): derivatives with respect to the parameters of both layers, which are one tissue."""
    return np.asarray(slopes[..., :2] + slopes[..., 2:])


def deviations(rows: Sequence[Array]) -> str:
    """Of log c and log m, and their correlation, from derivatives over standard deviations."""
    jacobian = np.vstack(rows)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    sd = np.sqrt(np.diag(covariance))
    return f"c {100 * sd[0]:.1f} %, m {100 * sd[1]:.1f} %, correlation {covariance[0, 1] / sd.prod():+.2f}"


REBUILT: dict[str, Callable[[Path], None]] = {
    "sengeh": rebuild_sengeh,
    "thighs": rebuild_thighs,
    "bone": rebuild_bone,
    "sphere": rebuild_sphere,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("which", nargs="*", choices=[[], *REBUILT], help="by default all")
    parser.add_argument("--data", type=Path, default=DATA, help="the table of measurements")
    options = parser.parse_args()
    for study, quantity, value, place in STATED:
        print(f"{quantity}: {value} ({study}, {place})")
    for name in options.which or REBUILT:
        print(f"\n{name}")
        REBUILT[name](options.data)


if __name__ == "__main__":
    main()
