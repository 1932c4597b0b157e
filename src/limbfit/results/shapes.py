"""How two shapes differ, and the package of a socket for the shop."""

from collections.abc import Mapping, Sequence

from pydantic import Field

from .base import Interval, ResultPart, Vector


class Circumference(ResultPart):
    """Circumferences of two shapes at a height, as a tape around them measures them."""

    height_mm: float = Field(description="Height over the distal end of the first shape.")
    first_mm: float | None = Field(description="Of the first shape; null: it does not go around there.")
    second_mm: float | None = Field(description="Of the second shape; null as above.")


class ShapeComparison(ResultPart):
    """How two shapes differ."""

    axis: Vector = Field(description="The axis, proximal, LPS.")
    max_mm: float = Field(description="Largest distance of the points of either shape from the other.")
    rms_mm: float = Field(description="RMS distance over the area of both.")
    mean_mm: float = Field(description="Mean signed distance; positive where the second is outside.")
    compared_percent: float = Field(description="Share of the area that faces no open end of the other.")
    lengths_mm: Interval = Field(description="Extents of the two along the axis.")
    volumes_cm3: Interval = Field(description="Volumes of the two; an open end is closed straight.")
    circumferences: Sequence[Circumference] = Field(description="Every 20 mm along the axis.")


class ShopPackage(ResultPart):
    """Files of a socket for the shop, and its measures."""

    files: Mapping[str, str] = Field(description="What each file of the folder `shop` holds, by its name.")
    left_out: Sequence[str] = Field(description="What could not be written, and why.")
    aop_deviation_mm: float | None = Field(description="How far the slices are from the face; null: none.")
    trim_line_mm: float = Field(description="Length of the trim line.")
    volumes_cm3: Interval = Field(description="Of limb and liner, and of the socket up to its trim line.")
    circumferences: Sequence[Circumference] = Field(description="Of limb and liner, and inside the socket.")
    depths_mm: Mapping[str, Vector] = Field(
        description="Mean, least and greatest depth in the unloaded limb over each region; negative: outside."
    )
