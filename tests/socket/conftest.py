"""Many tests draw sockets around the same limb: its surface is probed by 20,000 rays once for all of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from limbfit.anatomy.frame import Frame
from limbfit.anatomy.surfaces.triangles import Surface
from limbfit.socket import reading, rectify
from limbfit.socket.rays import LimbProfile, compute_profile


@pytest.fixture(scope="session", autouse=True)
def profiles_shared() -> Iterator[None]:
    """A surface in a frame has its profile computed once; every other one has its own."""
    known: dict[bytes, LimbProfile] = {}

    def compute_once(outer: Surface, frame: Frame) -> LimbProfile:
        local = np.ascontiguousarray(frame.to_limb(outer.points))
        key = local.tobytes() + np.ascontiguousarray(outer.faces).tobytes()
        if key not in known:
            known[key] = compute_profile(outer, frame)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (rectify, reading):
            patch.setattr(module, "compute_profile", compute_once)
        yield
