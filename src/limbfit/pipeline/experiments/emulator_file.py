"""The runs of an emulator as a file: whoever wants the emulator fits it again, which gives the same one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ...identify.fit.objective import SiteResponse
from ...identify.uncertainty.emulator import Emulator
from ..shared.artefacts import write_atomically

EMULATOR = "emulator.npz"


def write_runs(
    file: Path, names: Sequence[str], points: Array, responses: Sequence[Sequence[SiteResponse]]
) -> None:
    """Parameters (k, p), forces (k, N) and derivatives (k, N, p) of all sites, one after the other."""
    with write_atomically(file) as stream:
        np.savez(
            stream,
            names=np.array(names),
            points=np.asarray(points),
            sizes=np.array([response.force_N.size for response in responses[0]]),
            forces=np.array([np.concatenate([r.force_N for r in run]) for run in responses]),
            jacobians=np.array([np.concatenate([r.jacobian for r in run]) for run in responses]),
        )


def read_emulator(file: Path) -> Emulator:
    """The emulator of stored runs.

    Raises
    ------
    InputError
        Where there are none.
    """
    if not file.is_file():
        raise InputError("no emulator is stored", file=file, remedy="run limbfit uncertainty first")
    with np.load(file, allow_pickle=False) as stored:
        ends = np.cumsum(stored["sizes"])[:-1]
        runs = [
            [SiteResponse(f, j) for f, j in zip(np.split(force, ends), np.split(jacobian, ends))]
            for force, jacobian in zip(stored["forces"], stored["jacobians"])
        ]
        return Emulator.fit(tuple(map(str, stored["names"])), stored["points"], runs)
