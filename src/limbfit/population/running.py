"""A trial is run: each person is a job, whose rows are stored as it ends.

Rows lie in ``results/people.parquet``, a file for each person and rule, which pandas reads as one table with
the columns of `COLUMNS`. A file is there whole or not at all, and its name holds a digest of all that decides
it: a run that was killed goes on with what is missing, and a changed rule is simulated anew.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pyvista as pv
from filelock import FileLock
from scipy.spatial import cKDTree

from ..anatomy.surfaces.surfaces import load_anatomy
from ..arrays import Array
from ..errors import InputError, LimbfitError, RunError
from ..execution import Limits, limit_cores, make_executor, report_progress
from ..extensions import import_extra
from ..pipeline.commands.planning import fit_socket
from ..pipeline.commands.run import ensure_compiled, run_study
from ..pipeline.engine.context import Listener, Progress, ignore_progress
from ..pipeline.engine.digests import code_digest, compute_digest, compute_input_digest
from ..pipeline.engine.store import lock, write_atomically
from ..results.socket import SocketLoad, SocketResult
from .people import People
from .trial import RuleTable, Trial

STORE, PEOPLE, FIELDS = "people.parquet", "people", "skin-pressure"
COLUMNS = ("person", "rule", "state", "text", "load", "place", "quantity", "value")
DONE, FAILED, REJECTED, INPUT = "done", "failed", "rejected", "input"
WHOLE = "the limb"
FIRST_APART = 1_000_000  # numbers from here on are those of the search for a robust rule
_NEAR_MM = 15.0  # from a point of the skin to the mesh's outer surface, beyond the liner
_MOST_DRAWN = 4  # times the people that are wanted: a trial that rejects more than it takes has a fault
_REGION = ("mean_kPa", "peak_kPa", "shear_kPa", "shear_peak_kPa")


def import_pandas() -> Any:
    """Pandas with its Parquet engine. Raises `InputError` where one is not installed."""
    import_extra("pyarrow", "population")
    return import_extra("pandas", "population")


@dataclass(frozen=True)
class TrialStore:
    """The stored rows of a trial."""

    trial: Trial

    @property
    def folder(self) -> Path:
        return self.trial.results / STORE

    @cached_property
    def _common_digest(self) -> str:
        """Digest of what decides everybody's answers."""
        trial, shapes = self.trial, self.trial.shapes
        tables = trial.model_dump(mode="json", include={"shapes", "tissues", "weight", "liner", "person"})
        files = [shapes.model] if shapes.model else [shapes.folder] if shapes.folder else []
        if trial.tissues.study is not None:
            files.append(trial.tissues.study / "results" / "calibrate" / "calibration.json")
        known = [compute_input_digest(trial.path(file)) for file in files if trial.path(file).exists()]
        return compute_digest(tables, trial.population.seed, known, code_digest(simulate_person))

    def file(self, number: int, rule: RuleTable) -> Path:
        """Where the rows of a person with a rule are."""
        digest = compute_digest(self._common_digest, rule.model_dump(mode="json"))[:12]
        return self.folder / f"{number:05d}-{digest}.parquet"

    def read(self, rules: Sequence[RuleTable] | None = None) -> Any:
        """All rows of these rules as a data frame; by default those of the trial and its people."""
        pandas = import_pandas()
        known = [_split_name(self.file(0, rule))[1] for rule in rules or self.trial.rules]
        found = sorted((*_split_name(file), file) for file in self.folder.glob("*.parquet"))
        files = [file for number, end, file in found if end in known and (rules or number < FIRST_APART)]
        if not files:
            return pandas.DataFrame({name: [] for name in COLUMNS})
        return pandas.read_parquet(files)

    def write(self, number: int, rule: RuleTable, state: str, text: str, rows: list[tuple[Any, ...]]) -> None:
        """Store the ``rows`` (load, place, quantity, value) of a person with a rule."""
        frame = import_pandas().DataFrame(
            [(number, rule.name, state, text, *row) for row in rows or [("", "", "", np.nan)]],
            columns=list(COLUMNS),
        )
        self.folder.mkdir(parents=True, exist_ok=True)
        with write_atomically(self.file(number, rule)) as stream:
            frame.to_parquet(stream, index=False)

    def drop_stale(self) -> None:
        """Delete rows that no rule's digest knows any more, but for the search for a robust rule."""
        known = [_split_name(self.file(0, rule))[1] for rule in self.trial.rules]
        for file in self.folder.glob("*.parquet"):
            number, end = _split_name(file)
            if number < FIRST_APART and end not in known:
                file.unlink()


def _split_name(file: Path) -> tuple[int, str]:
    """The person's number and the digest in the name of a file of rows."""
    number, _, digest = file.stem.partition("-")
    return int(number), digest


@dataclass(frozen=True)
class PersonJob:
    """A person who wears the socket of each rule."""

    trial: Trial
    rules: tuple[RuleTable, ...]
    number: int


def find_person_folder(trial: Trial, number: int, rule: str = "") -> Path:
    """Where the studies of a person lie, or the one with a rule's socket."""
    return trial.results / PEOPLE / f"{number:05d}" / rule


def simulate_person(job: PersonJob) -> int:
    """Build a person's limb, put on every socket that is missing, and store what each does; the number.

    What fails is stored with its reason, and the next socket follows. A limb that no tissue fits into is
    rejected: then nobody is there.
    """
    trial, store, people = job.trial, TrialStore(job.trial), People(job.trial)
    person = people.draw(job.number)
    folder = find_person_folder(trial, job.number)
    folder.mkdir(parents=True, exist_ok=True)
    with limit_cores(1), FileLock(folder / ".lock"):  # a worker of a run that was killed may still be at it
        missing = [rule for rule in job.rules if not store.file(job.number, rule).is_file()]
        if not missing:
            return job.number
        start = perf_counter()
        limb = people.build_limb(person, folder)
        studies = [people.write_study(person, rule, limb, folder / rule.name) for rule in missing]
        report_progress([0.0, "the limb's surfaces"])
        try:  # the limb is the same with every socket
            run_study(studies[0], until="surfaces")
            people.check_limb(load_anatomy(studies[0].results / "surfaces"))
        except InputError as error:
            for rule in job.rules:
                store.write(job.number, rule, REJECTED, _describe_loss(error, folder), [])
            shutil.rmtree(folder, ignore_errors=True)
            return job.number
        shared = (perf_counter() - start) / len(missing)
        for i, (rule, study) in enumerate(zip(missing, studies, strict=True)):
            start = perf_counter()

            def tell(event: Progress, i: int = i, rule: RuleTable = rule) -> None:
                share = min(event.done / event.total, 1.0) if event.total and event.stage == "socket" else 0.0
                report_progress([float((i + share) / len(missing)), f"{rule.name}: {event.text}"])

            try:
                fit_socket(study, parameters=people.choose_parameters(person, study), listener=tell)
            except LimbfitError as error:
                store.write(job.number, rule, FAILED, _describe_loss(error, folder), [])
                continue
            found = SocketResult.read(study.results)
            if limb.skin_points is not None:
                _write_skin_pressure(study.results / "socket", limb.skin_points, found)
            seconds = perf_counter() - start + shared
            rows = [("", INPUT, name, value) for name, value in person.inputs.items()]
            store.write(job.number, rule, DONE, "", [*rows, *_list_rows(found), ("", "", "seconds", seconds)])
    return job.number


def _describe_loss(error: LimbfitError, folder: Path) -> str:
    """Why a person is missing; files are named from the person's folder, for tables are passed on."""
    return str(error).replace(f"{folder}{os.sep}", "")


def _list_rows(found: SocketResult) -> Iterator[tuple[str, str, str, float]]:
    """Load, place, quantity and value of all that a trial keeps of a socket."""
    for load, state in found.states.items():
        for key in ("mean_kPa", "peak_kPa", "shear_peak_kPa", "contact_area_mm2"):
            yield load, WHOLE, key, getattr(state, key)
        if isinstance(state, SocketLoad):
            yield load, WHOLE, "settling_mm", state.settling_mm
        for region in state.regions:
            yield from ((load, region.region, key, getattr(region, key)) for key in _REGION)
        for tissue in state.inside:
            yield load, tissue.tissue, "shear_strain", tissue.shear
            for level, volume in tissue.sheared_mm3.items():
                yield load, tissue.tissue, f"volume sheared over {level} (cm3)", volume / 1000.0


def _write_skin_pressure(folder: Path, points: Array, found: SocketResult) -> None:
    """Store the pressure (k, n) in kPa at points (n, 3) of the skin, after donning and each load."""
    grids = [pv.read(folder / f"held-{i}.vtu") for i in range(len(found.states))]
    outer = np.unique(np.asarray(grids[0].field_data["face_set:skin"])[:, :3])
    far, near = cKDTree(np.asarray(grids[0].points)[outer]).query(points)
    reached = far < _NEAR_MM + found.socket.liner.thickness_mm
    pressure = np.array([grid.point_data["pressure_kPa"] for grid in grids], dtype=np.float32)
    np.save(folder / f"{FIELDS}.npy", np.where(reached, pressure[:, outer[near]], np.float32(0.0)))


def run_people(
    trial: Trial,
    wanted: int,
    *,
    rules: Sequence[RuleTable] = (),
    first: int = 1,
    listener: Listener = ignore_progress,
) -> list[int]:
    """Simulate people until so many wear the socket of every rule, of the trial or stated; their numbers.

    Those who were rejected, or for whom a simulation failed, do not count: others follow, from number
    ``first`` on. What is stored is not done again. Raises `RunError` where hardly anybody remains, or another
    process runs the trial.
    """
    chosen, store = tuple(rules) or trial.rules, TrialStore(trial)
    ended, following = list[int](), first
    while len(ended) < wanted:
        if following - first >= _MOST_DRAWN * wanted + 8:
            rows = store.read(chosen)
            lost = rows[rows["state"] != DONE].drop_duplicates(["person", "rule"])[-1:]
            reason = "".join(f"; the last one: {row.state}, {row.text}" for row in lost.itertuples())
            counts = f"{len(ended)} of {following - first}"
            raise RunError(f"{trial.file}: only {counts} people could be simulated{reason}")
        numbers = range(following, following + wanted - len(ended))
        run_jobs([PersonJob(trial, chosen, n) for n in numbers], len(ended), wanted, listener)
        following = numbers.stop
        ended = [n for n in list_done(store.read(chosen), chosen) if first <= n < following]
    return ended[:wanted]


def run_jobs(jobs: Sequence[PersonJob], before: int, wanted: int, listener: Listener) -> None:
    """Do the jobs of one trial side by side; ``before`` of the ``wanted`` people were done already."""
    trial, shares, start = jobs[0].trial, dict[int, float](), perf_counter()
    limits = Limits(trial.execution.time_limit_s, trial.execution.memory_limit_GB)
    People(trial)  # refuses what cannot be used before anything is simulated
    ensure_compiled()

    def tell(job: PersonJob, message: Any) -> None:
        shares[job.number], words = message
        done = sum(shares.values())
        left = (perf_counter() - start) * (len(jobs) - done) / done if done > 0.05 else 0.0
        end = f"; about {left / 60:.0f} min left" if left else ""
        listener(Progress("people", before + done, wanted, f"person {job.number}, {words}{end}"))

    with lock(trial.results), make_executor(trial.execution.workers, limits, renew=True) as executor:
        for number in executor.map(simulate_person, jobs, on_lost=_store_loss, on_report=tell):
            shares[number] = 1.0


def _store_loss(job: PersonJob, reason: str) -> int:
    store = TrialStore(job.trial)
    for rule in job.rules:
        if not store.file(job.number, rule).is_file():
            store.write(job.number, rule, FAILED, reason, [])
    return job.number


def list_done(rows: Any, rules: Sequence[RuleTable]) -> list[int]:
    """The numbers of the people who wear the socket of every rule, by the stored rows."""
    done = rows[rows["state"] == DONE].groupby("person")["rule"].nunique()
    return sorted(int(number) for number in done[done == len(rules)].index)
