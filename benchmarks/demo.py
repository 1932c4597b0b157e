"""How long does the demo take, and FEBio beside it for one simulation of one of its sites?

    python benchmarks/demo.py FOLDER --beside-febio --threads 2 --json demo.json
    python benchmarks/demo.py FINISHED --finished --beside-febio --site 15

Runs ``limbfit demo`` in a folder, as a process of its own, and tells the wall and processor time of each
stage and of all (with the start of the program and its workers). FEBio then solves what ``limbfit export``
writes of one site, on the same cores. Its program is that of FEBIO_CMD, or on the path.
"""

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from limbfit.execution import count_usable_cores
from limbfit.febio import find_febio, read_feb, run_febio

DONE = re.compile(r"\] (?P<stage>\w+) 1/1: done in")


def measure_cpu_s(process: psutil.Process) -> float:
    """Processor time of a process and all below it so far, with those that have ended, s."""
    total = 0.0
    for one in (process, *process.children(recursive=True)):
        try:
            total += sum(one.cpu_times()[:4])  # own and of ended children, user and system
        except psutil.NoSuchProcess:
            continue
    return total


def measure_children_cpu_s() -> float:
    """Processor time of the children of this process that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_demo(folder: Path) -> list[dict[str, Any]]:
    """A row for each stage of ``limbfit demo`` that is done, in its order, and one for all."""
    command = [sys.executable, "-m", "limbfit", "demo", str(folder)]
    before, started = measure_children_cpu_s(), time.perf_counter()
    rows: list[dict[str, Any]] = []
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        watched, last, used = psutil.Process(process.pid), started, 0.0
        for line in process.stderr:
            print(line, end="", file=sys.stderr)
            if (found := DONE.search(line)) is not None:
                now, cpu = time.perf_counter(), measure_cpu_s(watched)
                rows.append({"what": found["stage"], "seconds": now - last, "cpu_seconds": cpu - used})
                last, used = now, cpu
    if process.returncode:
        raise SystemExit(f"limbfit demo ended with {process.returncode}")
    whole = {"seconds": time.perf_counter() - started, "cpu_seconds": measure_children_cpu_s() - before}
    return [*rows, {"what": "demo", **whole}]


def run_site(program: Path, folder: Path, site: str, limit_s: float) -> dict[str, Any]:
    """FEBio on the exported input of a site."""
    with tempfile.TemporaryDirectory(prefix="limbfit-demo-") as scratch:
        command = [sys.executable, "-m", "limbfit", "export", str(folder), "--to", "feb", "--site", site]
        subprocess.run([*command, "--output", scratch], check=True, stdout=subprocess.DEVNULL)
        file = (Path(scratch) / f"{site}.feb").rename(Path(scratch) / "model.feb")
        before, end_s = measure_children_cpu_s(), read_feb(file).end_s
        table, threads = f"{site}-forces.txt", count_usable_cores()
        run = run_febio(program, Path(scratch), end_s, table, threads=threads, time_limit_s=limit_s)
    return {
        "what": f"FEBio, site {site}",
        "seconds": run.seconds,
        "cpu_seconds": measure_children_cpu_s() - before,
        "reason": run.verdict.reason,
        "version": run.verdict.version,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the demo; new, or one that was stopped")
    parser.add_argument("--finished", action="store_true", help="it holds a finished study: only FEBio runs")
    parser.add_argument("--beside-febio", action="store_true", help="run FEBio on one site afterwards")
    parser.add_argument("--site", default="15")
    parser.add_argument("--threads", type=int, default=count_usable_cores(), help="that each of both has")
    parser.add_argument("--time-limit", type=float, default=3600.0, help="of FEBio, s")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    program = find_febio() if asked.beside_febio else None  # before the demo's minutes
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: asked.threads])  # the demo has a worker a core
    rows = [] if asked.finished else run_demo(asked.folder)
    if program is not None:
        rows.append(run_site(program, asked.folder, asked.site, asked.time_limit))
    for row in rows:
        times = f"{row['seconds']:8.1f} s {row['cpu_seconds']:8.1f} CPU s"
        print(f"{row['what']:16} {times}  {row.get('reason', '')}")
    facts: dict[str, Any] = {"threads": count_usable_cores(), "rows": rows}
    if program is not None and not asked.finished and not rows[-1]["reason"]:
        facts["ratio"] = rows[-1]["seconds"] / rows[-2]["seconds"]
        print(f"FEBio's one simulation takes {facts['ratio']:.2f} times as long as the whole demo")
    if asked.json is not None:
        asked.json.write_text(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()
