"""The table ``[material]``: the law of the tissues, start and bounds of its parameters."""

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..laws import ACTIVE, LAWS, OGDEN
from ..relaxation import DEFAULT_SPAN_S, choose_relaxation_times
from .tables import Direction, Positive, TomlTable, refuse_value

KAPPA_RATIO = (10.0, 1e4)
End = Literal["lower", "start", "upper"]
_ENDS: tuple[End, ...] = ("lower", "start", "upper")


class TissueRange(TomlTable):
    """Start and bounds of parameters: of all tissues, or of one tissue where they differ from those."""

    start: dict[str, Positive] = Field(default={})
    lower: dict[str, Positive] = Field(default={})
    upper: dict[str, Positive] = Field(default={})


class ActivationTable(TomlTable):
    """The share of the active stress that acts from touch-down on, piecewise linear; the last holds on."""

    time_s: tuple[float, ...]
    share: tuple[Annotated[float, Field(ge=0)], ...]

    def check_keys(self) -> None:
        times = self.time_s
        if len(times) < 2 or len(times) != len(self.share):
            raise ValueError("give two or more times in time_s, and as many shares")
        if times[0] != 0.0 or any(b <= a for a, b in pairwise(times)):
            raise ValueError("time_s does not grow from 0, which is touch-down")


class MaterialTable(TissueRange):
    """The law of all tissues, and start and bounds of its parameters; those that are not given are the law's.

    ``relaxation_span_s``: first and last time of relaxation as a power of time.
    ``tissues`` overrides them, tissue by tissue (see :meth:`of`).  ``fibres``: their direction in the tissues
    that have some: a vector, that of the limb's axis, or a flow from the proximal cut to the bone's end.
    ``activation``: how much of their active stress acts, all of it where it is not stated.
    ``prestretch``: how far tissues are stretched at rest, along fibres or in the plane of a layer.
    """

    law: str = OGDEN
    relaxation_span_s: tuple[float, float] = DEFAULT_SPAN_S
    kappa_ratio: float = 100.0
    tissues: dict[str, TissueRange] = Field(default={})
    fibres: dict[str, Literal["axis", "flow"] | Direction] = Field(default={})
    activation: ActivationTable | None = None
    prestretch: dict[str, Annotated[float, Field(ge=0.7, le=1.5)]] = Field(default={})

    @property
    def course(self) -> tuple[tuple[float, float], ...]:
        """Times from touch-down, s, and shares of the active stress; none where tissues do not contract."""
        if self.law != ACTIVE:
            return ()
        stated = self.activation
        return ((0.0, 1.0),) if stated is None else tuple(zip(stated.time_s, stated.share, strict=True))

    @property
    def keys(self) -> tuple[str, ...]:
        """The parameters of the law."""
        return LAWS[self.law].keys

    def get(self, tissue: str, which: End) -> dict[str, float]:
        """Start, lower or upper bound of the parameters of a tissue."""
        return getattr(self, which) | getattr(self.tissues.get(tissue, TissueRange()), which)

    @model_validator(mode="before")
    @classmethod
    def _fill_from_law(cls, content: Any) -> Any:
        """Fill in what the law says and the study leaves out; what is malformed is refused later."""
        name = content.get("law", OGDEN) if isinstance(content, dict) else None
        if not isinstance(name, str):
            return content
        with refuse_value():
            law = LAWS[name]
        known = {which: {p.key: getattr(p, which) for p in law.parameters} for which in _ENDS}
        given = {which: content.get(which, {}) for which in _ENDS}
        filled = {which: known[which] | values for which, values in given.items() if isinstance(values, dict)}
        return content | filled

    @field_validator("relaxation_span_s")
    @classmethod
    def _check_span(cls, span: tuple[float, float]) -> tuple[float, float]:
        with refuse_value():
            choose_relaxation_times(*span)
        return span

    @field_validator("kappa_ratio")
    @classmethod
    def _check_kappa_ratio(cls, ratio: float) -> float:
        low, high = KAPPA_RATIO
        if ratio < low:
            raise ValueError(f"give {low:g} or more: with less, Poisson's ratio is under 0.45")
        if ratio > high:
            raise ValueError(f"give at most {high:g}: with more, the equations lose digits")
        return ratio

    def check_keys(self) -> None:
        for tissue in ("", *self.tissues):
            lower, start, upper = (self.get(tissue, which) for which in _ENDS)
            place = f"tissues.{tissue}." if tissue else ""
            for which, values in zip(_ENDS, (lower, start, upper), strict=True):
                for name in values.keys() - self.keys:
                    what = f"material.{place}{which}.{name} is no parameter of the law"
                    raise ValueError(f"{what}; they are {', '.join(self.keys)}")
            for name in self.keys:
                if not lower[name] <= start[name] <= upper[name]:
                    raise ValueError(f"{place}start.{name} lies outside its bounds")
                if not lower[name] < upper[name]:
                    raise ValueError(f"{place}lower.{name} is not below upper.{name}")

    def check_tissues(self, tissues: tuple[str, ...], stretched: tuple[str, ...]) -> None:
        """Raise `ValueError` for an unknown tissue, one not ``stretched``, and bounds that never meet."""
        for key, named in (("tissues", self.tissues), ("fibres", self.fibres)):
            for tissue in named:
                if tissue not in tissues:
                    what = f"material.{key}.{tissue}: no such tissue"
                    raise ValueError(f"{what}; its tissues are {', '.join(tissues)}")
        for tissue in self.prestretch:
            if tissue not in stretched:
                what = f"material.prestretch.{tissue}: no layer, and no tissue with fibres"
                raise ValueError(f"{what}; those are {', '.join(stretched)}")
        for name in self.keys:
            lower = max(self.get(tissue, "lower")[name] for tissue in tissues)
            upper = min(self.get(tissue, "upper")[name] for tissue in tissues)
            if not lower < upper:
                what = f"material: the tissues' bounds of {name} have no range in common"
                raise ValueError(f"{what}, and the stage of one material needs one; widen them")
