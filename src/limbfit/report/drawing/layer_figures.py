"""What ultrasound saw of the layers under the indenter, beside its prediction."""

from __future__ import annotations

import matplotlib

from ..formats import fixed
from ..page import Figure
from ..store import Results
from .figures import thin
from .ink import MEASURED, SIMULATED, STYLE, legend_above, panels, svg


def layer_figure(store: Results, fitted: bool) -> Figure | None:
    """Compression of each layer against time at the fitted or held-out sites; None where none was seen."""
    rows = [
        (row, layer, curves)
        for row in store.predicted
        if bool(row.get("fitted")) == fitted
        for layer in row.get("layers") or ()
        if (curves := store.curves("predict", layer["name"])) is not None
    ]
    if not rows:
        return None
    drawing, axes = panels(len(rows), 3, 2.1)
    with matplotlib.rc_context(STYLE):
        for i, (ax, (row, layer, whole)) in enumerate(zip(axes, rows, strict=True)):
            curves = thin(whole)
            x = curves["time_s"]
            ax.plot(x, curves["compression_measured_mm"], ".", ms=4, color=MEASURED, label="ultrasound")
            if "compression_simulated_mm" in curves:
                ax.plot(x, curves["compression_simulated_mm"], color=SIMULATED, label=store.materials)
            if "compression_low_mm" in curves:
                low, high = curves["compression_low_mm"], curves["compression_high_mm"]
                ax.fill_between(x, low, high, color=SIMULATED, alpha=0.22, lw=0, label="95 % interval")
            ax.set_title(f"{row['record']}, {layer['tissue']}: {fixed(layer['error_percent'])} %")
            if i + 3 >= len(rows):
                ax.set_xlabel("Time (s)")
            if i % 3 == 0:
                ax.set_ylabel("Compression (mm)")
        legend_above(drawing, axes[0])
    name = "layers-fitted" if fitted else "layers-held-out"
    told = ", ".join(f"{row['record']} {layer['tissue']}" for row, layer, _ in rows)
    caption = (
        f"Compression of the tissues on the indenter's axis at the {'fitted' if fitted else 'held-out'} "
        "sites, as ultrasound saw it and as predicted; errors are means over the record, in percent of the "
        "largest compression."
    )
    return Figure(name, svg(drawing, name, f"Measured and predicted compression: {told}"), caption)
