"""Other models of the same records: how likely each is, and what predictions owe to the choice."""

from __future__ import annotations

import numpy as np

from ..drawing.colours import INK, MUTED, SIMULATED
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..page import Figure, Note, Prose, Section, make_section
from ..store import Curves, Json, Results, find_compared_quantity
from ..tables import make_table

_MAX_PANELS = 4


def make_models_section(store: Results) -> Section:
    """What ``limbfit uncertainty --models`` found."""
    content = store.models
    rows = [
        row
        | {
            "weight_percent": 100 * row["weight"],
            "named": f"{row['words']} ({row['model']})" if row["model"] != row["words"] else row["words"],
        }
        for row in content["models"]
    ]
    models = make_table(
        "models",
        "Models of the same records. Evidence is 2 ln B against the study's own model: positive where the "
        "records prefer the other.",
        (
            ("Model", "named"),
            ("Fitted (%)", "error_fitted_percent", 2),
            ("Held out (%)", "error_heldout_percent", 2),
            ("Evidence", "evidence", 1),
            ("Weight (%)", "weight_percent", 0),
        ),
        rows,
    )
    records = make_table(
        "models-records",
        "The largest measured value of each record, with 95 % intervals of the study's own model and of all.",
        (
            ("Record", "record"),
            ("Use", lambda row: "fitted" if row["fitted"] else "held out"),
            ("Unit", "unit"),
            ("Measured", "peak", 2),
            ("Own model", lambda row: _format_ends(row["own_interval_95"])),
            ("All models", lambda row: _format_ends(row["interval_95"])),
            ("Between models, sd", "sd_between_models", 3),
        ),
        content["records"],
    )
    return make_section(
        "models",
        "Other models of the same records",
        Prose(
            "Each model was calibrated on the fitted records and predicts every record. Models are weighed "
            "by how probable they make the fitted records; a prediction with all of them is the mixture of "
            "theirs, so that its interval holds what the choice of the model leaves open."
        ),
        models,
        _draw_figure(store),
        records,
        (Note(f"Left out: {text}") for text in content["left_out"].values()),
    )


def _format_ends(interval: list[float]) -> str:
    low, high = interval
    return f"{low:.3g} to {high:.3g}"


def _draw_figure(store: Results) -> Figure | None:
    rows = [row for row in store.models["records"] if not row["fitted"]] or store.models["records"]
    found = store.with_curves("models", rows)[:_MAX_PANELS]
    return _draw_bands(store, found) if found else None


@styled
def _draw_bands(store: Results, found: list[tuple[Json, Curves]]) -> Figure:
    drawing, axes = make_panels(len(found), min(len(found), 2), 2.8)
    for ax, (row, curves) in zip(axes, found, strict=False):
        what, unit = find_compared_quantity(curves)
        time = curves["time_s"]
        low, high = (curves[f"{what}_{end}_{unit}"] for end in ("low", "high"))
        ax.fill_between(time, low, high, color=SIMULATED, alpha=0.25, lw=0, label="95 % by all models")
        for model in store.models["models"][1:]:
            ax.plot(time, curves[f"{what}_{model['model']}_{unit}"], color=MUTED, lw=0.8)
        ax.plot(time, curves[f"{what}_own_{unit}"], color=SIMULATED, label="own model")
        ax.plot(time, curves[f"{what}_measured_{unit}"], color=INK, lw=1.0, label="measured")
        ax.set(title=f"site {row['record']}", xlabel="time (s)", ylabel=f"{what} ({unit})")
        ax.set_xlim(0.0, float(np.max(time)))
    add_legend(drawing, axes[0])
    return make_figure(
        drawing,
        "models",
        "Curves of records with the predictions of several models and one band",
        "Predictions by every model (other than the study's: grey), and the 95 % band of all together.",
    )
