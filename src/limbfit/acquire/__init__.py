"""The indentation experiment: its protocol, its safety, the device at the other end of a wire, its record.

Vocabulary.  The device is a ring of pins (indenters).  A pin's *position* counts from its home, fully
withdrawn, positive towards the limb; its *force* is positive when the limb pushes back; its *capacitance*
rises as its head comes near the skin.  On the wire and inside all three are integers: um, mN and fF; times
of the device are us of its own clock.

Nothing here knows a study, a mesh or a solver: `limbfit.pipeline` puts them together.
"""
