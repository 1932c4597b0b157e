"""The phantom's ``study.toml``, written as a user would write it."""

from __future__ import annotations

from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined

from .geometry import TENDON, Limb
from .mri import LABELS_FILE, TENDON_LABEL
from .record import NOTHING, SecondaryMeasurements
from .sites import INDENTER_EDGE_MM, INDENTER_MM, TrueSite
from .socket import FILE as SOCKET_FILE
from .socket import LINER_MM


def format_study(
    sites: Sequence[TrueSite],
    detail: str,
    seed: int,
    limb: Limb,
    measurements: SecondaryMeasurements = NOTHING,
    socket: bool = False,
) -> str:
    """Write the content of ``study.toml`` for some sites of a limb."""
    loader = PackageLoader("limbfit.phantom", "templates")
    environment = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    return environment.get_template("study.toml.j2").render(
        sites=sites,
        detail=detail,
        seed=seed,
        limb=limb,
        measurements=measurements,
        socket=socket,
        labels_file=LABELS_FILE.as_posix(),
        tendon=TENDON,
        tendon_label=TENDON_LABEL,
        indenter_mm=INDENTER_MM,
        indenter_edge_mm=INDENTER_EDGE_MM,
        socket_file=SOCKET_FILE.as_posix(),
        liner_mm=f"{LINER_MM:g}",
    )
