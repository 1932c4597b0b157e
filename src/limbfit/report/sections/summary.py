"""What the report says first: the numbers and sentences of its summary."""

from __future__ import annotations

import statistics

from ..formats import format_fixed, format_limits, format_symbol, label, number
from ..page import Block, KeyNumber, Prose, make_bullets
from ..store import Results

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
    sentences = [_describe_study(store), _describe_errors(store), _compare_materials(store)]
    prose = Prose(" ".join(sentence for sentence in sentences if sentence))
    verdict = make_bullets(_list_verdicts(store))
    return (prose, verdict) if verdict else (prose,)


def _describe_study(store: Results) -> str:
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
    parts = "a skin–adipose layer and the muscle–soft tissue beneath it"
    if not store.has_paper_tissues:
        parts = " and ".join(filter(None, [", ".join(store.tissues[:-1]), store.tissues[-1]]))
    return f"{start}: first as one material, then as {parts}."


def _describe_errors(store: Results) -> str:
    held = [row for row in store.predicted if not row.fitted]
    if not store.predict:
        return ""
    if not held:
        return f"At the fitted sites the force error is {store.mean_error('fitted')} %."
    sites = len({row.site for row in held})
    places = "the one site that was" if sites == 1 else f"the {sites} sites that were"
    errors = [row.error_percent for row in held if row.error_percent is not None]
    worst = f" (largest {format_fixed(max(errors))} %)" if errors else ""
    return (
        f"At {places} not used, the model predicts the force with a mean error of "
        f"{store.mean_error('heldout')} % of the largest force{worst}; at the fitted "
        f"sites it is {store.mean_error('fitted')} %."
    )


def _compare_materials(store: Results) -> str:
    held = [row for row in store.predicted if not row.fitted]
    pairs = [(row.error_one_material_percent, row.error_percent) for row in held]
    known = [(one, two) for one, two in pairs if one is not None and two is not None]
    if not known:
        return ""
    first, second = (statistics.fmean(column) for column in zip(*known, strict=True))
    start = f"With one material for all soft tissue the held-out error is {format_fixed(first)} %: "
    if abs(first - second) < 0.1 * max(first, second):
        return start + f"here {store.materials} predict no better than one."
    return start + f"{store.materials} predict {'better' if second < first else 'worse'}."


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
