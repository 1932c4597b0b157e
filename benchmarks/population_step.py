"""From the apparent modulus of a layer to the constant c of Ogden's law: what linear theory makes of a limb.

A block of median layers with known c is pressed by limbfit's own solver, at large strains, to the median
force, and its layers' compressions are read with linear theory as those of people are. What comes out over c
is the error of linear theory and the stiffening of the law together. Time is treated in closed form.
"""

from dataclasses import dataclass

import numpy as np
import pyvista as pv
from layer_compressions import Footprint, Layers
from numpy.typing import NDArray
from scipy.optimize import least_squares

from limbfit import History, Indenter, Mesh, OgdenQLV, Problem, solve
from limbfit.mesh import to_tet10

Array = NDArray[np.float64]

LAYERS_MM = (8.5, 38.0)  # medians: skin with its fat, muscle
C_MPA = 0.006  # of both, viscosity included: with it the median force presses as deep as people were pressed
EDGES_MM = np.array([0.0, 4.0, 8.0, 11.0, 13.5, 17.0, 23.0, 34.0, 50.0, 70.0])  # across, from the middle
DEEPER = 0.22  # of the thickness: beyond the median force for every m
ROUNDING_MM = 2.0


@dataclass(frozen=True)
class Step:
    """``apparent_over_c`` (l,) at the median force, and the exponent of the force with which it rises."""

    m: float
    apparent_over_c: Array
    rise: Array


def large_strains(m: float, force_N: float, width_mm: float) -> Step:
    """What linear theory says of a block with exponent m under a square of ``width_mm`` at a force."""
    side = np.r_[-EDGES_MM[:0:-1], EDGES_MM]
    skin, depth = LAYERS_MM[0], sum(LAYERS_MM)
    z = -np.r_[np.linspace(depth, skin, 7)[:-1], np.linspace(skin, 0.0, 4)]
    grid = pv.RectilinearGrid(side, side, z).to_tetrahedra()
    grid["layer"] = np.where(grid.cell_centers().points[:, 2] > -skin, "outer", "inner")
    mesh = to_tet10(Mesh.from_pyvista(grid, "layer"))
    tissue = OgdenQLV(c=C_MPA, m=m, gamma=0.01, tau=0.01)
    problem = Problem(
        mesh,
        {"outer": tissue, "inner": tissue},
        mesh.nodes_where(lambda p: p[:, 2] < 1e-3 - depth),
        mesh.faces_where(lambda p: p[:, 2] > -1e-3),
        Indenter("square", width_mm, ROUNDING_MM, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
        History(np.array([0.0, 10.0]), np.array([0.0, DEEPER * depth])),
    )
    found = solve(problem)
    if found.force[-1] < 1.15 * force_N:
        raise RuntimeError(f"m = {m}: {found.force[-1]:.2f} N at {DEEPER * depth:.1f} mm; press deeper")
    interface = [
        int(np.argmin(np.linalg.norm(mesh.points - [0, 0, height], axis=1))) for height in (0, -skin)
    ]
    down = np.array(
        [-found.to_pyvista(k)["displacement_mm"][interface, 2] for k in range(1, len(found.force))]
    )
    pressed = np.stack([down[:, 0] - down[:, 1], down[:, 1]], axis=1)
    near = force_N * np.array([0.85, 1.0, 1.15])
    seen = np.stack([np.interp(near, found.force[1:], one) for one in pressed.T], axis=1)
    under = Layers.under(Footprint(width_mm, width_mm), np.array([LAYERS_MM]))
    logs = np.array([_read(under, force, one) for force, one in zip(near, seen, strict=True)])
    return Step(m, np.exp(logs[1]) / C_MPA, (logs[2] - logs[0]) / np.log(near[2] / near[0]))


def _read(under: Layers, force_N: float, pressed: Array) -> Array:
    """log of the moduli (l,) with which linear theory gives these compressions (l,)."""

    def off(logs: Array) -> Array:
        return np.asarray(np.log(force_N * under.compressions(np.exp(logs[None]))[0] / pressed))

    return np.asarray(least_squares(off, np.full(len(pressed), np.log(C_MPA))).x)


def slow_share(
    gamma: float, tau_s: float, seconds: float, factors: tuple[float, float, float]
) -> tuple[float, float]:
    """Mean and standard deviation of log(G / c), G the modulus seen at the end of a ramp.

    A ramp of T seconds on a tissue with c (1 + gamma e^(-t / tau)) ends at c (1 + gamma (1 - e^(-x)) / x),
    x = T / tau; gamma, tau and T are lognormal about the given with ``factors``.
    """
    drawn = np.random.default_rng(0).standard_normal((3, 100_000)) * np.log(factors)[:, None]
    g, t, T = np.exp(drawn) * np.array([gamma, tau_s, seconds])[:, None]
    logs = np.log1p(g * -np.expm1(-T / t) * t / T)
    return float(logs.mean()), float(logs.std())
