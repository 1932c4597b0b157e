"""Is the identification right from anywhere and with failures, and does it say when records are wrong?

    python benchmarks/identification.py wrong --json wrong.json
    python benchmarks/identification.py failures --rate 0.1 --repeats 3 --json failures.json
    python benchmarks/identification.py starts --starts 20 --json starts.json

End to end with the solver: every case is a copy of a small study (``identification_cases.py``), whose truth
is known, run by ``run_study`` from its files.  ``wrong`` makes files of the copy wrong and says whether the
check before the fit or the test after it flags the right sites and names the cause; ``failures`` lets a
drawn share of all simulations stop early; ``starts`` begins at random between the bounds.  The study is made
once in ``--folder``; cases in the file of ``--json`` are not run again, and one that was interrupted goes on
from its simulations.
"""

import argparse
import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from identification_cases import WRONG, Case, parameters_of, true_sites, write_study
from identification_copies import NAMES, Record, Study, cpu_s, ending, outcome, quiet
from identification_failures import line_failing, run_failing, summary_failing

from limbfit import check_study, load_study, run_study
from limbfit.errors import LimbfitError
from limbfit.identify.fit.multistart import draw_starts
from limbfit.indentation import to_parameters, to_vector
from limbfit.pipeline.engine.store import Store, read_json
from limbfit.pipeline.identification.search import build_unknowns

SAME = 0.01  # of the squared error: as good a fit as the best


# Records that are wrong


def run_wrong(study: Study, case: Case) -> Record:
    """A case: flags of the check and of the prediction, or the words in which it was refused."""
    began = cpu_s()
    name = case.name.replace(" ", "-")
    clean, copy = study.clean(), study.folder / name
    if not copy.is_dir():
        draft = study.copy(f"{name}.begun", clean)
        sites = true_sites()
        case.change(draft, sites)
        write_study(draft, sites)
        draft.rename(copy)
    told: Record = {"case": case.name, "sites": list(case.sites), "refused": "", "before": [], "after": []}
    try:
        told["before"] = check_study(load_study(copy), listener=quiet)["flags"]
        run_study(load_study(copy), until="predict", listener=quiet)
        found = outcome(copy)
        told["after"] = [flag for flag in found.pop("flags") if flag["found"] == "against the model"]
        told |= found
    except LimbfitError as error:
        told["refused"] = str(error)
    shutil.rmtree(copy)
    return told | {"cpu_s": cpu_s() - began} | verdict(case, told)


def verdict(case: Case, told: Record) -> Record:
    """Which flags concern the sites that are wrong, name them all, and name the cause; which others."""
    found: Record = {}
    for when in ("before", "after"):
        flags = told[when]
        mine = [flag for flag in flags if set(flag["sites"]) & set(case.sites)]
        named = {site for flag in mine for site in flag["sites"]}
        words = [flag["kind"] + " " + flag["cause"] for flag in mine]
        found[f"flagged_{when}"] = bool(mine)
        found[f"sites_named_{when}"] = bool(mine) and named >= set(case.sites)
        found[f"cause_named_{when}"] = any(cause in text for cause in case.causes for text in words)
        found[f"others_{when}"] = sorted(
            {s for flag in flags for s in flag["sites"] or ["all"]} - set(case.sites)
        )
    return found


def line_wrong(case: Record) -> str:
    def words(when: str) -> str:
        causes = {f"{'+'.join(flag['sites']) or 'all'}: {flag['cause']}" for flag in case[when]}
        return "; ".join(sorted(causes)) or "-"

    if case["refused"]:
        return f"{case['case']:38s} refused: {case['refused']}"
    error = f"fit {case['error_percent']:.2f} %, held out {case['error_heldout_percent']:.2f} %"
    head = f"{case['case']:38s} before: {words('before')} | after: {words('after')}"
    return f"{head} | {error} | {case['cpu_s']:.0f} s"


def summary_wrong(cases: Sequence[Record]) -> Record:
    wrong = [case for case in cases if case["sites"]]
    either = [case for case in wrong if case["flagged_before"] or case["flagged_after"] or case["refused"]]
    keys = ("flagged", "sites_named", "cause_named")
    columns = [f"{key}_{when}" for when in ("before", "after") for key in keys]
    return {
        "corruptions": len(wrong),
        "caught": len(either),
        "refused": sum(bool(case["refused"]) for case in wrong),
        **{column: sum(case[column] for case in wrong) for column in columns},
        "missed": [case["case"] for case in wrong if case not in either],
        "other_sites_flagged": {
            case["case"]: case["others_before"] + case["others_after"]
            for case in cases
            if case["others_before"] or case["others_after"]
        },
    }


# Other starts


def run_start(study: Study, number: int, count: int, seed: int) -> Record:
    """The identification from one of the starts; the first is the paper's."""
    began = cpu_s()
    copy = study.copy(f"start-{seed}-{number}", study.made if number else study.clean())
    start = draw_starts(build_unknowns(load_study(copy)), count, seed)[number]
    values = to_parameters(start, ("skin", "muscle"))["skin"]
    table = ", ".join(f"{name} = {value!r}" for name, value in values.items())
    write_study(copy, true_sites(), f"\n[material]\nstart = {{ {table} }}\n" if number else "")
    told: Record = {"case": number, "start": list(values.values()), "refused": ""}
    try:
        run_study(load_study(copy), until="calibrate", listener=quiet)
        told |= ending(read_json(Store(copy / "results")["calibrate"] / "calibration.json"))
    except LimbfitError as error:
        told["refused"] = str(error)
    shutil.rmtree(copy)
    return told | {"cpu_s": cpu_s() - began}


def line_start(case: Record) -> str:
    head = f"start {case['case']}: " + ", ".join(f"{value:.3g}" for value in case["start"])
    if case["refused"]:
        return f"{head} -> refused: {case['refused']}"
    values = ", ".join(f"{value:.3g}" for value in case["parameters"])
    return (
        f"{head} -> {values}; error {case['error_percent']:.3f} %, cost {case['cost']:.4g}, evaluations "
        f"{case['evaluations']}, {'; '.join(case['reasons'])}; {case['cpu_s']:.0f} s"
    )


def summary_start(cases: Sequence[Record]) -> Record:
    ended = [case for case in cases if not case["refused"]]
    if not ended:
        return {"starts": len(cases), "same": 0}
    best = min(case["cost"] for case in ended)
    same = [case for case in ended if case["cost"] <= (1 + SAME) * best]
    table = np.array([case["parameters"] for case in same])
    truth = to_vector(parameters_of(0), ("skin", "muscle"))
    return {
        "starts": len(cases),
        "same": len(same),
        "error_percent": [min(c["error_percent"] for c in same), max(c["error_percent"] for c in same)],
        "parameters": {
            name: {"least": float(low), "largest": float(high), "truth": float(true)}
            for name, low, high, true in zip(NAMES, table.min(axis=0), table.max(axis=0), truth)
        },
        "evaluations": sorted(sum(case["evaluations"]) for case in ended),
        "elsewhere": [
            {
                "start": case["case"],
                "squared_error_ratio": case["cost"] / best,
                **{key: case[key] for key in ("error_percent", "parameters", "reasons")},
            }
            for case in ended
            if case not in same
        ],
        "refused": [{"start": case["case"], "words": case["refused"]} for case in cases if case["refused"]],
    }


# The command line

Run = tuple[Any, Callable[[Study], Record]]


def runs_of(given: argparse.Namespace) -> list[Run]:
    """The cases that are wanted, by what their records are called."""
    if given.command == "wrong":
        return [(case.name, lambda study, case=case: run_wrong(study, case)) for case in WRONG]
    if given.command == "failures":
        draws = range(given.seed, given.seed + given.repeats)
        name = f"{100 * given.rate:g} % fail, draw {{}}"
        return [(name.format(d), lambda study, d=d: run_failing(study, given.rate, d)) for d in draws]
    count = given.starts + 1
    return [(n, lambda study, n=n: run_start(study, n, count, given.seed)) for n in range(count)]


REPORTS = {
    "wrong": (line_wrong, summary_wrong),
    "failures": (line_failing, summary_failing),
    "starts": (line_start, summary_start),
}


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("command", choices=REPORTS)
    parser.add_argument("--starts", type=int, default=20, help="random starts beside the paper's")
    parser.add_argument("--rate", type=float, default=0.1, help="share of the simulations that fail")
    parser.add_argument("--repeats", type=int, default=3, help="runs with other failures")
    parser.add_argument("--seed", type=int, default=0, help="of the starts, or the first draw of failures")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the cases to run, from 0")
    parser.add_argument("--folder", type=Path, default=Path("runs/identification"), help="of the study")
    parser.add_argument("--json", type=Path, help="write every case here; cases found there are kept")
    return parser.parse_args()


def earlier(path: Path | None, kind: Record) -> list[Record]:
    """The cases in the file of an earlier run, which must have been of the same kind."""
    if path is None or not path.exists():
        return []
    content = json.loads(path.read_text())
    if {name: content.get(name) for name in kind} != kind:
        sys.exit(f"{path} holds cases of another kind or seed; name another file")
    return content["cases"]


def main() -> None:
    given = options()
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    line, summary = REPORTS[given.command]
    kind = {"command": given.command, "seed": given.seed}
    if given.command == "starts":
        kind["starts"] = given.starts
    cases = earlier(given.json, kind)
    done = {case["case"] for case in cases}
    wanted = runs_of(given)
    wanted = wanted if given.only is None else [wanted[i] for i in given.only]
    missing = [(name, run) for name, run in wanted if name not in done]
    study = Study(given.folder) if missing else None
    for case in cases:
        print(line(case))
    for _, run in missing:
        cases.append(run(study))
        print(line(cases[-1]), flush=True)
        if given.json is not None:
            content = {**kind, "summary": summary(cases), "cases": cases}
            given.json.write_text(json.dumps(content, indent=1))
    print(json.dumps(summary(cases), indent=1))


if __name__ == "__main__":
    main()
