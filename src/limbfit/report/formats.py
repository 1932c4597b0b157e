"""Numbers, times and parameters as the report writes them; ``format_fixed`` is the filter ``fixed``."""

from typing import Any

from ..laws import split_key

NOTHING = "–"
_GREEK = dict(zip(["alpha", "beta", "gamma", "delta", "eta", "kappa", "mu", "tau"], "αβγδηκμτ", strict=True))
_BELOW = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def format_number(value: Any, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent where a person can do without."""
    if not isinstance(value, int | float) or value != value:
        return NOTHING
    if value in (float("inf"), float("-inf")):
        return "∞" if value > 0 else "−∞"
    if abs(value) < 10**digits:
        value = float(f"{value:.{digits - 1}e}")  # rounded first: it may reach another decade
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        text = f"{value:#.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}".replace(",", " ")
        return text.rstrip(".").replace("-", "−")
    return f"{value:.{digits - 1}e}".replace("-", "−")


def format_fixed(value: Any, decimals: int = 1) -> str:
    """A number to so many decimals."""
    if not isinstance(value, int | float) or value != value:
        return NOTHING
    return f"{value:.{decimals}f}".replace("-", "−")


def format_symbol(key: str) -> str:
    """A parameter as formulas write it: ``tau_s`` is τ, ``tau2_s`` τ₂."""
    name, _ = split_key(key)
    letter = name.rstrip("0123456789")
    return _GREEK.get(letter, letter) + name[len(letter) :].translate(_BELOW)


def format_parameter(name: str) -> str:
    """``skin.c_kPa`` as ``skin c``."""
    tissue, _, kind = name.rpartition(".")
    return f"{tissue} {format_symbol(kind)}".strip()


def format_unit(key: str) -> str:
    """Its unit: ``tau_s`` is in s."""
    return split_key(key)[1] or NOTHING


def format_with_unit(key: str) -> str:
    """A parameter with its unit where it has one: ``τ (s)``, ``m``."""
    unit = split_key(key)[1]
    return f"{format_symbol(key)} ({unit})" if unit else format_symbol(key)


def format_with_value(key: str, value: Any) -> str:
    """A parameter with its value: ``τ = 0.391 s``."""
    return f"{format_symbol(key)} = {format_number(value)} {split_key(key)[1]}".strip()


def format_limits(values: Any, digits: int = 3) -> str:
    """An interval: ``1.2 to 3.4``."""
    return f"{format_number(values[0], digits)} to {format_number(values[1], digits)}" if values else NOTHING


def format_count(value: Any) -> str:
    """A whole number with its thousands apart."""
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else NOTHING


def format_duration(seconds: Any) -> str:
    """Seconds as a person says them."""
    if not isinstance(seconds, int | float):
        return NOTHING
    if seconds < 90:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 90:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def format_friction(value: Any) -> str:
    """How contact is, by the study's key: a word, or a coefficient."""
    return value if isinstance(value, str) else f"with friction of coefficient {format_number(value)}"
