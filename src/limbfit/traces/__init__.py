"""Indentation records: read them, find the touch-down, regularise them.

A record starts clear of the skin (or on it). The indenter is pushed in along a line, held and drawn back, in
any order, at any rates and in several cycles (see `phases`). `read_trace` reads and checks the record,
`interpret_record` mends or refuses it, `find_touch_down` finds where the skin was met, and `regularise` makes
curves that are counted from there: piecewise straight for the displacement, a cubic smoothing spline for the
force, each phase by itself so that the peak is not smoothed away (paper, section 2.1 and figure 3). Under a
stated force it is the other way round (`regularise_creep`).

`compute_thinnings` says how tissues under the indenter gave way in ultrasound, `read_wave_speeds` how fast
shear waves ran in them, and `read_surface_motion` how the skin beside the indenter moved.

Units: s, mm, N; force positive when pushing, displacement positive into the limb.
"""

from .interpretation import InterpretedRecord, interpret_record
from .record import COLUMNS, Trace, TraceWarning, check_trace, read_trace
from .regularise import Creep, RegularisedCurve, regularise, regularise_creep
from .secondary_measurements import (
    Layers,
    LayerThinning,
    SurfaceMeans,
    SurfaceMotion,
    WaveMeans,
    WaveSpeeds,
    compute_thinnings,
    read_layers,
    read_surface_motion,
    read_wave_speeds,
    select_frames_in_contact,
)
from .touchdown import TouchDown, find_touch_down, touch_down_at
