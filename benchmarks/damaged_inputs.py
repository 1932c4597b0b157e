"""Does every damaged input end in one clear line, or in the right model?

    python benchmarks/damaged_inputs.py --cases 200 --seed 0 --json damaged_inputs.json
    python benchmarks/damaged_inputs.py --only gantry_tilt limb_islands

Cases are the kinds of ``damage.KINDS`` in turn, each drawn from (seed, number) alone and made from the
coarse synthetic patient.  Each runs ``limbfit run STUDY --until surfaces`` in a process of its own with a
time limit.  What came of it must be what its kind says; a run that is done must have the surfaces of the
undamaged study.  Anything else is counted as

crash    a traceback, or an exit code other than 0 and 2
hang     no end within the time limit
silent   done, but with other surfaces, or without saying what was repaired
wrong    refused where it should not be, done where it should not be, or refused in other words
"""

import argparse
import json
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import damage_dicom  # noqa: F401
import damage_enhanced  # noqa: F401
import damage_files  # noqa: F401
import damage_labels  # noqa: F401
import damage_surfaces  # noqa: F401
import igl
import numpy as np
from damage import KINDS, Kind, Whole, make_whole, read_whole

from limbfit import check_study, run_study
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface, load_anatomy
from limbfit.cli import main as limbfit

TIME_LIMIT_S = 300.0
LOADED = (check_study, run_study)  # what the children would else load one by one
FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True)
class Outcome:
    """What came of a case: ``verdict`` is ``refused``, ``same``, ``repaired`` or what is wrong."""

    number: int
    kind: str
    room: str
    verdict: str
    text: str
    off_mm: float | None
    cpu_s: float


def run_case(number: int, kind: Kind, whole: Whole, folder: Path, seed: int, verb: str = "run") -> Outcome:
    """Make and run one case in this process's child."""
    folder.mkdir(parents=True)
    random = np.random.default_rng([seed, number])
    inputs = kind.make(random, whole, folder)
    (folder / "study.toml").write_text(whole.study(inputs))
    words = [verb, str(folder), *(["--until", "surfaces"] if verb == "run" else [])]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    child = FORK.Process(target=_in_child, args=(words, folder))
    child.start()
    child.join(TIME_LIMIT_S)
    if child.exitcode is None:
        child.kill()
        child.join()
        return Outcome(number, kind.name, kind.room, "hang", "", None, TIME_LIMIT_S)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    told = (folder / "stderr.txt").read_text() + (folder / "stdout.txt").read_text()
    verdict, text, off = judge(kind, child.exitcode, told, folder, whole, verb)
    return Outcome(number, kind.name, kind.room, verdict, text, off, round(cpu, 2))


def _in_child(words: list[str], folder: Path) -> None:
    sys.argv = ["limbfit", *words]
    with (folder / "stderr.txt").open("w") as err, (folder / "stdout.txt").open("w") as out:
        os.dup2(err.fileno(), 2)
        os.dup2(out.fileno(), 1)
        sys.stderr, sys.stdout = err, out
        limbfit()


def judge(
    kind: Kind, code: int, told: str, folder: Path, whole: Whole, verb: str
) -> tuple[str, str, float | None]:
    """Verdict, the line or the surfaces' difference in words, and that difference in mm."""
    lines = [line for line in told.splitlines() if line and not line.startswith("[")]
    errors = [line for line in lines if line.startswith("error: ")]
    if "Traceback" in told or code not in (0, 2) or (code == 2 and len(errors) != 1):
        return "crash", f"exit {code}: {told[-400:]}", None
    if code == 2:
        line = errors[0]
        fits = kind.expected in ("refused", "either") and kind.says in line and len(lines) == 1
        return ("refused" if fits else "wrong"), line.replace(str(folder), "."), None
    if kind.expected == "refused":
        return "wrong", "done, but should be refused", None
    if kind.expected == "repaired" and kind.says not in told:
        return "silent", "the repair is not said", None
    said = next((line for line in told.splitlines() if kind.says and kind.says in line), "")
    name = "repaired" if kind.expected == "repaired" else "same"
    if verb != "run":
        return name, said, None
    off = difference(load_anatomy(folder / "results" / "surfaces"), whole.anatomy)
    if off > kind.within_mm:
        return "silent", f"surfaces differ by up to {off:.3g} mm", off
    return name, said, off


def difference(found: Anatomy, wanted: Anatomy) -> float:
    """The largest distance between the surfaces of two anatomies, mm, or ten times that of their centres."""
    if set(found.bones) != set(wanted.bones):
        return float("inf")
    pairs = [(found.skin, wanted.skin), *((found.bones[name], wanted.bones[name]) for name in found.bones)]
    return max(max(_farthest(a, b), _farthest(b, a), 10 * _moved(a, b)) for a, b in pairs)


def _moved(a: Surface, b: Surface) -> float:
    """How far the centre of a surface is from the other's, mm; it shows less of how either was remeshed."""
    return float(np.linalg.norm(_centre(a) - _centre(b)))


def _centre(surface: Surface) -> np.ndarray:
    weights = surface.face_areas
    return weights @ surface.triangles.mean(axis=1) / weights.sum()


def _farthest(a: Surface, b: Surface) -> float:
    squared = igl.point_mesh_squared_distance(a.points, b.points, b.faces)[0]
    return float(np.sqrt(squared.max()))


def summary(outcomes: list[Outcome]) -> str:
    rows = {kind: Counter(o.verdict for o in outcomes if o.kind == kind) for kind in KINDS}
    width = max(map(len, KINDS))
    lines = [
        f"{kind:{width}}  {KINDS[kind].expected:9}  " + ", ".join(f"{n} {v}" for v, n in count.items())
        for kind, count in rows.items()
        if count
    ]
    total = Counter(o.verdict for o in outcomes)
    return "\n".join([*lines, "all: " + ", ".join(f"{n} {v}" for v, n in total.most_common())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--start", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=sorted(KINDS), default=None)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    names = list(KINDS)
    cases = [(n, KINDS[names[n % len(names)]]) for n in range(options.start, options.cases)]
    outcomes = []
    with tempfile.TemporaryDirectory() as place:
        whole = _whole(Path(place) / "whole", options.seed)
        for number, kind in cases:
            if options.only and kind.name not in options.only:
                continue
            start = time.perf_counter()
            outcome = run_case(number, kind, whole, Path(place) / f"case-{number}", options.seed)
            outcomes.append(outcome)
            seconds = time.perf_counter() - start
            print(
                f"{number:4d} {kind.name:26} {outcome.verdict:9} {seconds:5.1f} s  {outcome.text}", flush=True
            )
            if options.json:
                options.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    print(summary(outcomes))


def _whole(folder: Path, seed: int) -> Whole:
    """Made in a child, so that this process, which forks, has started no thread; then read."""
    child = FORK.Process(target=make_whole, args=(folder, seed))
    child.start()
    child.join()
    return read_whole(folder)


if __name__ == "__main__":
    main()
