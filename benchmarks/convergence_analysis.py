"""What the runs of ``convergence.py`` say: limits, errors, costs at equal error, tables and the figure."""

import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

DEFAULT, PLAIN, PAPER = "tet10p0", "tet10", "tet4"
LOAD_STEPS = 10
WANTED_PERCENT = 2.0
COLOURS = {
    DEFAULT: "tab:red",
    PLAIN: "tab:blue",
    PAPER: "tab:orange",
    f"{PLAIN}, split": "tab:green",
}
# FEBio 4.11 with two threads on two cores at 2.5 GHz: unknowns, seconds, steps.  The tet10 block took about
# 80 s on one thread, beside another run.
FEBIO = (
    ("residuum tet10", 50_790, 144.8, 38),
    ("residuum tet4", 6_348, 10.6, 38),
    ("block hex8", 5_040, 12.0, 30),
    ("block tet4", 5_040, 9.0, 30),
    ("block tet10", 38_394, 80.0, 30),
)
Rows = list[dict[str, Any]]


def analyse(rows: Rows) -> dict[str, Any]:
    """Limits, errors (added to the rows), and costs of ``WANTED_PERCENT`` by site."""
    rows = [dict(row) for row in rows]
    found: dict[str, Any] = {"febio": febio_costs(), "sites": {}, "rows": rows}
    for site in sorted({row["site"] for row in rows}):
        limit = bracket(rows, site)
        for row in rows:
            if row["site"] == site and limit is not None:
                row["error_percent"] = 100.0 * (row["peak_force_N"] / limit["limit_N"] - 1.0)
        found["sites"][site] = {**(limit or {}), "cost": limit and costs(rows, site)}
    return found


def series(rows: Rows, site: str, element: str, splits: int = 0) -> Rows:
    """One element's runs with the usual steps, coarse to fine."""
    chosen = [
        row
        for row in rows
        if (row["site"], row["element"], row["splits"]) == (site, element, splits)
        and row["load_steps"] == LOAD_STEPS
        and row["completed"]
    ]
    return sorted(chosen, key=lambda row: row["unknowns"])


def priced(runs: Rows) -> Rows:
    """The runs that went in and out: those that say what a simulation costs."""
    return [row for row in runs if row["unloading"]]


def bracket(rows: Rows, site: str) -> dict[str, Any] | None:
    """The converged force, between the finest runs of two elements that near it from both sides.

    ``limit_N`` is the middle of ``range_N``.  None where one of the two was not run.
    """
    runs = [row for row in rows if row["site"] == site and row["completed"]]
    ends = []
    for element in (DEFAULT, PLAIN):
        mine = [row for row in runs if row["element"] == element]
        if not mine:
            return None
        ends.append(max(mine, key=lambda row: row["unknowns"])["peak_force_N"])
    return {"limit_N": sum(ends) / 2.0, "range_N": sorted(ends)}


def febio_costs() -> dict[str, tuple[float, float]]:
    """``seconds = factor * unknowns^exponent`` through FEBio's runs on the residuum, and through all five."""
    fits = {"residuum": FEBIO[:2], "all": FEBIO}
    return {
        name: power_law([float(case[1]) for case in cases], [case[2] for case in cases])
        for name, cases in fits.items()
    }


def power_law(x: list[float], y: list[float]) -> tuple[float, float]:
    """Factor and exponent of ``y = factor * x^exponent``."""
    exponent, level = np.polyfit(np.log(x), np.log(y), 1)
    return float(np.exp(level)), float(exponent)


def unknowns_at(runs: Rows, percent: float) -> dict[str, Any]:
    """Unknowns at which |error| is ``percent``, by the power law through the two finest runs."""
    sizes = [float(row["unknowns"]) for row in runs[-2:]]
    factor, exponent = power_law(sizes, [abs(row["error_percent"]) for row in runs[-2:]])
    needed = (percent / factor) ** (1.0 / exponent)
    return {"unknowns": needed, "exponent": exponent, "extrapolated": not sizes[0] <= needed <= sizes[-1]}


def costs(rows: Rows, site: str) -> dict[str, Any]:
    """Seconds for ``WANTED_PERCENT``: limbfit's default, and FEBio's with tet10 and with tet4.

    limbfit's are those of the coarsest run from which on all finer ones are as near, as measured; FEBio's
    follow from the unknowns that limbfit needs with FEBio's elements.
    """
    runs = priced(series(rows, site, DEFAULT))
    near = [abs(row["error_percent"]) <= WANTED_PERCENT for row in runs]
    others = {element: series(rows, site, element) for element in (PLAIN, PAPER)}
    if not near or not near[-1] or min(map(len, others.values())) < 2:
        return {}
    first = len(near) - next((i for i, good in enumerate(reversed(near)) if not good), len(near))
    own = runs[first]
    needed = {element: unknowns_at(found, WANTED_PERCENT) for element, found in others.items()}
    found: dict[str, Any] = {
        "own": {key: own[key] for key in ("size_mm", "unknowns", "error_percent", "cpu_seconds")},
        "needed": needed,
    }
    for name, (factor, exponent) in febio_costs().items():
        times = {element: factor * n["unknowns"] ** exponent for element, n in needed.items()}
        ratios = {element: time / own["cpu_seconds"] for element, time in times.items()}
        found[f"febio by {name}"] = {"seconds": times, "ratio": ratios}
    return found


def tables(found: dict[str, Any]) -> str:
    """The runs as Markdown, site by site."""
    lines = []
    for site, limit in found["sites"].items():
        lines += ["", f"{site}: {json.dumps(limit, indent=1)}", ""]
        lines += [
            "| element | size mm | splits | steps | cells | unknowns | peak N | error % | CPU s | MiB |"
        ]
        lines += ["|---" * 10 + "|"]
        lines += [_line(row) for row in sorted(found["rows"], key=_order) if row["site"] == site]
    return "\n".join(lines)


def _order(row: dict[str, Any]) -> tuple:
    return row["element"], row["splits"], row["load_steps"], row["unknowns"]


def _line(row: dict[str, Any]) -> str:
    error = f"{row['error_percent']:+.1f}" if "error_percent" in row else ""
    text = "{element} | {size_mm:g} | {splits} | {load_steps} | {cells} | {unknowns} | {peak_force_N:.3f}"
    rest = " | {cpu_seconds:.1f} | {max_rss_MB:.0f} |"
    return f"| {text.format(**row)} | {error}{rest.format(**row)}"


def draw(found: dict[str, Any], path: Path) -> None:
    """Peak force over unknowns with the limit, and error over processor seconds, at the first site."""
    sites = [site for site, limit in found["sites"].items() if "limit_N" in limit]
    figure, axes = plt.subplots(
        max(len(sites), 1), 2, figsize=(10, 4 * max(len(sites), 1)), layout="constrained", squeeze=False
    )
    for site, (left, right) in zip(sites, axes):
        _draw_site(found, site, left, right)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_site(found: dict[str, Any], site: str, left: Any, right: Any) -> None:
    rows, limit = found["rows"], found["sites"][site]["limit_N"]
    for element, splits in sorted({(row["element"], row["splits"]) for row in rows if row["site"] == site}):
        runs = series(rows, site, element, splits)
        label = element + (", split" if splits else "")
        sizes = [row["unknowns"] for row in runs]
        colour = COLOURS.get(label, "tab:purple")
        left.semilogx(sizes, [row["peak_force_N"] for row in runs], "o-", color=colour, label=label)
        runs = priced(runs)
        errors = [abs(row["error_percent"]) for row in runs]
        right.loglog([row["cpu_seconds"] for row in runs], errors, "o-", color=colour, label=label)
        if element in (PLAIN, PAPER) and not splits:
            factor, exponent = found["febio"]["residuum"]
            cost = factor * np.array([float(row["unknowns"]) for row in runs]) ** exponent
            right.loglog(cost, errors, "s:", color=colour, label=f"FEBio {label}, cost estimated")
    left.axhline(limit, color="0.4", lw=0.8, label=f"limit {limit:.3f} N")
    left.set(xlabel="unknowns", ylabel="peak force, N", title=site)
    left.xaxis.set_minor_formatter(NullFormatter())
    right.axhline(WANTED_PERCENT, color="0.4", lw=0.8)
    right.set(xlabel="processor seconds", ylabel="|error| of the peak force, %", title=site)
    for axis in (left, right):
        axis.legend(fontsize=7)
