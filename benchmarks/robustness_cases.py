"""The limbs, indenters and materials of `robustness.py`: a case follows from its seed and number alone."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from driven_cases import driven
from mapped_bodies import Array, Body, limb, slab

from limbfit.fe import History, Indenter, OgdenQLV, Problem, RigidSurface
from limbfit.study import MaterialTable

SITES = (
    "slab-mid", "slab-slanted", "slab-thin", "ridge-edge", "ridge-thin", "limb-mid", "limb-slanted",
    "limb-thin", "limb-edge", "twin-thin", "twin-between",
)  # fmt: skip
ELEMENT = "tet10p0"  # the default of studies
FARTHEST_MM = 30.0  # travel to the bone that is taken where the indenter would pass it by


@dataclass(frozen=True)
class Asked:
    """What every case is solved with: an element, and whether it is one of `driven_cases`."""

    element: str = ELEMENT
    driven: bool = False


USUAL = Asked()  # an indentation and no more, with the element of studies


@dataclass(frozen=True)
class Case:
    """A drawn case: the body's measures, the indenter and the parameters (kPa, -, -, s); lengths in mm."""

    number: int
    site: str
    tool: str
    body: dict[str, float]
    width: float
    tilt: tuple[float, float]
    depth_share: float
    speed: float
    parameters: dict[str, dict[str, float]]


def frustum(width: float, sides: int, slope_mm: float) -> RigidSurface:
    """A regular prism of triangles, ``width`` mm across, 40 mm long, wider by ``slope_mm`` at its far end."""
    turn = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    front = np.column_stack([0.5 * width * ring, np.zeros(sides)])
    back = np.column_stack([(0.5 * width + slope_mm) * ring, np.full(sides, -40.0)])
    i, after = np.arange(1, sides - 1), np.roll(np.arange(sides), -1)
    fan = np.column_stack([np.zeros_like(i), i, i + 1])
    side = np.arange(sides)
    walls = np.vstack(
        [np.column_stack([side, side + sides, after]), np.column_stack([after, side + sides, after + sides])]
    )
    return RigidSurface(np.vstack([front, back]), np.vstack([fan, fan[:, ::-1] + sides, walls]))


# Indenters by name: width and a generator to the fields of `Indenter`.
TOOLS: dict[str, Callable[[float, np.random.Generator], dict[str, Any]]] = {
    "square-sharp": lambda width, rng: {"shape": "square", "width": width},
    "square-rounded": lambda width, rng: {
        "shape": "square", "width": width, "edge_radius": width * rng.uniform(0.05, 0.3),
    },
    "sphere": lambda width, rng: {"shape": "sphere", "width": width},
    "cylinder": lambda width, rng: {
        "shape": "cylinder", "width": width, "edge_radius": width * rng.choice([0.0, 0.1]),
    },
    "surface": lambda width, rng: {
        "shape": "stl", "surface": frustum(width, int(rng.integers(3, 9)), rng.uniform(0.0, 3.0)),
        "edge_radius": rng.choice([0.0, 0.05]) * width,
    },
}  # fmt: skip


def draw(seed: int, number: int) -> Case:
    """Case ``number`` of the set ``seed``; it does not depend on the others."""
    rng = np.random.default_rng([seed, number])
    site = SITES[number % len(SITES)]
    tool = list(TOOLS)[rng.integers(len(TOOLS))]
    thin = rng.uniform(4.0, 8.0) if "thin" in site or "edge" in site else rng.uniform(8.0, 25.0)
    slant = rng.uniform(8.0, 20.0) if "slanted" in site else rng.uniform(0.0, 4.0)
    return Case(
        number=number,
        site=site,
        tool=tool,
        body=_measures(site, thin, rng),
        width=float(rng.choice([20.0, 20.0, rng.uniform(10.0, 25.0)])),
        tilt=(float(np.radians(slant)), float(rng.uniform(0.0, 2.0 * np.pi))),
        depth_share=float(rng.uniform(0.1, 0.6)),
        speed=float(rng.uniform(0.46, 1.46)),  # 0.96 +- 0.5 mm/s, the source paper's section 2.1
        parameters={tissue: _parameters(rng) for tissue in ("skin", "muscle")},
    )


def _parameters(rng: np.random.Generator) -> dict[str, float]:
    """One tissue, logarithmically even over the bounds of the calibration."""
    bounds = MaterialTable()
    ends = [(bounds.lower[name], bounds.upper[name]) for name in bounds.keys]
    return {name: float(np.exp(rng.uniform(*np.log(end)))) for name, end in zip(bounds.keys, ends)}


def _measures(site: str, thin: float, rng: np.random.Generator) -> dict[str, float]:
    """The measures of the body under a site; see `slab` and `limb`."""
    layer = rng.uniform(1.0, 4.0)
    if site.startswith(("slab", "ridge")):
        ridge = rng.uniform(8.0, 20.0) if site.startswith("ridge") else 0.0
        edge = {"ridge-edge": rng.uniform(-4.0, 4.0), "ridge-thin": -12.0}.get(site, 0.0)
        return {"thickness": thin + ridge, "layer": layer, "ridge": ridge, "edge": edge}
    bone = rng.uniform(7.0, 14.0)
    radius = bone + thin + rng.uniform(12.0, 30.0)
    angle = {
        "limb-thin": rng.uniform(-0.2, 0.2), "limb-edge": rng.choice([-1, 1]) * rng.uniform(0.5, 1.0),
        "twin-thin": rng.uniform(-0.2, 0.2), "twin-between": rng.uniform(0.6, 0.9),
    }.get(site, rng.uniform(1.2, np.pi))  # fmt: skip
    values = {"radius": radius, "bone": bone, "thin": thin, "taper": rng.uniform(0.0, 0.4)}
    values |= {"layer": layer, "angle": float(angle)}
    if site.startswith("twin"):
        second = rng.uniform(4.0, 7.0)
        away = bone + second + rng.uniform(4.0, 8.0)
        values |= {"second_radius": second, "second_away": away, "second_angle": rng.uniform(1.5, 1.9)}
    return values


def body_of(case: Case) -> Body:
    inner, b = 0.5 * case.width + 2.0, case.body
    if case.site.startswith(("slab", "ridge")):
        count = 2 if b["thickness"] < 10.0 else 3
        half = inner + 10.0 + b["thickness"]
        return slab(b["thickness"], b["layer"], inner, half, b["ridge"], b["edge"], count)
    second = None
    if "second_radius" in b:
        second = (b["second_radius"], b["second_away"], b["second_angle"])
    measures = (b["radius"], b["bone"], b["thin"], b["taper"], b["layer"], b["angle"])
    return limb(*measures, inner, 3 if second else 2, second)


def problem_of(case: Case, seed: int, asked: Asked = USUAL) -> Problem:
    """The case as a problem: loading to the drawn depth and unloading at the same speed, or as `driven`."""
    body = body_of(case)
    rng = np.random.default_rng([seed, case.number, 1])
    centre, axis = body.site - 10.0 * body.inward, _tilted(body.inward, *case.tilt)
    tool = Indenter(centre=centre, axis=axis, **TOOLS[case.tool](case.width, rng))
    points = body.mesh.points
    faces = body.mesh.face_sets["skin"]
    travel = advance(tool, points[body.bone]) - advance(tool, points[np.unique(faces)])
    depth = case.depth_share * min(travel, FARTHEST_MM)
    reach = 0.71 * case.width + depth + 8.0
    near = np.linalg.norm(points[faces[:, :3]].mean(axis=1) - body.site, axis=1) < reach
    duration = depth / case.speed
    problem = Problem(
        mesh=body.mesh,
        materials={tissue: _material(values) for tissue, values in case.parameters.items()},
        fixed=body.held,
        contact_faces=faces[near],
        indenter=tool,
        history=History(np.array([0.0, duration, 2.0 * duration]), np.array([0.0, depth, 0.0])),
        element=asked.element,
        name=f"{case.number} {case.site} {case.tool}",
    )
    return driven(problem, depth, np.random.default_rng([seed, case.number, 2])) if asked.driven else problem


def _material(values: dict[str, float]) -> OgdenQLV:
    return OgdenQLV(1e-3 * values["c_kPa"], values["m"], values["gamma"], values["tau_s"])


def _tilted(axis: Array, angle: float, about: float) -> Array:
    """``axis`` turned by ``angle`` towards the direction ``about`` around it, rad."""
    side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.8 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    towards = np.cos(about) * side + np.sin(about) * np.cross(axis, side)
    return np.cos(angle) * axis + np.sin(angle) * towards


def advance(tool: Indenter, points: Array, farthest: float = 60.0) -> float:
    """How far the indenter can go along its axis, from clear of the points, until it touches one, mm."""
    across = (points - tool.centre) @ tool.frame[:2].T
    ahead = points[np.linalg.norm(across, axis=1) < tool.width]

    def clear(distance: float) -> bool:
        return not len(ahead) or float(tool.move(distance).signed_distance(ahead).min()) > 0.0

    low, step = 0.0, 4.0
    while low < farthest and clear(low + step):
        low += step
    while step > 1e-6:
        step *= 0.5
        low += step if clear(low + step) else 0.0
    return low
