"""What was known before the records: in words, and how much of each interval comes from it."""

from __future__ import annotations

from ..formats import NOTHING, fixed, heading, number, numeric, symbol, unit_of
from ..page import Block, Cell, Prose, Row, Table
from ..store import Json, Results
from ..tables import parameter_words, tissue_name


def prior_shares(store: Results) -> tuple[Block, ...]:
    """Each parameter's prior, how much of its variance priors cause, and its interval without them."""
    found = (store.calibration.get("uncertainty") or {}).get("priors")
    if not found:
        return ()
    sources = list(dict.fromkeys(one["source"] for one in found["stated"].values()))
    table = Table(
        name="priors",
        caption="What was known beforehand, and how much of each interval comes from it: the share of the "
        "variance of its logarithm that the priors' own deviations cause (the rest is that of records and "
        "bounds), and how many times as wide the interval would be without any prior. By linear theory. The "
        "factor is one standard deviation either way.",
        head=("Tissue", "Parameter", "Unit", "Prior", "Factor", "From priors (%)", "Wider without"),
        rows=tuple(_row(store, found, tissue, key) for tissue in store.tissues for key in store.law.keys),
    )
    return Prose(f"Lognormal priors count beside the records. Source: {'; '.join(sources)}."), table


def _row(store: Results, found: Json, tissue: str, key: str) -> Row:
    name = f"{tissue}.{key}"
    prior = found["stated"].get(name)
    cells = (number(prior["median"]), fixed(prior["factor"], 2)) if prior else (NOTHING, NOTHING)
    share = float(found["share"][name])
    return Row(
        (
            heading(tissue_name(store, tissue)),
            Cell(parameter_words(store, key)),
            Cell(unit_of(key)),
            *map(numeric, cells),
            numeric(fixed(100 * share, 0), share=min(share, 1.0)),
            numeric(f"{fixed(found['wider_without'][name], 2)} times"),
        )
    )


def constraints(table: Json) -> str:
    """What the study held, tied or knew beforehand, as a sentence of the methods."""
    fixed_names, tied, prior = (table.get(key) or () for key in ("fixed", "tied", "prior"))
    words = [f"{', '.join(fixed_names)} stayed at the start" if fixed_names else ""]
    words += [f"{' and '.join(group)} were kept equal" for group in tied]
    if table.get("priors"):
        words.append(f"lognormal priors of {symbol('c')} and {symbol('m')} were those of people")
    if prior:
        known = (f"{name}: median {p['median']}, factor {p['factor']}" for name, p in dict(prior).items())
        words.append(f"lognormal priors were put on {'; '.join(known)}")
    text = "; ".join(word for word in words if word)
    return text[:1].upper() + text[1:] + "." if text else ""
