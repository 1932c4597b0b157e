"""What every stage is given: the study, where to store, what to run on, whom to tell."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ...execution import Executor, Limits, make_executor
from ...laws import Parameters
from ...results.study_results import StudyResults
from ...study import Study
from .store import Store

NO_PARAMETERS: Parameters = {}  # an experiment's, where its command states none


@dataclass(frozen=True)
class Progress:
    """One step of a stage: ``done`` of ``total`` (``total`` 0: not known), and what is going on in words.

    ``fit``: the words are the identified parameters and their error so far, ``facts`` the same as numbers.
    """

    stage: str
    done: float = 0.0
    total: float = 0.0
    text: str = ""
    fit: bool = False
    facts: Mapping[str, Any] | None = None

    def __str__(self) -> str:
        """One line, as ``listener=print`` shows it."""
        count = f" {round(self.done, 1):g} of {self.total:g}" if self.total else ""
        return f"{self.stage}{count}: {self.text}" if self.text else f"{self.stage}{count}"


Listener = Callable[[Progress], None]


def ignore_progress(progress: Progress) -> None:
    """The listener of a call that names none: progress is not shown."""


@dataclass(frozen=True)
class Context:
    """One run of one study."""

    study: Study
    store: Store
    executor: Executor
    listener: Listener

    def tell(
        self,
        stage: str,
        done: float,
        total: float,
        text: str = "",
        fit: bool = False,
        facts: Mapping[str, Any] | None = None,
    ) -> None:
        self.listener(Progress(stage, done, total, text, fit, facts))

    @property
    def results(self) -> StudyResults:
        """What the finished stages have stored."""
        return self.store.results


def build_executor(study: Study) -> Executor:
    """What a study's jobs run on, with its limits."""
    table = study.execution
    return make_executor(table.workers, Limits(table.time_limit_s, table.memory_limit_GB))
