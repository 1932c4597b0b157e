"""What the report says first: the numbers and sentences of its summary."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from .. import site_tables, tables
from ..formats import fixed, number, symbol
from ..page import Block, Bullets, KeyNumber, Prose
from ..store import Results

_RANKS = {"determined": 0, "weakly": 1, "not": 2}


def key_numbers(store: Results) -> tuple[KeyNumber, ...]:
    """The numbers that a reader looks for first."""
    found = []
    if store.predict:
        heldout, fitted = (site_tables.mean_and_deviation(store, which) for which in ("heldout", "fitted"))
        found.append(KeyNumber(heldout, "%", "mean force error at the held-out sites"))
        found.append(KeyNumber(fitted, "%", "mean force error at the fitted sites"))
    for tissue in store.tissues:
        last = store.stages[-1].get("parameters", {}).get(tissue) if store.stages else None
        if last:
            modulus = number(last.get(store.law.moduli[0]))
            found.append(KeyNumber(modulus, "kPa", _with_interval(store, tissue)))
    seconds = [stage.get("seconds", 0.0) for stage in (store.run.get("stages") or {}).values()]
    if seconds:
        found.append(KeyNumber(*_short_time(sum(seconds)), "computing time, all stages"))
    return tuple(found)


def _short_time(seconds: float) -> tuple[str, str]:
    return (f"{seconds:.0f}", "s") if seconds < 120 else (f"{seconds / 60:.0f}", "min")


def _with_interval(store: Results, tissue: str) -> str:
    first = next(p for p in store.law.parameters if p.key == store.law.moduli[0])
    limits = tables.interval(store, tissue, first.key)
    text = f"{tissue}, {first.words} {symbol(first.key)}"
    return f"{text} ({number(limits[0])} to {number(limits[1])} kPa)" if limits else text


def summary(store: Results) -> tuple[Block, ...]:
    """One paragraph in plain words, then the verdict."""
    sentences = [_what_was_done(store), _how_well(store), _one_or_two(store)]
    blocks: list[Block] = [Prose(" ".join(sentence for sentence in sentences if sentence))]
    words = _verdict(store)
    return (*blocks, Bullets(words)) if words else tuple(blocks)


def _what_was_done(store: Results) -> str:
    names, fitted = store.site_names, store.fitted
    if not names:
        return "Nothing has been computed yet for this study."
    if not store.stages:
        sites = f"{len(names)} indentation site{'s' if len(names) > 1 else ''}"
        simulated = ", each simulated with the parameters of the study" if store.predicted else ""
        return f"The study has {sites}{simulated}; no parameters have been identified."
    start = (
        f"The soft tissue of this limb was identified from robotic indentations at {len(fitted)} of "
        f"{len(names)} sites ({', '.join(fitted)})"
    )
    if len(store.stages) == 1:
        return f"{start} as one material."
    paper = store.tissues == tuple(tables.PAPER_TISSUES)
    parts = "a skin–adipose layer and the muscle–soft tissue beneath it"
    return f"{start}: first as one material, then as {parts if paper else _listed(store.tissues)}."


def _listed(words: Sequence[str]) -> str:
    """``skin, fat and muscle``."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _how_well(store: Results) -> str:
    held = [row for row in store.predicted if not row.get("fitted")]
    if not store.predict:
        return ""
    if not held:
        return f"At the fitted sites the force error is {site_tables.mean_and_deviation(store, 'fitted')} %."
    sites = len({row["site"] for row in held})
    places = "the one site that was" if sites == 1 else f"the {sites} sites that were"
    errors = [row["error_percent"] for row in held if row.get("error_percent") is not None]
    worst = f" (largest {fixed(max(errors))} %)" if errors else ""
    return (
        f"At {places} not used, the model predicts the force with a mean error of "
        f"{site_tables.mean_and_deviation(store, 'heldout')} % of the largest force{worst}; at the fitted "
        f"sites it is {site_tables.mean_and_deviation(store, 'fitted')} %."
    )


def _one_or_two(store: Results) -> str:
    held = [row for row in store.predicted if not row.get("fitted")]
    pairs = [(row.get("error_one_material_percent"), row.get("error_percent")) for row in held]
    known = [(one, two) for one, two in pairs if one is not None and two is not None]
    if not known:
        return ""
    first, second = (statistics.fmean(column) for column in zip(*known, strict=True))
    start = f"With one material for all soft tissue the held-out error is {fixed(first)} %: "
    if abs(first - second) < 0.1 * max(first, second):
        return start + f"here {store.materials} predict no better than one."
    return start + f"{store.materials} predict {'better' if second < first else 'worse'}."


def _verdict(store: Results) -> tuple[str, ...]:
    """Which parameters the data determine, best first, and how many combinations of them."""
    uncertainty = store.calibration.get("uncertainty") or {}
    stored = uncertainty.get("verdict") or {}
    if not stored:
        return ()
    symbols = _symbols(store)
    groups: dict[str, list[str]] = {}
    for name, word in stored.items():
        groups.setdefault(str(word), []).append(symbols.get(name, name))
    best_first = sorted(groups, key=lambda word: _RANKS.get(word.split()[0], 1))
    words = [f"{word.capitalize()}: {', '.join(groups[word])}." for word in best_first]
    combinations = [str(sentence) for sentence in uncertainty.get("combinations") or ()]
    known = sum(sentence.endswith(": determined") for sentence in combinations)
    if not known:
        return tuple(words)
    return (*words, f"Determined together: {known} of {len(combinations)} products of them (see Parameters).")


def _symbols(store: Results) -> dict[str, str]:
    """Each parameter's name as people read it: ``muscle.tau_s`` is muscle τ."""
    return {f"{t}.{n}": f"{t} {symbol(n)}" for t in store.tissues for n in store.law.keys}


def _combinations(store: Results) -> tuple[Block, ...]:
    """What the data determine of several parameters together, best determined first."""
    sentences = (store.calibration.get("uncertainty") or {}).get("combinations") or ()
    if not sentences:
        return ()
    told = []
    for sentence in map(str, sentences):
        for name, read in _symbols(store).items():
            sentence = sentence.replace(name, read)
        told.append(sentence)
    lead = (
        "Products of powers of the parameters, the best determined by the data first. They and the intervals "
        "are those of the records alone, sampled on what the calibration simulated; limbfit uncertainty adds "
        "geometry, contact and mesh."
    )
    return Prose(lead), Bullets(tuple(told))
