"""The lognormal priors of `calibration.priors = "population"`, from the legs of people.

    python benchmarks/population.py                     # the figures, and how held-out persons are predicted
    python benchmarks/population.py --write             # and the package's table

Reads shared/data/multis (65 people under an ultrasound probe) and the package's table of literature values.
How it is done, with what assumptions and results: docs/priors.md.
"""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from layer_compressions import Footprint
from numpy.typing import NDArray
from population_fit import FORCE_N, SITES, Coverage, Fit, Known, Legs, coverage, fit, read_legs
from population_step import Step, large_strains, slow_share

from limbfit.priors import LITERATURE, POPULATION

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "multis" / "measurements.csv"
SQUARE = Footprint(np.sqrt(675.0), np.sqrt(675.0))  # of the stated area, 675 mm2
OBLONG = Footprint(45.0, 15.0)  # the other outline of that area that a probe may have
LOWER_LEG = [SITES.index("LL_A"), SITES.index("LL_P")]
SKIN = Known(0, 0.020, np.log(2.5))  # what its compression does not tell: of the literature's compliant half
# Stated, not measured: the ramp lasts about a second (the source's rates have no unit), viscosity is as sure.
RAMP_S, RAMP_FACTOR, VISCOUS_FACTOR = 1.0, 2.0, 1.5
SHAPE_FACTOR = 1.25  # a leg is no flat layer on flat bone


@dataclass(frozen=True)
class Model:
    """The layers of a fit, outermost first, each of one or several of those measured; what is not fitted."""

    layers: tuple[tuple[str, ...], ...]
    known: tuple[Known, ...] = ()

    def legs(self, file: Path) -> Legs:
        return read_legs(file, self.layers)


TWO = Model((("skin", "fat"), ("muscle",)))
THREE = Model((("skin",), ("fat",), ("muscle",)), (SKIN,))
FROM = {
    "skin_fat": (TWO, 0),
    "fat": (THREE, 1),
    "muscle": (TWO, 1),
}  # the layer of which fit gives which prior


def apparent(found: Fit, other: Fit, layer: int, force_log_sd: float) -> dict[str, Any]:
    """What a fit says of a layer, beside the fit with the other outline of the probe."""
    sites = {name: round(float(1e3 * np.exp(found.effects[layer, i])), 2) for i, name in enumerate(SITES)}
    outline = np.mean((other.effects - found.effects)[layer, LOWER_LEG])
    return {
        "kPa": sites,
        "force_exponent": round(float(found.effects[layer, 4]), 3),
        "between_persons": round(float(found.between[layer]), 3),
        "within_person": round(float(found.within[layer]), 3),
        "between_sites": round(float(np.std(found.effects[layer, :4], ddof=1)), 3),
        "by_force": round(abs(float(found.effects[layer, 4])) * force_log_sd, 3),
        "by_outline": round(abs(float(outline)), 3),
    }


def exponent() -> dict[str, Any]:
    """The prior of m: its median of the studies of people with Ogden's law.

    These are two, too few to tell how far studies differ, so the spread is that of all four studies, animals
    included: each is one draw of a lognormal.
    """
    exponents: dict[str, list[float]] = {}
    people = []
    for one in LITERATURE:
        if "m" in one:
            exponents.setdefault(one["citation"], []).append(np.log(one.get("m_of_pair", one["m"])))
            people += exponents[one["citation"]][-1:] if "m" in one.get("used", ()) else []
    spread = np.std([np.mean(logs) for logs in exponents.values()], ddof=1) * np.sqrt(1 + 1 / len(people))
    return {"median": round(float(np.exp(np.mean(people))), 2), "factor": round(float(np.exp(spread)), 2)}


def viscosity() -> tuple[float, float]:
    """Mean and deviation of log(modulus at the end of the ramp / c)."""
    (one,) = (one for one in LITERATURE if "gamma" in one.get("used", ()))
    factors = (VISCOUS_FACTOR, VISCOUS_FACTOR, RAMP_FACTOR)
    return slow_share(one["gamma"], one["tau_s"], RAMP_S, factors)


def steps() -> dict[str, dict[str, Any]]:
    """By prior: apparent modulus over c at the median of m, its deviation over m, its rise with the force."""
    m = exponent()
    ends = [m["median"] / m["factor"], m["median"], m["median"] * m["factor"]]
    low, middle, high = (large_strains(value, FORCE_N, SQUARE.width_mm) for value in ends)
    return {
        name: _step(low, middle, high, min(layer, 1))
        for name, layer in (("skin_fat", 0), ("fat", 0), ("muscle", 1))
    }


def _step(low: Step, middle: Step, high: Step, layer: int) -> dict[str, Any]:
    ratio = [one.apparent_over_c[layer] for one in (low, middle, high)]
    return {
        "apparent_over_c": round(float(ratio[1]), 3),
        "by_exponent": round(float(abs(np.log(ratio[2] / ratio[0])) / 2), 3),
        "force_exponent": round(float(middle.rise[layer]), 3),
    }


def constant(seen: Mapping[str, Any], step: Mapping[str, Any]) -> dict[str, Any]:
    """The prior of c in kPa from what is seen of a layer at the lower leg, and the step to the law."""
    slow, slow_sd = viscosity()
    middle = np.mean([np.log(seen["kPa"][SITES[i]]) for i in LOWER_LEG])
    parts = {
        name: seen[name]
        for name in ("between_persons", "within_person", "between_sites", "by_force", "by_outline")
    }
    theory = abs(np.log(step["apparent_over_c"])) / 2  # half of what the solver takes back of linear theory
    parts |= {"by_exponent": step["by_exponent"], "by_theory": theory}
    parts |= {"by_viscosity": slow_sd, "by_shape": np.log(SHAPE_FACTOR)}
    return {
        "median": round(float(np.exp(middle - slow) / step["apparent_over_c"]), 2),
        "factor": round(float(np.exp(np.sqrt(sum(part**2 for part in parts.values())))), 2),
        "deviations_log": {name: round(float(part), 3) for name, part in parts.items()},
    }


def seen_in(file: Path) -> dict[str, dict[str, Any]]:
    """`apparent` of every layer that has a prior."""
    fits: dict[Model, tuple[Fit, Fit, float]] = {}
    for model in (TWO, THREE):
        legs = model.legs(file)
        spread = float(np.std(np.log(legs.force_N)))
        fits[model] = fit(legs, SQUARE, model.known), fit(legs, OBLONG, model.known), spread
    return {name: apparent(*fits[model][:2], layer, fits[model][2]) for name, (model, layer) in FROM.items()}


def table(seen: Mapping[str, Any], step: Mapping[str, Any]) -> dict[str, Any]:
    """What the package stores."""
    m = exponent()
    priors: dict[str, Any] = {"skin": {"m": m}}
    priors |= {name: {"c_kPa": constant(seen[name], step[name]), "m": m} for name in FROM}
    return {"prior": priors, "apparent": dict(seen), "step": dict(step)}


def covered(file: Path) -> dict[str, Coverage]:
    """How held-out persons are predicted: by the layers of each model."""
    return {
        "+".join("_".join(layer) for layer in model.layers): coverage(model.legs(file), SQUARE, model.known)
        for model in (TWO, THREE)
    }


def toml(content: Mapping[str, Any]) -> str:
    """Tables of tables of values as TOML."""
    return "\n".join(
        f"[{section}.{name}]\n" + "".join(f"{key} = {_value(value)}\n" for key, value in values.items())
        for section, tables in content.items()
        for name, values in tables.items()
    )


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(part)}" for key, part in value.items()) + " }"
    return f'"{value}"' if isinstance(value, str) else repr(value)


HEAD = "# Made by benchmarks/population.py (docs/priors.md). Deviations are of logarithms, moduli in kPa.\n\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="the table of measurements")
    parser.add_argument("--write", action="store_true", help="write the package's table")
    options = parser.parse_args()
    for name, one in covered(options.data).items():
        shares = ", ".join(f"{100 * share:.1f}" for share in one.layers)
        print(f"held-out persons, {name}: {100 * one.all:.1f} % ({shares}), sum {100 * one.whole:.1f} %")
    made = HEAD + toml(table(seen_in(options.data), steps()))
    print(made)
    if options.write:
        POPULATION.write_text(made, encoding="utf-8")


if __name__ == "__main__":
    main()
