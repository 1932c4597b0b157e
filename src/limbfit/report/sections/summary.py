"""What the report says first: the numbers and sentences of its summary."""

from __future__ import annotations

import statistics

from ..formats import format_limits, format_symbol, label, number
from ..page import Block, KeyNumber, make_bullets, make_section
from ..store import Results
from ..words import make_prose

_RANKS = {"determined": 0, "weakly": 1, "not": 2}


def list_key_numbers(store: Results) -> tuple[KeyNumber, ...]:
    """The numbers that a reader looks for first."""
    found = []
    if store.predict:
        found.append(KeyNumber(store.mean_error("heldout"), "%", "mean force error at the held-out sites"))
        found.append(KeyNumber(store.mean_error("fitted"), "%", "mean force error at the fitted sites"))
    for tissue in store.tissues:
        modulus = number(store.stages[-1].parameters[tissue][store.law.moduli[0]])
        found.append(KeyNumber(modulus, "kPa", _label_modulus(store, tissue)))
    seconds = [stage.seconds for stage in store.run.stages.values()] if store.run else []
    if seconds:
        size, unit = (1, "s") if sum(seconds) < 120 else (60, "min")
        found.append(KeyNumber(f"{sum(seconds) / size:.0f}", unit, "computing time, all stages"))
    return tuple(found)


def _label_modulus(store: Results, tissue: str) -> str:
    first = next(p for p in store.law.parameters if p.key == store.law.moduli[0])
    interval = store.interval(tissue, first.key)
    text = f"{tissue}, {first.words} {format_symbol(first.key)}"
    return f"{text} ({format_limits(interval)} kPa)" if interval else text


def build_summary(store: Results) -> tuple[Block, ...]:
    """One paragraph in plain words, then the verdict."""
    heldout = [row for row in store.predicted if not row.fitted]
    pairs = [(row.error_one_material_percent, row.error_percent) for row in heldout]
    known = [(one, several) for one, several in pairs if one is not None and several is not None]
    prose = make_prose(
        "summary",
        store=store,
        heldout=heldout,
        sites=len({row.site for row in heldout}),
        errors=[row.error_percent for row in heldout if row.error_percent is not None],
        means=[statistics.fmean(column) for column in zip(*known, strict=True)],
    )
    return make_section("summary", "Summary", prose, make_bullets(_list_verdicts(store))).blocks


def _list_verdicts(store: Results) -> tuple[str, ...]:
    """Which parameters the data determine, best first, and how many combinations of them."""
    if store.uncertainty is None:
        return ()
    groups: dict[str, list[str]] = {}
    for name, word in store.uncertainty.verdict.items():
        groups.setdefault(word, []).append(label(name))
    best_first = sorted(groups, key=lambda word: _RANKS.get(word.split()[0], 1))
    words = [f"{word.capitalize()}: {', '.join(groups[word])}." for word in best_first]
    combinations = store.uncertainty.combinations
    known = sum(sentence.endswith(": determined") for sentence in combinations)
    if not known:
        return tuple(words)
    return (*words, f"Determined together: {known} of {len(combinations)} products of them (see Parameters).")
