"""The commands of one study: made, checked, run, simulated; and its geometry, stage by stage."""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

from typer import Argument, Option

import limbfit

from ..errors import InputError
from ..results.limb import MeshMeasures
from ..results.study_results import StudyResults
from ..study import Study
from . import console
from .console import AsJson, Column

StudyPath = Annotated[Path, Argument(help="study.toml, or the folder that holds it", show_default=False)]
Parameters = Annotated[
    str | None,
    Option(
        help="the law's parameters of each tissue (c_kPa,m,gamma,tau_s unless the study has another), "
        "outermost first; default: identified, or the study's start where nothing is"
    ),
]


def stage_option(*names: str, help: str) -> Any:
    """An option that names a stage, or several."""
    return Option(*names, help=help, autocompletion=lambda: list(limbfit.STAGE_NAMES))


def call_on_study(study: Path, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a function of the library on a study, and show its progress; ``parameters`` are read from text."""
    checked = limbfit.load_study(study)
    if "parameters" in options:
        options["parameters"] = parse_parameters(options["parameters"], checked)
    return console.call_with_progress(function, checked, *arguments, **options)


def demo(
    folder: Annotated[Path, Argument(help="where to put the demo study")] = Path("limbfit-demo"),
    seed: Annotated[int, Option(help="which synthetic patient", min=0)] = 0,
    as_json: AsJson = False,
) -> None:
    """Identify a coarse synthetic patient: the whole path, from DICOM to report.

    The patient of seed 0 comes with limbfit; those of other seeds are made first.
    """
    start = perf_counter()
    summary = console.call_with_progress(limbfit.run_demo, folder, seed=seed)
    summary["seconds"] = round(perf_counter() - start, 1)
    console.print_result(summary, show_summary, as_json)
    if not as_json:
        console.print_line(
            f"next: limbfit studio {folder} shows it all in a browser; limbfit uncertainty {folder} finds "
            f"what the records determine; {folder / 'study.toml'} is an example of a study file"
        )


def phantom(
    folder: Annotated[Path, Argument(help="a folder that does not exist yet", show_default=False)],
    detail: Annotated[Literal["coarse", "paper"], Option(help="coarse: 6 sites; paper: 18 sites")] = "coarse",
    seed: Annotated[int, Option(help="which synthetic patient", min=0)] = 0,
    limb: Annotated[Literal["transtibial", "transfemoral"], Option(help="which amputation")] = "transtibial",
    fat: Annotated[bool, Option("--fat", help="three tissues: skin, fat and muscle")] = False,
    tendon: Annotated[bool, Option("--tendon", help="also a patellar tendon in the muscle")] = False,
    socket: Annotated[bool, Option("--socket", help="also a rectified socket for it")] = False,
    sensors: Annotated[bool, Option("--sensors", help="also what sensors in the socket measure")] = False,
    ultrasound: Annotated[bool, Option("--ultrasound", help="also what ultrasound sees meanwhile")] = False,
    surface: Annotated[bool, Option("--surface", help="also how the skin moves around it")] = False,
    shear_waves: Annotated[bool, Option("--shear-waves", help="also the speed of shear waves")] = False,
    as_json: AsJson = False,
) -> None:
    """Make a synthetic patient with known truth: MRI as DICOM, traces, study.toml, truth.json."""
    tissues: dict[str, Any] = {"fat": fat, "tendon": tendon}
    measured = {"ultrasound": ultrasound, "surface": surface, "shear_waves": shear_waves}
    options = {"detail": detail, "seed": seed, "limb": limb, "socket": socket, "sensors": sensors}
    truth = console.call_with_progress(limbfit.make_phantom_study, folder, **options, **tissues, **measured)
    if as_json:
        console.print_json({"study": str(folder / "study.toml"), **truth})
    else:
        console.print_line(f"synthetic patient in {folder}; next: limbfit run {folder}")


def series(
    folder: Annotated[Path, Argument(help="a folder of DICOM files", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """List the DICOM series of a folder, to choose one by its UID (image.series in study.toml)."""
    console.print_result({"series": limbfit.describe_series(folder)}, show_series, as_json)


def show_series(result: dict[str, Any]) -> None:
    for row in result["series"]:
        number = f"series {row['number']}: " if row["number"] else ""
        size = f"{row['slices']} slices of {row['rows']} x {row['columns']}"
        step = " x ".join(f"{s:.4g}" for s in row["spacing_mm"]) + " mm, whole" if row["whole"] else ""
        state = step or f"no volume: {row['why_not']}"
        console.print_line(f"{number}{row['modality'] or '?'}, {size}, {state}\n  {row['uid']}")


def check(study: StudyPath, as_json: AsJson = False) -> None:
    """Read every input of a study and report what is wrong, before anything runs."""
    console.print_result(call_on_study(study, limbfit.check_study), show_findings, as_json)


def show_findings(findings: dict[str, Any]) -> None:
    for line in findings["facts"]:
        console.print_line(line)
    console.print_warnings(flag["text"] for flag in findings["flags"])
    console.print_warnings(findings["outside_text"])
    if any("run" in row["commands"] for row in findings["refused"]):
        console.print_line("the study cannot be run to its end")
    else:
        console.print_line("the study can be run" + (", but see the warnings" if findings["flags"] else ""))


def run(
    study: StudyPath,
    until: Annotated[str | None, stage_option(help="stop after this stage of limbfit status")] = None,
    start: Annotated[str | None, stage_option("--from", help="redo this stage and all after it")] = None,
    force: Annotated[list[str] | None, stage_option(help="redo it with kept simulations, repeatable")] = None,
    as_json: AsJson = False,
) -> None:
    """Run every stage that is missing or stale; a stopped run continues where it stopped."""
    began = perf_counter()
    summary = call_on_study(study, limbfit.run_study, until=until, start=start, force=force or ())
    summary["seconds"] = round(perf_counter() - began, 1)
    console.print_result(summary, show_summary, as_json)


def status(study: StudyPath, as_json: AsJson = False) -> None:
    """List the stages that are done, begun, stale (and why) or missing."""
    console.print_result({"stages": limbfit.study_status(limbfit.load_study(study))}, show_states, as_json)


def show_states(result: dict[str, Any]) -> None:
    columns: dict[str, Column] = {
        "stage": "stage",
        "state": "state",
        "seconds": ("seconds", ".1f"),
        "finished": "finished",
    }
    console.print_table(result["stages"], columns, dash="")
    for row in result["stages"]:
        if row["why"]:
            console.print_line(f"{row['stage']} is stale: {'; '.join(row['why'])}")


def simulate(
    study: StudyPath,
    site: Annotated[str, Option(help="name of the site", show_default=False)],
    parameters: Parameters = None,
    animation: Annotated[bool, Option("--animation", help="also store the fields of every step")] = False,
    solver: Annotated[Literal["limbfit", "febio"] | None, Option(help="default: the study's solver")] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate one indentation; curve and fields go to results/simulate."""
    options = {"parameters": parameters, "animation": animation, "solver": solver}
    result = call_on_study(study, limbfit.simulate_site, site, **options)
    if as_json:
        console.print_json(result)
    else:
        deep = result["penetration_mm"]
        console.print_line(
            f"site {site}: peak force {result['peak_force_N']:.3f} N at {result['depth_mm']:.2f} mm, "
            + (f"penetration {deep:.3f} mm, " if deep is not None else f"{result['solver']}, ")
            + f"{result['element']}, {result['unknowns']} unknowns\n"
            f"parameters: {result['parameters_from']}\n"
            f"curve: {result['curve']}\nfields: {result['fields']}"
        )
    show_warnings([result])
    console.print_warnings(result["outside_text"])
    if not result["completed"]:
        console.fail(f"site {site}: the simulation is partial: {result['reason']}", 1)


def report(study: StudyPath, as_json: AsJson = False) -> None:
    """Make the report again from stored results; nothing is solved."""
    console.print_result(call_on_study(study, limbfit.report_study), show_summary, as_json)


def parse_parameters(text: str | None, study: Study) -> dict[str, dict[str, float]] | None:
    """``--parameters``: the numbers of each tissue, in the order of the study's tissues."""
    if text is None:
        return None
    values = console.parse_numbers(text, 0.0, sys.float_info.max)
    if len(values) != len(study.parameters):
        what = f"{text!r} is not {len(study.parameters)} numbers"
        remedy = f"give {','.join(study.law.keys)} of {', then of '.join(study.tissues)}, separated by commas"
        raise InputError(what, place="--parameters", remedy=remedy)
    return study.by_tissue(values)


def show_summary(summary: dict[str, Any]) -> None:
    if "parameters" in summary:
        show_parameters(summary)
    elif "until" in summary:
        console.print_line(f"done until {summary['until']}; results in {summary['results']}")
        return
    if "sites" in summary:  # as the report, not before its stage
        show_sites(summary)
        show_warnings(summary["sites"])
        console.print_warnings(summary["outside_text"])
    console.print_warnings(flag["text"] for flag in summary.get("flags", ()))
    if "report" in summary:
        console.print_line(f"report: {summary['report']}")


def show_warnings(sites: Sequence[Mapping[str, Any]]) -> None:
    """What is doubtful about the simulations of the sites."""
    for site in sites:
        for text in site["warnings"]:
            console.print_warning(f"site {site.get('record', site['site'])}: {text}")


def show_parameters(summary: dict[str, Any]) -> None:
    keys = list(next(iter(summary["parameters"].values())))
    rows = [
        values | {"tissue": f"{tissue}, {kind}"}
        for kind, tissues in (("identified", summary["parameters"]), ("truth", summary.get("truth", {})))
        for tissue, values in tissues.items()
    ]
    console.print_table(rows, {"tissue": "tissue", **console.build_parameter_columns(keys)})
    for text in summary.get("relaxation", {}).get("words", ()):
        console.print_line(f"relaxation: {text}")


def show_sites(summary: dict[str, Any]) -> None:
    columns: dict[str, Column] = {
        "site": "record",
        "region": "region",
        "used": console.format_use,
        "peak force (N)": ("peak_force_N", ".2f"),
        "error (%)": ("error_percent", ".2f"),
    }
    console.print_table(summary["sites"], columns)
    for kind, key in (("fitted", "mean_error_fitted_percent"), ("held-out", "mean_error_heldout_percent")):
        if summary.get(key) is not None:
            console.print_line(f"mean error at the {kind} sites: {summary[key]:.2f} %")
    if summary.get("fit_quality"):
        console.print_line(f"fit: {summary['fit_quality']}")


def segment(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the label map; list tissues and volumes."""
    _run_until(study, "segment", show_labels, as_json)


def surfaces(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the surfaces; list closed bodies, volumes and the thinnest tissue over each bone."""
    _run_until(study, "surfaces", show_surfaces, as_json)


def sites(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the sites; list their places on the skin and the markers found there."""
    _run_until(study, "sites", show_placed_sites, as_json)


def mesh(study: StudyPath, as_json: AsJson = False) -> None:
    """Run up to the meshes; list their size, angles and what was trimmed."""
    _run_until(study, "mesh", show_meshes, as_json)


def _run_until(
    study: StudyPath, stage: str, show: Callable[[StudyResults, dict[str, Any]], None], as_json: bool
) -> None:
    """Run the study until a stage, print what it made and where its picture is."""
    result = call_on_study(study, limbfit.show_stage, stage)
    if as_json:
        console.print_json(result)
        return
    show(limbfit.load_results(limbfit.load_study(study)), result)
    if result["picture"]:
        console.print_line(f"picture: {result['picture']}")


def show_labels(results: StudyResults, facts: dict[str, Any]) -> None:
    found = results.segment
    volumes = ", ".join(f"{name} {value:.1f}" for name, value in found.volumes_cm3.items())
    console.print_line(f"{found.method}; volumes in cm3: {volumes}")
    for repair in found.repairs:
        console.print_line(f"repaired: {repair}")
    for warning in found.warnings:
        console.print_line(f"warning: {warning}")
    if found.markers_removed is not None:
        console.print_line(f"markers taken off the skin: {found.markers_removed}")
    if motion := found.motion:
        moved = f"{motion.shift_mm:.1f} mm and {motion.turn_deg:.1f} degrees"
        console.print_line(
            f"between the images the limb moved by {moved} (correlation {motion.correlation:.2f})"
        )
    console.print_line(f"labels: {facts['labels']}")


def show_surfaces(results: StudyResults, result: dict[str, Any]) -> None:
    rows = []
    for name, volume in result["volumes_cm3"].items():
        thinnest = result["thinnest_mm"].get(name) or {}
        rows.append(thinnest | {"body": name, "volume": volume, "triangles": result["triangles"][name]})
    columns: dict[str, Column] = {
        "body": "body",
        "volume (cm3)": ("volume", ".1f"),
        "triangles": "triangles",
        "thinnest tissue (mm)": ("tissue_mm", ".1f"),
        "at (LPS mm)": lambda row: format_point(row["at"]) if "at" in row else "",
    }
    console.print_table(rows, columns, dash="", unwrapped=columns)
    console.print_line(
        f"{result['closed_bodies']} closed bodies; cut through {format_point(result['cut_point'])}"
    )
    if result["amputation"]:
        ends = (f"{name} {end:.1f}" for name, end in result["amputation"]["beyond_plane_mm"].items())
        console.print_line(f"amputated; ends beyond the plane (mm): {', '.join(ends)}")


def show_placed_sites(results: StudyResults, facts: dict[str, Any]) -> None:
    columns: dict[str, Column] = {
        "site": "site",
        "region": "region",
        "used": console.format_use,
        "at (LPS mm)": lambda row: format_point(row.position_mm),
        "off skin": lambda row: f"{row.off_skin_mm:.2f} mm",
        "marker": lambda row: f"{row.marker.height_mm:.1f} mm" if row.marker else "",
        "from 'near'": lambda row: f"{row.marker.distance_to_hint_mm:.1f} mm" if row.marker else "",
    }
    console.print_table(results.sites.sites, columns, unwrapped=columns.keys() - {"region"})


def show_meshes(results: StudyResults, facts: dict[str, Any]) -> None:
    def format_trimmed(row: tuple[str, MeshMeasures]) -> str:
        bones = (f"{bone} {cut.volume_mm3 / 1000:.2f}" for bone, cut in row[1].trimmed_bone.items())
        return ", ".join(bones) or "none"

    columns: dict[str, Column] = {
        "site": lambda row: row[0],
        "nodes": lambda row: str(row[1].nodes),
        "elements": lambda row: str(row[1].cells),
        "least angle": lambda row: f"{row[1].min_dihedral_deg:.1f} deg",
        "layers (mm)": lambda row: f"{row[1].layer_mean_mm:.2f} +- {row[1].layer_std_mm:.2f}",
        "trimmed bone (cm3)": format_trimmed,
    }
    meshes = results.mesh.sites
    console.print_table(meshes.items(), columns, unwrapped=columns.keys() - {"trimmed bone (cm3)"})
    for name, mesh in meshes.items():
        for warning in mesh.warnings:
            console.print_line(f"warning: site {name}: {warning}")


def format_point(position: Sequence[float]) -> str:
    return ", ".join(f"{value:.1f}" for value in position)


def schema(result: Annotated[str, Argument(help="name of the result, such as predict")]) -> None:
    """Print the JSON schema of a stored result: its keys, their types and what they mean."""
    console.print_json(limbfit.build_schema(result))


VERBS = (demo, phantom, series, check, run, status, simulate, report, schema, segment, surfaces, sites, mesh)
