"""The friction of contact as a study states it."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator


def _check(value: Any) -> Any:
    """One line for all that it cannot be, instead of one for each kind of value."""
    number = isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value < math.inf
    if not number and value not in ("frictionless", "sticky"):
        raise ValueError(f'{value!r} is not "frictionless", "sticky" or a coefficient from 0 on')
    return value


Friction = Annotated[Literal["frictionless", "sticky"] | float, BeforeValidator(_check)]
