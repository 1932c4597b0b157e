"""The phantom's ``study.toml``, written as a user would write it."""

from __future__ import annotations

from collections.abc import Sequence

from ..anatomy.meshing.layers import LayerSpec
from .geometry import TENDON, Limb
from .limb_shapes import Shank
from .mri import LABELS_FILE, TENDON_LABEL
from .record import NOTHING, SecondaryMeasurements
from .sites import INDENTER_EDGE_MM, INDENTER_MM, TrueSite
from .socket import FILE as SOCKET_FILE
from .socket import LINER_MM

_HEAD = """\
# A synthetic residuum with known truth: compare what limbfit finds with truth.json.
# Paths are relative to this file; results go to results/ beside it.

[study]
name = "phantom, seed {seed}"
description = "Synthetic {kind} residuum, {detail} detail"

[image]
path = "mri/plain"        # DICOM, ultra-short echo time
markers = "mri/markers"   # the same limb with skin markers on

{labels}[geometry]
{layers}
{regions}surface_edge_mm = {surface:.1f}

[indenter]
shape = "square"
width_mm = {width:.1f}
edge_radius_mm = {edge:.1f}       # as a real punch has; meshes resolve it, a sharp edge they never do

{mesh}{tissues}# One table per indentation.
# 'near' is where the site is as measured by hand: it is matched to a marker.
# The fitted sites identify the material; all others are predicted and compared.
"""

# Edges are limbfit's choice: only a phantom of the paper's detail asks for more.
_MESH = {
    "coarse": "",
    "paper": """\
[mesh]
accuracy = "fine"

""",
}

_LABELS = f"""\
[segmentation]
labels = "{LABELS_FILE.as_posix()}"   # the tendon was drawn by hand

"""
_REGIONS = f"""\
regions = [{{ name = "{TENDON}", label = "{TENDON_LABEL}" }}]   # a tissue of its own
"""
# What the records tell of a tendon is its stiffness; all else of it is the muscle's.
_TISSUES = f"""\
[material.tissues.{TENDON}]
start = {{ c_kPa = 20.0 }}
upper = {{ c_kPa = 500.0 }}

[calibration]
tied = [["{TENDON}.m", "muscle.m"], ["{TENDON}.gamma", "muscle.gamma"], ["{TENDON}.tau_s", "muscle.tau_s"]]

"""
_SURFACE_EDGE_MM = {"coarse": 4.0, "paper": 3.0}

_SITE = """
[[sites]]
name = "{name}"
region = "{region}"
fitted = {fitted}
trace = "traces/site-{name}.csv"
near = [{x:.1f}, {y:.1f}, {z:.1f}]
"""
_ULTRASOUND = """\
ultrasound = "traces/site-{name}-layers.csv"   # thickness of the tissues under the indenter meanwhile
"""
_WAVES = """\
shear_waves = "traces/site-{name}-waves.csv"   # how fast shear waves were under the indenter meanwhile
"""
_SIDE = """\
side = "right"            # of the patient: no fibula beside a tibia says so
"""
_FILE = f"""\
file = "{SOCKET_FILE.as_posix()}"   # a rectified face, around the limb with a liner of {LINER_MM:g} mm
"""
_SURFACE = """\
surface = "traces/site-{name}-surface.csv"     # how the skin around the indenter moved meanwhile
"""


def format_study(
    sites: Sequence[TrueSite],
    detail: str,
    seed: int,
    limb: Limb,
    measurements: SecondaryMeasurements = NOTHING,
    socket: bool = False,
) -> str:
    """Write the content of ``study.toml`` for some sites of a limb."""
    head = _HEAD.format(
        seed=seed,
        detail=detail,
        kind=limb.kind,
        layers=_format_layers(limb.layers),
        labels=_LABELS if limb.has_tendon else "",
        regions=_REGIONS if limb.has_tendon else "",
        tissues=_TISSUES if limb.has_tendon else "",
        surface=_SURFACE_EDGE_MM[detail],
        width=INDENTER_MM,
        edge=INDENTER_EDGE_MM,
        mesh=_MESH[detail],
    )
    parts = [head]
    for site in sites:
        x, y, z = site.hint
        fitted = "true" if site.fitted else "false"
        parts.append(_SITE.format(name=site.name, region=site.region, fitted=fitted, x=x, y=y, z=z))
        for is_measured, line in zip(measurements, (_ULTRASOUND, _SURFACE, _WAVES), strict=True):
            parts += [line.format(name=site.name)] if is_measured else []
    table = [_SIDE] * (not isinstance(limb.shape, Shank)) + [_FILE] * socket
    return "".join([*parts, *(["\n[socket]\n", *table] if table else [])])


def _format_layers(layers: Sequence[LayerSpec]) -> str:
    if len(layers) == 1:
        return f"skin_layer_mm = {layers[0].thickness_mm}       # skin and adipose tissue, uniform"
    tables = ", ".join(
        f'{{ name = "{layer.name}", thickness_mm = {layer.thickness_mm} }}' for layer in layers
    )
    return f"layers = [{tables}]   # uniform, over muscle"
