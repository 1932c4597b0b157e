"""Keys of stages and experiments: digests of all that decides them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ...extensions import compute_extensions_digest
from ...study import Study
from .digests import code_digest, compute_digest, compute_file_digest
from .provenance import list_input_files


@dataclass(frozen=True)
class Stage:
    """A stage: what it stands on, which tables it reads, and which keys of ``[[sites]]`` and ``[[records]]``.

    ``apart`` are keys of its tables, such as ``socket.design``, that it does not read. Its code is that of
    `digests.find_sources`.
    """

    name: str
    run: Callable[..., dict[str, Any]]
    needs: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    site_keys: tuple[str, ...] = ()
    record_keys: tuple[str, ...] = ()
    apart: tuple[str, ...] = ()

    def read(self, stated: Mapping[str, Any]) -> dict[str, Any]:
        """What it reads of the tables of a study, by their names."""
        found = {table: stated[table] for table in self.tables}
        for table, _, key in (name.partition(".") for name in self.apart):
            found[table] = {name: value for name, value in (found[table] or {}).items() if name != key}
        return found


def select_records_read(stage: Stage, stated: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What a stage reads of ``[[records]]``, one after the other; nothing where there are none."""
    rows = stated["records"] if stage.record_keys else []
    return [{key: row[key] for key in stage.record_keys} for row in rows]


@dataclass(frozen=True)
class Keys:
    """Keys of the stages of one study; input files are digested once, whatever part of it is asked about."""

    study: Study

    @cached_property
    def digests(self) -> dict[Path, str]:
        named = {path for paths in list_input_files(self.study).values() for path in paths}
        places = {path: self.study.path(path) for path in named}
        # A record that is yet to be made has none.
        return {path: compute_file_digest(place) if place.exists() else "" for path, place in places.items()}

    @cached_property
    def extensions(self) -> str:
        """Of the study's own Python files, which may change what any stage does."""
        return compute_extensions_digest(self.study.extensions)

    def of(
        self,
        stages: Iterable[Stage],
        known: Mapping[str, str] | None = None,
        study: Study | None = None,
        options: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> dict[str, str]:
        """The key of each stage, in order; those below it are among ``stages`` or ``known``.

        Parameters
        ----------
        known : keys of other stages; a stage that is in it has that key.
        study : a part of the study, instead of the whole.
        options : what a stage is run with beside the study, by its name.
        """
        known, options, study = known or {}, options or {}, study or self.study
        stated, files = study.model_dump(mode="json"), list_input_files(study)
        found: dict[str, str] = {}
        for stage in stages:
            read = files.get(stage.name)
            extra = [options[stage.name]] if options.get(stage.name) else []
            found[stage.name] = known.get(stage.name) or compute_digest(
                stage.name,
                stage.read(stated),
                [{key: site[key] for key in stage.site_keys} for site in stated["sites"]],
                *select_records_read(stage, stated),
                None if read is None else {str(path): self.digests[path] for path in read},
                code_digest(stage.run),
                *([self.extensions] if self.extensions else []),
                [found.get(below) or known.get(below) for below in stage.needs],
                *extra,
            )
        return found
