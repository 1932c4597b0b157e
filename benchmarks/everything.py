"""Does every command work on every limb at its defaults, and is what cannot work refused at once?

    python benchmarks/everything.py --folder runs/everything --limit 600
    python benchmarks/everything.py --limbs phantom-0 calf --ask check run "export feb"
    python benchmarks/everything.py --redo red
    python benchmarks/everything.py --show

A cell is a limb (phantoms of five seeds, thighs, real limbs, a calf, a foreign label map, limbfit's own
surfaces read back) and what a user asks of it. Cells of a limb run one after the other in its study, so that
what ``run`` stored is used by those after it; ``phantom`` makes phantoms with two options at once, and checks
them. Each cell runs in processes of its own and ends at ``--limit`` seconds of processor time, making a limb
at three times that.

=========  ==================================================================================
outcome    meaning
=========  ==================================================================================
ok         exit code 0
refused    exit code 2 within 30 s of processor time, with the line that says why
late       the same, but later: **red**
failed     another exit code, or a traceback: **red**
over       the limit ended it
missing    the limb could not be made
=========  ==================================================================================

Seconds of the wall, of the processor in user mode, and the largest memory are those of all processes of a
cell. Every cell that is done is a line of ``cells.jsonl`` in the folder, with its output in ``logs/``; after
a kill, finished cells are not run again. The exit code is 1 where a cell is red.
"""

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import IO

import psutil

HERE = Path(__file__).parent
LIMBFIT = (sys.executable, "-m", "limbfit")
LATE_S, PAUSE_S, MAKING = 30.0, 0.25, 3.0
ENDING_S = 10.0  # for killed processes to be gone
WALL_PER_PROCESSOR = 10.0  # a process that waits for ever ends at so many times the limit
RED = ("late", "failed")
OUTCOMES = ("ok", "refused", *RED, "over", "missing")
SEEDS = range(5)
OTHERS = ("thigh-surfaces", "limb-1", "limb-9", "openlimb", "calf", "labels", "surfaces")
FIRST = f"phantom-{SEEDS[0]}"
MADE_OF_IT = ("labels", "surfaces")  # of that phantom
LIMBS = (*(f"phantom-{seed}" for seed in SEEDS), "thigh", *OTHERS)
FORMATS = ("feb", "febio-optimize", "inp", "calculix")
ASKED = (
    *("check", "run", *(f"export {name}" for name in FORMATS), "acquire"),
    *("socket", "socket design", "design", "design --protocol", "crossvalidate", "uncertainty"),
)
OPTIONS = ("fat", "tendon", "socket", "ultrasound", "surface", "shear-waves")
PAIRS = tuple(f"{one}+{other}" for one, other in combinations(OPTIONS, 2))
MAKE, PHANTOM = "make", "phantom"


@dataclass(frozen=True)
class Ending:
    """How the processes of a cell ended: exit code (None: at the limit), times in s, memory in MB."""

    code: int | None
    seconds: float
    user_s: float
    memory_MB: float


@dataclass(frozen=True)
class Cell:
    """What became of what was asked of a limb; ``line`` is the last line of its errors where it is not ok."""

    limb: str
    asked: str
    outcome: str
    seconds: float = 0.0
    user_s: float = 0.0
    memory_MB: float = 0.0
    line: str = ""

    @property
    def key(self) -> tuple[str, str]:
        return self.limb, self.asked


def classify_ending(ending: Ending, errors: str) -> str:
    """The outcome of a cell, of how it ended and what it wrote to standard error."""
    if ending.code is None:
        return "over"
    if "Traceback (most recent call last)" in errors:
        return "failed"
    if ending.code == 2:
        return "refused" if ending.user_s <= LATE_S else "late"
    return "ok" if ending.code == 0 else "failed"


class Usage:
    """Processor time and memory of a process and of all that it starts, sampled while they run."""

    def __init__(self, pid: int) -> None:
        self.root = psutil.Process(pid)
        self.user_s, self.memory_MB = 0.0, 0.0

    def sample(self) -> None:
        memory, user = 0, 0.0
        try:
            every = [self.root, *self.root.children(recursive=True)]
        except psutil.NoSuchProcess:
            return
        for process in every:
            try:
                times = process.cpu_times()
                memory += process.memory_info().rss
            except psutil.NoSuchProcess:
                continue
            user += times.user + times.children_user
        self.user_s, self.memory_MB = max(self.user_s, user), max(self.memory_MB, memory / 1e6)


def run_process(words: Sequence[str], output: IO[str], limit_s: float) -> Ending:
    """Run a command to its end, or to the limit of processor time, which ends it and all that it started."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    process = subprocess.Popen(words, stdout=output, stderr=output, start_new_session=True)
    usage, over = Usage(process.pid), False
    try:
        while process.poll() is None and not over:
            usage.sample()
            waited = time.perf_counter() - start
            over = usage.user_s > limit_s or waited > WALL_PER_PROCESSOR * limit_s
            time.sleep(PAUSE_S)
    finally:
        _end_session(process)
    ended = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    code = None if over else process.returncode
    return Ending(code, time.perf_counter() - start, max(ended, usage.user_s), usage.memory_MB)


def _end_session(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of a process, of its session and of those that began another."""
    started: list[psutil.Process] = []
    with suppress(psutil.NoSuchProcess):
        started = psutil.Process(process.pid).children(recursive=True)
    for one in started:
        with suppress(psutil.NoSuchProcess):
            one.kill()
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    psutil.wait_procs(started, timeout=ENDING_S)


class Matrix:
    """The cells in a folder, as far as they are done."""

    def __init__(self, folder: Path, shared: Path, limit_s: float) -> None:
        self.folder, self.shared, self.limit_s = folder, shared, limit_s
        self.file = folder / "cells.jsonl"
        self.cells: dict[tuple[str, str], Cell] = {}
        (folder / "logs").mkdir(parents=True, exist_ok=True)
        for line in self.file.read_text().splitlines() if self.file.is_file() else ():
            cell = Cell(**json.loads(line))
            self.cells[cell.key] = cell  # of a cell that was run again the last line counts

    def study(self, limb: str) -> Path:
        return self.folder / limb / "study"

    def is_due(self, key: tuple[str, str], redo: Sequence[str]) -> bool:
        """True for a cell that is not done, or whose outcome is to be found again."""
        return key not in self.cells or self.cells[key].outcome in redo

    def run(self, limb: str, asked: str) -> Cell:
        """Run a cell, and store what became of it."""
        log = self.folder / "logs" / f"{limb}-{asked}.txt".replace(" ", "-")
        log.unlink(missing_ok=True)
        limit = MAKING * self.limit_s if asked == MAKE else self.limit_s
        seconds = user = memory = 0.0
        for words in self._commands(limb, asked):
            with log.open("a+") as written:
                written.write(f"$ {' '.join(words)}\n")
                written.flush()
                ending = run_process(words, written, limit - user)
            seconds, user = seconds + ending.seconds, user + ending.user_s
            memory = max(memory, ending.memory_MB)
            if ending.code != 0:
                break
        text = log.read_text(errors="replace")
        outcome = classify_ending(Ending(ending.code, seconds, user, memory), text)
        said = text.strip().splitlines()[-1] if outcome != "ok" else ""
        return self._store(Cell(limb, asked, outcome, round(seconds, 1), round(user, 1), round(memory), said))

    def _store(self, cell: Cell) -> Cell:
        self.cells[cell.key] = cell
        with self.file.open("a") as file:
            file.write(json.dumps(asdict(cell)) + "\n")
        return cell

    def _commands(self, limb: str, asked: str) -> Iterator[tuple[str, ...]]:
        """The commands of a cell, one after the other; what one needs is made when it is its turn."""
        study = str(self.study(limb))
        if asked == MAKE:
            yield self._making(limb)
        elif limb == PHANTOM:
            made = self.folder / PHANTOM / asked
            shutil.rmtree(made, ignore_errors=True)
            yield (*LIMBFIT, "phantom", str(made), *(f"--{option}" for option in asked.split("+")))
            yield (*LIMBFIT, "check", str(made))
        elif asked == "acquire":
            yield (sys.executable, str(HERE / "everything_device.py"), study, str(self._copy(limb)))
        elif asked.startswith("export "):
            yield (*LIMBFIT, "export", study, "--to", asked.removeprefix("export "))
        else:
            verb = [word for word in asked.split() if not word.startswith("--")]
            yield (*LIMBFIT, *verb, study, *asked.split()[len(verb) :])

    def _making(self, limb: str) -> tuple[str, ...]:
        folder = self.study(limb)
        if limb.startswith("phantom-"):
            shutil.rmtree(folder, ignore_errors=True)
            return *LIMBFIT, "phantom", str(folder), "--seed", limb.removeprefix("phantom-")
        if limb == "thigh":
            shutil.rmtree(folder, ignore_errors=True)
            return *LIMBFIT, "phantom", str(folder), "--limb", "transfemoral"
        words = "--phantom", str(self.study(FIRST)), "--shared", str(self.shared)
        return sys.executable, str(HERE / "everything_limbs.py"), limb, str(folder), *words

    def _copy(self, limb: str) -> Path:
        """The study to record into again; it needs the depths of former records, and no simulation."""
        copy = self.folder / limb / "acquired"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.study(limb), copy, ignore=shutil.ignore_patterns("runs", "mesh", "*.vtu"))
        return copy


def fill(matrix: Matrix, limbs: Sequence[str], asked: Sequence[str], redo: Sequence[str]) -> None:
    """Run the cells that are due; what is asked of a limb that could not be made is missing."""
    for limb in limbs:
        wanted = [one for one in (PAIRS if limb == PHANTOM else ASKED) if not asked or one in asked]
        due = [one for one in wanted if matrix.is_due((limb, one), [*redo, "missing"])]
        if due and limb != PHANTOM:
            for one in (FIRST, limb) if limb in MADE_OF_IT else (limb,):
                if matrix.is_due((one, MAKE), redo):
                    print(line_of(matrix.run(one, MAKE)), flush=True)
            if matrix.cells[limb, MAKE].outcome != "ok":
                for one in due:
                    matrix._store(Cell(limb, one, "missing"))
                continue
        for one in due:
            print(line_of(matrix.run(limb, one)), flush=True)


def line_of(cell: Cell) -> str:
    red = "  RED" if cell.outcome in RED else ""
    words = f"{cell.limb:<15} {cell.asked:<22} {cell.outcome:<8} {cell.seconds:8.1f} {cell.user_s:8.1f} "
    return f"{words}{cell.memory_MB:7.0f}{red}  {cell.line}".rstrip()


def show(cells: Sequence[Cell]) -> None:
    """All cells with their figures, and how many ended in each way."""
    print(f"{'limb':<15} {'asked':<22} {'outcome':<8} {'wall s':>8} {'user s':>8} {'MB':>7}")
    for cell in cells:
        print(line_of(cell))
    count = {outcome: sum(cell.outcome == outcome for cell in cells) for outcome in OUTCOMES}
    print(", ".join(f"{number} {outcome}" for outcome, number in count.items() if number))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path("runs/everything"), help="of studies and results")
    parser.add_argument(
        "--shared", type=Path, default=HERE.parent / ".." / "shared", help="folder with data/"
    )
    parser.add_argument("--limbs", nargs="+", choices=[*LIMBS, PHANTOM], default=[*LIMBS, PHANTOM])
    parser.add_argument(
        "--ask", nargs="+", choices=[*ASKED, *PAIRS], default=[], help="by default everything"
    )
    parser.add_argument("--limit", type=float, default=600.0, help="processor seconds of a cell")
    parser.add_argument(
        "--redo", nargs="+", choices=["red", *OUTCOMES], default=[], help="cells that ended so"
    )
    parser.add_argument("--show", action="store_true", help="run nothing")
    given = parser.parse_args()
    matrix = Matrix(given.folder, given.shared, given.limit)
    if not given.show:
        redo = [one for name in given.redo for one in (RED if name == "red" else (name,))]
        fill(matrix, given.limbs, given.ask, redo)
    show([cell for cell in matrix.cells.values() if cell.limb in given.limbs])
    return int(any(cell.outcome in RED for cell in matrix.cells.values()))


if __name__ == "__main__":
    sys.exit(main())
