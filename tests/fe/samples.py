"""Sample materials, and their energies written a second time, from invariants, to be held against."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from limbfit.fe import Material, MooneyRivlin, NeoHookean, Ogden, OgdenPower, OgdenQLV
from limbfit.fe.kernel.response import evaluate_law, invert, principal_axes, stress_rates
from limbfit.fe.lanes import LANES, workspace

SIX = ((0.004, 4.8), (0.003, -4.8), (-0.001, 2.5), (0.002, -1.7), (0.0005, 9.0), (0.0015, 0.7))
SAMPLES: dict[str, Material] = {
    "paper": OgdenQLV(0.00522, 4.79, 3.57, 0.32),
    "two times": OgdenQLV(0.006, 5.2, (2.1, 0.8), (0.08, 1.7)),
    "power": OgdenPower(0.0045, 4.6, 0.4, 0.22, (0.05, 0.5, 5.0, 50.0, 500.0)),
    "ogden": Ogden(SIX, ((2.0, 0.1), (0.7, 0.9), (0.4, 6.0)), 120.0, "nike3d"),
    "neo-hookean": NeoHookean(0.005, ((1.5, 0.3), (0.5, 2.0)), 80.0, "abaqus"),
    "mooney-rivlin": MooneyRivlin(0.003, -0.0006, ((1.2, 0.4),), 100.0, "abaqus-goh"),
    "elastic": MooneyRivlin(0.001, 0.002),
}


def moved(material: Material, values: NDArray) -> Material:
    """The material with other values of its parameters, in their order."""
    return material.with_parameters(dict(zip(material.parameter_names, values)))


def energy(material: Material, stretches: NDArray) -> NDArray:
    """Deviatoric strain energy density (...) at principal stretches (..., 3), real or complex; MPa."""
    J = stretches.prod(axis=-1)
    lt = stretches * J[..., None] ** (-1 / 3)
    first, second = (lt**2).sum(axis=-1) - 3, (lt**-2.0).sum(axis=-1) - 3
    if isinstance(material, NeoHookean):
        return material.mu / 2 * first
    if isinstance(material, MooneyRivlin):
        return material.c1 * first + material.c2 * second
    if isinstance(material, OgdenQLV | OgdenPower):
        c, m = material.c, material.m
        return c / m**2 * (lt**m + lt**-m - 2).sum(axis=-1)
    return sum(c / m**2 * ((lt**m).sum(axis=-1) - 3) for c, m in material.terms)


def volume_energy(law: str, kappa: float, J: NDArray) -> NDArray:
    """U(J) of each volumetric law, as its source writes it; MPa."""
    if law == "log":
        return kappa / 2 * np.log(J) ** 2
    if law == "nike3d":
        return kappa / 4 * (J**2 - 2 * np.log(J) - 1)
    if law == "abaqus":
        return kappa / 2 * (J - 1) ** 2
    return kappa / 2 * ((J**2 - 1) / 2 - np.log(J))


def kirchhoff(material: Material, stretches: NDArray) -> NDArray:
    """Deviatoric principal Kirchhoff stresses (..., 3): ``dW/d ln lambda_i`` by complex steps; MPa."""
    steps = np.exp(1e-30j * np.eye(3))
    return np.stack([energy(material, stretches * step).imag for step in steps], axis=-1) / 1e-30


def slopes(material: Material, stretches: NDArray) -> NDArray:
    """``d2W/de_i^2`` (..., 3) of a sum of Ogden terms; MPa."""
    e = np.log(stretches) - np.log(stretches).mean(axis=-1, keepdims=True)
    return sum(c * np.exp(m * e) for c, m in material.table().terms)


def quotients(material: Material, c2: NDArray) -> NDArray:
    """``(beta_i - beta_j)/(c2_i - c2_j)`` for ij = 12, 20, 01 of a sum of Ogden terms; MPa.

    A difference quotient is the mean of the derivative over the interval, here by Gauss's rule.
    """
    x, w = np.polynomial.legendre.leggauss(100)
    found = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        between = c2[i] + (c2[j] - c2[i]) * (x + 1) / 2
        e = 0.5 * np.log(between) - np.log(c2).sum() / 6
        slope = sum(c * np.exp(m * e) for c, m in material.table().terms)
        found.append((w / 2 * slope / (2 * between)).sum())
    return np.array(found)


@njit
def _respond(points, law, numbers, rates):
    invert(points[0])
    principal_axes(points[0])
    evaluate_law(points[0], law[0], numbers)
    stress_rates(points[0], law[0], numbers, rates)


def point(material: Material, F: NDArray):
    """The kernels' POINT, and RATEs, of deformation gradients (lanes, 3, 3), or of one in all lanes."""
    table = material.table()
    points, law, numbers, *_, rates = workspace(1, 1, len(table.numbers))
    law["response"], law["rates"] = np.array(table.elastic.addresses)[:, None, None]
    numbers["v"] = table.numbers[:, None]
    points["F"] = np.moveaxis(np.broadcast_to(F, (LANES, 3, 3)), 0, -1)
    _respond(points, law, numbers, rates)
    return points[0], rates


def pressure(law: str, kappa: float, J: NDArray) -> NDArray:
    """``U'(J)`` by a complex step; MPa."""
    return volume_energy(law, kappa, J + 1e-30j).imag / 1e-30


def relaxed(material: Material, times: NDArray, stretches: NDArray) -> NDArray:
    """Deviatoric second Piola-Kirchhoff stresses (n, 3) over a history of stretches (n, 3) from rest.

    ``Se(t) + sum_l g_l int exp(-(t - s)/tau_l) dSe(s)`` by the midpoint rule on the given (fine) times.
    """
    Se = kirchhoff(material, stretches) / stretches**2
    change, middle = np.diff(Se, axis=0), 0.5 * (times[1:] + times[:-1])
    total = Se.copy()
    for g, tau in material.prony:
        kernel = np.exp(-np.clip(times[1:, None] - middle[None, :], 0.0, None) / tau)
        total[1:] += g * np.tril(kernel) @ change
    return total
