"""Numbers, times and vectors as cells of a table."""

from __future__ import annotations

from typing import Any

from ..laws import ACTIVE, split_key
from .page import Cell

NOTHING = "–"
_GREEK = {
    "alpha": "α",
    "beta": "β",
    "gamma": "γ",
    "delta": "δ",
    "eta": "η",
    "kappa": "κ",
    "mu": "μ",
    "tau": "τ",
}
_BELOW = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def number(value: Any, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent where a person can do without."""
    if not isinstance(value, int | float) or value != value:
        return NOTHING
    if value in (float("inf"), float("-inf")):
        return "∞" if value > 0 else "−∞"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        text = f"{value:#.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}".replace(",", " ")
        return text.rstrip(".").replace("-", "−")
    return f"{value:.{digits - 1}e}".replace("-", "−")


def fixed(value: Any, decimals: int = 1) -> str:
    """A number to so many decimals."""
    if not isinstance(value, int | float) or value != value:
        return NOTHING
    return f"{value:.{decimals}f}".replace("-", "−")


def symbol(key: str) -> str:
    """A parameter as formulas write it: ``tau_s`` is τ, ``tau2_s`` τ₂."""
    name, _ = split_key(key)
    letter = name.rstrip("0123456789")
    return _GREEK.get(letter, letter) + name[len(letter) :].translate(_BELOW)


def label(name: str) -> str:
    """``skin.c_kPa`` as ``skin c``."""
    tissue, _, kind = name.rpartition(".")
    return f"{tissue} {symbol(kind)}".strip()


def unit_of(key: str) -> str:
    """Its unit: ``tau_s`` is in s."""
    return split_key(key)[1] or NOTHING


def duration(seconds: Any) -> str:
    """Seconds as a person says them."""
    if not isinstance(seconds, int | float):
        return NOTHING
    if seconds < 90:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 90:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def vector(values: Any) -> str:
    return ", ".join(fixed(value) for value in values) if values else NOTHING


def friction(value: Any) -> str:
    """How contact is, by the study's key: a word, or a coefficient."""
    return value if isinstance(value, str) else f"with friction of coefficient {number(value)}"


def held(clamps: dict[str, Any] | None, material: dict[str, Any]) -> str:
    """What moved the limb before the indenter touched, by the study's tables; nothing where nothing did."""
    parts = []
    if clamps:
        waited = clamps["clamping_s"] + clamps["settling_s"]
        parts.append(
            f"pins of {clamps['width_mm']} mm clamped it with {clamps['force_N']} N each for {waited} s"
        )
    if material.get("law") == ACTIVE:
        parts.append("muscle contracted")
    taut = ", ".join(f"{tissue} by {stretch}" for tissue, stretch in material.get("prestretch", {}).items())
    if taut:
        parts.append(f"tissue was pre-stretched ({taut})")
    return f"Before the indenter touched the limb, {' and '.join(parts)}." if parts else ""


def numeric(text: str, share: float | None = None) -> Cell:
    """A cell that holds a number."""
    return Cell(text, number=True, share=share)


def heading(text: str) -> Cell:
    """The cell that a row begins with."""
    return Cell(text, header=True)
