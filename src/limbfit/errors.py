"""The exception tree of limbfit.

    LimbfitError
    +-- InputError            what the user gave cannot be used        (command line: exit code 2)
    |   +-- StudyError        the study file
    |   +-- ImageError        an image series or volume
    |   +-- LabelError        a label map
    |   +-- SurfaceError      a surface
    |   +-- SiteError         an indentation site
    |   +-- TraceError        an indentation record
    |   +-- ProblemError      a mechanical problem that is impossible as stated
    +-- MeshingError          no usable mesh came out                  (exit code 1)
    +-- CalibrationError      the identification cannot go on          (exit code 1)
    +-- RunError              a run cannot go on (lock, disk, worker)  (exit code 1)

A *failed simulation* is not an exception: it is a result with ``completed=False`` and a reason.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path


class LimbfitError(Exception):
    """Base of everything limbfit raises on purpose; its text is one line for the user."""


class InputError(LimbfitError):
    """Input that cannot be used.

    Parameters
    ----------
    what : what is wrong, in one clause.
    file : the file or folder at fault.
    place : where in it (a line, a key, a slice).
    remedy : what the user can do about it.
    """

    def __init__(
        self,
        what: str,
        *,
        file: str | Path | None = None,
        place: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.what, self.file, self.place, self.remedy = what, file, place, remedy
        head = ": ".join(str(part) for part in (file, place) if part)
        text = f"{head}: {what}" if head else what
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(" ".join(text.split()))

    def __reduce__(self) -> tuple:
        """Survive the trip back from a worker process (the default would lose the keywords)."""
        return partial(type(self), file=self.file, place=self.place, remedy=self.remedy), (self.what,)


@contextmanager
def add_location(file: str | Path | None = None, place: str | None = None) -> Iterator[None]:
    """Say of an `InputError` that is raised within in which file, and where in it, the fault lies."""
    try:
        yield
    except InputError as error:
        raise type(error)(
            error.what, file=file or error.file, place=place or error.place, remedy=error.remedy
        ) from None


class StudyError(InputError):
    """The study file."""


class ImageError(InputError):
    """An image series or volume."""


class LabelError(InputError):
    """A label map."""


class SurfaceError(InputError):
    """A surface."""


class SiteError(InputError):
    """An indentation site."""


class TraceError(InputError):
    """An indentation record."""


class ProblemError(InputError):
    """A mechanical problem that is impossible as stated."""


class MeshingError(LimbfitError):
    """No usable mesh came out of a mesher."""


class CalibrationError(LimbfitError):
    """The identification cannot go on."""


class RunError(LimbfitError):
    """A run cannot go on: a lock is held, the disk is full, a worker is gone."""
