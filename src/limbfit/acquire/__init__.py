"""The indentation experiment: its protocol, its safety, the device at the other end of a wire, its record.

Vocabulary.  The device is a ring of pins (indenters).  A pin's *position* counts from its home, fully
withdrawn, positive towards the limb; its *force* is positive when the limb pushes back; its *capacitance*
rises as its head comes near the skin.  On the wire and inside all three are integers: um, mN and fF; times
of the device are us of its own clock.

Nothing here knows a mesh or a solver, and of the study the table ``[acquire]`` alone: `limbfit.pipeline` puts
them together.
"""

from .device import DEFAULT_ADDRESS, DEFAULT_PORT, Device, LineDevice, connect
from .protocol import Event, Settings
from .recording import (
    RecordedRamp,
    Recorder,
    Recording,
    Verdict,
    check_record,
    find_ramps,
    follow_recording,
    read_recording,
)
from .session import (
    Keyboard,
    Listener,
    LiveUpdate,
    NoOperator,
    PhaseUpdate,
    Session,
    Update,
    prioritise,
    run_session,
)
