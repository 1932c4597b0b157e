"""What is known of people's tissues beforehand: values of the literature, and lognormal priors of c and m.

The priors of Ogden's parameters are as ``benchmarks/population.py`` made them.

The tissues of people are ``skin``, ``fat``, ``skin_fat`` (skin with its fat, one layer) and ``muscle``. Of a
skin without its fat no c is known: its compression does not tell. How the priors came about: docs/priors.md.
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError

POPULATION = Path(__file__).with_name("population.toml")
SOURCE = "65 people of the MULTIS study (doi 10.18735/S5R97F); m: values of the literature"
NONE = "none"


def _read(file: Path) -> dict[str, Any]:
    return tomllib.loads(file.read_text(encoding="utf-8"))


LITERATURE: tuple[dict[str, Any], ...] = tuple(_read(Path(__file__).with_name("literature.toml"))["values"])
PRIORS: dict[str, dict[str, dict[str, Any]]] = _read(POPULATION)["prior"]
TISSUES = tuple(PRIORS)


def of_tissues(
    tissues: Sequence[str], stated: Mapping[str, str] | None = None
) -> dict[str, tuple[float, float]]:
    """Median and factor of the priors of a model's parameters, by names such as ``muscle.c_kPa``.

    Parameters
    ----------
    tissues : of the model. One that is called like a tissue of people is that; ``skin`` is skin with its fat
        where no other tissue is called or stated to be fat.
    stated : which tissue of people another one is, or ``"none"``.

    Raises
    ------
    InputError
        For a tissue of another name that is not stated, and for names that are not known.
    """
    stated = dict(stated or {})
    known = {*TISSUES, NONE}
    for name, kind in stated.items():
        if name not in tissues:
            raise InputError(f"the model has no tissue {name!r}", remedy=f"use {', '.join(tissues)}")
        if kind not in known:
            raise InputError(f"{kind!r} is no tissue of people", place=name, remedy=f"use {_list_names()}")
    kinds = {name: stated.get(name, name) for name in tissues}
    strange = [name for name, kind in kinds.items() if kind not in known]
    if strange:
        raise InputError(f"which tissue of people is {strange[0]!r}", remedy=f"state {_list_names()} for it")
    if "fat" not in (*tissues, *kinds.values()):  # a layer of fat is one, whatever is known of it
        kinds |= {name: "skin_fat" for name, kind in kinds.items() if kind == "skin" and name not in stated}
    return {
        f"{name}.{key}": (prior["median"], prior["factor"])
        for name, kind in kinds.items()
        if kind != NONE
        for key, prior in PRIORS[kind].items()
    }


def _list_names() -> str:
    return ", ".join(f'"{name}"' for name in (*TISSUES, NONE))
