"""The quality sheet of the segmentation in the report."""

from __future__ import annotations

import base64
from html import escape

from ..page import Figure
from ..store import Results


def slices_figure(store: Results) -> Figure | None:
    """The stored picture of outlines over slices, and what its slices to look at are."""
    file = store.folder / "segment" / "quality.png"
    if not file.is_file():
        return None
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    caption = (
        "Outlines of the limb and of its labels over slices from end to end; enlarged below: slices in which "
        "an area or a centroid does not fit its neighbours."
    )
    markup = f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}" style="width:100%">'
    return Figure("slices", markup, caption)
