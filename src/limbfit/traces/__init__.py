"""Indentation records: read them, find the touch-down, regularise them.

A record starts clear of the skin (or on it); the indenter is pushed in along a line, held, drawn back, in any
order, at any rates and in several cycles (see `phases`). ``read_trace`` checks it, ``understand`` mends
or refuses it, ``find_touch_down`` tells where the skin was met, and ``regularise`` gives curves counted from
there: piecewise straight for the displacement, a cubic smoothing spline for the force, each phase by itself
so that the peak is not smoothed away (paper, section 2.1 and figure 3). Under a stated force it is the other
way round (``regularise_creep``). Where ultrasound looked through the indenter, ``thinnings`` tell how the
tissues under it gave way, and ``read_wave_speeds`` how fast shear waves ran in them; where cameras looked
beside it, ``read_surface_motion`` tells how the skin there moved.

Units: s, mm, N; force positive when pushing, displacement positive into the limb.
"""

from .interpretation import InterpretedRecord, interpret_record
from .reading import read_trace
from .record import COLUMNS, Remark, Trace, check_trace
from .regularise import Creep, Regularised, regularise, regularise_creep
from .secondary_measurements import (
    Layers,
    SurfaceMeans,
    SurfaceMotion,
    Thinning,
    WaveMeans,
    WaveSpeeds,
    compute_thinnings,
    read_layers,
    read_surface_motion,
    read_wave_speeds,
    select_frames_in_contact,
)
from .touchdown import TouchDown, find_touch_down, touch_down_at

__all__ = [
    "COLUMNS",
    "Creep",
    "InterpretedRecord",
    "Layers",
    "Regularised",
    "Remark",
    "SurfaceMeans",
    "SurfaceMotion",
    "Thinning",
    "TouchDown",
    "Trace",
    "WaveMeans",
    "WaveSpeeds",
    "check_trace",
    "compute_thinnings",
    "find_touch_down",
    "interpret_record",
    "read_layers",
    "read_surface_motion",
    "read_trace",
    "read_wave_speeds",
    "regularise",
    "regularise_creep",
    "select_frames_in_contact",
    "touch_down_at",
]
