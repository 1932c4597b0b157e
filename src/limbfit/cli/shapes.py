"""``limbfit shapes``: shapes of limbs and sockets converted, compared, and made a model of."""

from itertools import chain, repeat
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import limbfit

from ..results.population import ShapeModelResult
from ..results.shapes import ShapeComparison
from .console import AsJson, Column, print_line, print_result, print_table, print_warnings

app = typer.Typer(
    help="Shapes of limbs and sockets: convert, compare, model.", no_args_is_help=True, rich_markup_mode=None
)
Unit = Literal["mm", "cm", "m", "inch"]
StatedUnit = Annotated[Unit | None, typer.Option(help="of files that do not say theirs")]
Space = Annotated[Literal["LPS", "RAS"] | None, typer.Option(help="of files that do not say it; else LPS")]
Body = Annotated[str | None, typer.Option(help="of a file of several: its name, or number by size")]
Direction = Literal["x", "-x", "y", "-y", "z", "-z"]
Proximal = Annotated[Direction, typer.Option(help="about the direction towards the body, LPS")]
Sense = Literal["clockwise", "counter-clockwise"]
Spokes = Annotated[Sense | None, typer.Option(help="of AOP files that do not say it; seen from proximal")]
Shape = Annotated[Path, typer.Argument(help=".stl, .ply, .obj, .vtp, .3mf or .aop", show_default=False)]


@app.command()
def convert(
    source: Shape,
    target: Shape,
    body: Body = None,
    unit: StatedUnit = None,
    space: Space = None,
    proximal: Proximal = "z",
    spokes: Spokes = None,
    close: Annotated[bool, typer.Option("--close", help="cap an open end, and fill small holes")] = False,
    tolerance_mm: Annotated[float, typer.Option(help="by which slices may deviate (AOP)", min=0.0)] = 0.1,
    as_json: AsJson = False,
) -> None:
    """Write a surface in another format, in mm and LPS, and say how far it is from the first one."""
    reading: dict[str, Any] = {"body": body, "unit": unit, "space": space, "spokes": spokes}
    options: dict[str, Any] = {"proximal": proximal, "close": close, "tolerance_mm": tolerance_mm}

    def show(made: dict[str, Any]) -> None:
        print_warnings(made["notes"])
        size = " x ".join(f"{length:.1f}" for length in made["size_mm"])
        print_line(f"{target}: {size} mm, within {made['deviation_mm']:.3f} mm of {source}")

    print_result(limbfit.convert_shape(source, target, **options, **reading), show, as_json)


@app.command()
def compare(
    first: Shape,
    second: Shape,
    register: Annotated[bool, typer.Option("--register", help="move the second onto the first")] = False,
    body: Body = None,
    unit: StatedUnit = None,
    space: Space = None,
    proximal: Proximal = "z",
    spokes: Spokes = None,
    map_file: Annotated[Path | None, typer.Option("--map", help="a .vtp for signed distances")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare two shapes: distances, volumes, and circumferences every 20 mm."""
    reading: dict[str, Any] = {"body": body, "unit": unit, "space": space, "spokes": spokes}
    options: dict[str, Any] = {"register": register, "proximal": proximal, "map_file": map_file}
    found = limbfit.compare_shapes(first, second, **options, **reading)
    print_result(found.to_plain(), lambda _: show_comparison(found), as_json)


def show_comparison(found: ShapeComparison) -> None:
    """Distances, volumes and circumferences."""
    words = f"{found.max_mm:.3f} mm at most, {found.rms_mm:.3f} mm RMS, {found.mean_mm:+.3f} mm in the mean"
    print_line(f"distance: {words} (+: the second is outside), {found.compared_percent:.0f} % of the area")
    (one, other), (length, other_length) = found.volumes_cm3, found.lengths_mm
    print_line(f"{one:.1f} and {other:.1f} cm3, {length:.1f} and {other_length:.1f} mm long")
    columns: dict[str, Column] = {"height (mm)": ("height_mm", ".0f")}
    columns |= {"around the first (mm)": ("first_mm", ".1f"), "the second (mm)": ("second_mm", ".1f")}
    print_table(found.circumferences, columns)


@app.command()
def model(
    limbs: Annotated[
        list[Path], typer.Argument(help="a file with all bodies of a limb, or a folder of bodies, each")
    ],
    out: Annotated[Path, typer.Option(help="the file of the model")] = Path("limbs.npz"),
    unit: Annotated[Unit, typer.Option(help="of the files")] = "mm",
    register: Annotated[
        bool, typer.Option("--register", help="not in correspondence: bend the first limb onto the others")
    ] = False,
    mean: Annotated[
        Path | None, typer.Option(help="the limbs are deviations of this mean, along modes")
    ] = None,
    at: Annotated[float, typer.Option(help="with --mean: of so many standard deviations", min=0.1)] = 2.0,
    as_json: AsJson = False,
) -> None:
    """Make a shape model of limbs: their mean, and the modes in which they differ."""
    made = limbfit.build_shape_model(limbs, unit=unit, register=register, mean=mean, at=at)
    made.write(out)

    def show(figures: dict[str, Any]) -> None:
        show_shape_model(ShapeModelResult.model_validate(figures))
        print_line(f"stored in {out}")

    print_result(made.figures.to_plain(), show, as_json)


def show_shape_model(figures: ShapeModelResult) -> None:
    """The figures of a model, mode by mode."""
    print_line(f"{figures.limbs} limbs of {figures.points} points: {', '.join(figures.bodies)}")
    modes = zip(figures.explained, figures.deviation_mm, chain(figures.left_out_mm or (), repeat(None)))
    rows = [
        {"mode": number, "share": 100 * share, "move": move, "left": left}
        for number, (share, move, left) in enumerate(modes, 1)
    ]
    columns: dict[str, Column] = {
        "modes": "mode",
        "variance explained (%)": ("share", ".1f"),
        "one deviation (mm)": ("move", ".2f"),
        "a limb left out (mm)": ("left", ".2f"),
    }
    print_table(rows, columns)
    if figures.specificity_mm is not None:
        print_line(f"specificity: drawn limbs are {figures.specificity_mm:.1f} mm from the nearest one (RMS)")
    if figures.registration_rms_mm is not None:
        print_line(
            f"registered within {figures.registration_rms_mm:.2f} mm (RMS), 5 % of the points beyond "
            f"{figures.registration_p95_mm:.2f} mm, for the worst limb"
        )
