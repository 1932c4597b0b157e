"""A synthetic patient with known truth, as a study folder.

DIR/
  mri/plain/, mri/markers/    DICOM series without and with skin markers
  labels/labels.seg.nrrd      the true label map, where the limb has a tendon
  traces/site-<name>.csv      what the robot recorded
  truth/                      the true surfaces
  truth.json                  parameters, sites, limb, how the forces were made
  socket/socket.stl           a rectified socket, where one is asked for
  sensors/                    what sensors in it record, where they are asked for
  study.toml                  what a user would write
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from scipy.interpolate import interp1d

from ..anatomy.imaging import write_labels
from ..anatomy.surfaces.files import write_surface
from ..anatomy.surfaces.surfaces import Anatomy, Surface, save_anatomy
from ..arrays import Array
from ..errors import InputError
from ..indentation import Parameters
from ..socket import Area, Recipe, Socket, read_socket, rectify_limb
from ..socket.landmarks import Directions, build_default_regions, find_directions, find_knee_centre
from ..socket.rectify import Trim
from . import geometry, robot
from .geometry import SKIN_AND_FAT, SKIN_LAYER, TENDON, Limb
from .mri import DETAIL_GRIDS, LABELS_FILE, TENDON_LABEL, build_true_labels, make_grid, write_series
from .robot import DETAIL_SITES, INDENTER_EDGE_MM, INDENTER_MM, TrueForce, TrueSite, select_sites

Mapping = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
Listener = Callable[[str, float, float], None]
SensorWriter = Callable[[Path, Anatomy, Parameters, int], dict[str, Any]]

PARAMETER_BASE: Parameters = {
    "skin": {"c_kPa": 7.5, "m": 6.0, "gamma": 2.5, "tau_s": 0.5},
    "muscle": {"c_kPa": 4.5, "m": 4.5, "gamma": 3.2, "tau_s": 0.3},
}
FAT_BASE = {"c_kPa": 2.2, "m": 4.0, "gamma": 1.2, "tau_s": 0.9}
TENDON_KPA = 30.0
PARAMETER_SPREAD = 0.15
KAPPA_RATIO = 100.0
PACKED = "patient.zip"
SOCKET_FILE = Path("socket") / "socket.stl"
LINER_MM = 6.0
REDUCTION_PERCENT = 3.0
BELOW_KNEE_MM, BAND_MM = 10.0, 6.0  # of the brim at the back, and of the skin that says how far back it is
BELOW_CUT_MM = 30.0  # of a thigh's brim
# Region, radius and depth (mm) of what is pressed in or relieved.
SOCKET_AREAS = {
    "transtibial": (
        ("patellar tendon", 25.0, 4.0),
        ("medial proximal", 30.0, 3.0),
        ("posterior proximal", 35.0, 4.0),
        ("tibial crest", 25.0, -2.0),
        ("fibular head", 20.0, -3.0),
        ("distal tibia", 25.0, -3.0),
    ),
    "transfemoral": (
        ("anterior proximal", 40.0, 4.0),
        ("posterior proximal", 40.0, 3.0),
        ("lateral middle", 40.0, 3.0),
        ("lateral distal", 30.0, -3.0),
    ),
}


@dataclass(frozen=True)
class _Patient:
    """The patient of a seed: ``marked`` sites carry a marker, ``indented`` ones have a record, too."""

    seed: int
    detail: str
    limb: Limb
    marked: tuple[TrueSite, ...]
    indented: tuple[TrueSite, ...]
    parameters: Parameters
    measurements: robot.SecondaryMeasurements
    has_socket: bool


def draw_true_parameters(seed: int, fat: bool = False, tendon: bool = False) -> Parameters:
    """Draw the tissues of a seed, with or without fat and tendon: within 15 % of the base, three digits.

    The tendon is a stiffer muscle.
    """
    random = np.random.default_rng([seed, 7])
    found = {tissue: _draw_values(values, random) for tissue, values in PARAMETER_BASE.items()}
    between: Parameters = {}
    if fat:
        between["fat"] = _draw_values(FAT_BASE, np.random.default_rng([seed, 9]))
    if tendon:
        stiffness = _draw_values({"c_kPa": TENDON_KPA}, np.random.default_rng([seed, 11]))
        between[TENDON] = found["muscle"] | stiffness
    return {"skin": found["skin"], **between, "muscle": found["muscle"]}


def _draw_values(values: dict[str, float], random: np.random.Generator) -> dict[str, float]:
    return {
        name: float(f"{value * (1 + PARAMETER_SPREAD * random.uniform(-1, 1)):.3g}")
        for name, value in values.items()
    }


def make_phantom(
    folder: str | Path,
    detail: str = "coarse",
    seed: int = 0,
    sites: Sequence[str] | None = None,
    fat: bool = False,
    socket: bool = False,
    ultrasound: bool = False,
    surface: bool = False,
    shear_waves: bool = False,
    tendon: bool = False,
    limb: str = "transtibial",
    sensors: SensorWriter | None = None,
    mapping: Mapping = map,
    progress: Listener | None = None,
) -> dict[str, Any]:
    """Make a synthetic patient in ``folder``; nothing is left there unless all of it was made.

    Returns what ``truth.json`` holds. Raises `InputError` for a folder that is not empty, an unknown detail,
    limb or site, or a tendon of a thigh.

    Parameters
    ----------
    folder : must not exist, or be empty.
    detail : ``coarse`` (2.4 mm voxels, 6 sites) or ``paper`` (the paper's voxels, 18 sites).
    seed : which patient; the same seed gives the same files.
    sites : names of the sites to indent, of ``01`` to ``18``; the image shows all 18 markers anyway.
    fat : three tissues, skin of 2 mm over fat of 4 mm over muscle, instead of two.
    socket : also a rectified socket for the limb with a liner, as a file that the study names.
    ultrasound : beside each record what ultrasound through the indenter saw, to 0.1 mm at 20 Hz.
    surface : beside each record how the skin around the indenter moved, to 0.05 mm at 5 Hz.
    shear_waves : beside each record the speeds of shear waves under the indenter, to 0.1 m/s at 1 Hz.
    tendon : also a patellar tendon, a stiffer region of the muscle, in a label map that the study names.
    limb : which kind, ``transtibial`` or ``transfemoral``.
    sensors : given the folder, true surfaces and parameters, and the seed, writes what sensors in the socket
        record, names it in the study and returns what is true of it.
    mapping : like ``map``; given one that works in several processes, sites are meshed and simulated side by
        side.
    progress : called with what is being done, how much of it is done, and of how much.
    """
    folder = Path(folder)
    tell = progress or (lambda text, done, total: None)
    if detail not in DETAIL_GRIDS:
        raise InputError(f"unknown detail {detail!r}", remedy=f"use one of {', '.join(DETAIL_GRIDS)}")
    if sensors is not None and not socket:
        raise InputError("there is no socket that sensors could be in", remedy="ask for a socket, too")
    made_limb = geometry.make_limb(seed, SKIN_AND_FAT if fat else SKIN_LAYER, tendon, limb)
    marked = robot.build_true_sites(made_limb, seed)
    patient = _Patient(
        seed=seed,
        detail=detail,
        limb=made_limb,
        marked=marked,
        indented=select_sites(marked, DETAIL_SITES[detail] if sites is None else sites),
        parameters=draw_true_parameters(seed, fat, tendon),
        measurements=robot.SecondaryMeasurements(ultrasound, surface, shear_waves),
        has_socket=socket,
    )
    with _open_hidden_folder(folder) as work:
        truth = _truth_to_dict(patient)
        anatomy = geometry.build_true_anatomy(made_limb)
        if socket:
            truth["socket"] = write_socket(work, made_limb, anatomy)
        _write_images(work, patient, tell)
        truth["sites"] = _write_traces(work, patient, anatomy, mapping, tell)
        (work / "study.toml").write_text(_format_study(patient), encoding="utf-8")
        if sensors is not None:
            tell("sensors", 0, 1)
            truth["sensors"] = sensors(work, anatomy, patient.parameters, seed)
        (work / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    return truth


def unpack_patient(folder: str | Path) -> dict[str, Any]:
    """Unpack what :func:`make_phantom` makes by default, which comes with limbfit, into ``folder``.

    Returns what ``truth.json`` holds. Raises `InputError` for a folder that is not empty.
    """
    with (
        _open_hidden_folder(Path(folder)) as work,
        resources.files(__package__).joinpath(PACKED).open("rb") as packed,
        ZipFile(packed) as archive,
    ):
        archive.extractall(work)
        truth: dict[str, Any] = json.loads((work / "truth.json").read_text(encoding="utf-8"))
    return truth


@contextmanager
def _open_hidden_folder(folder: Path) -> Iterator[Path]:
    """Open a hidden folder beside ``folder`` that takes its name when the block ends well."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise InputError("there is something already", file=folder, remedy="give a new or an empty folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield work
        if folder.is_dir():
            folder.rmdir()
        work.chmod(0o755)
        work.rename(folder)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def _write_images(work: Path, patient: _Patient, tell: Listener) -> None:
    limb, seed = patient.limb, patient.seed
    grid = make_grid(limb, patient.detail, seed)
    if limb.has_tendon:
        (work / LABELS_FILE.parent).mkdir()
        write_labels(work / LABELS_FILE, build_true_labels(limb, grid))
    markers = robot.build_markers(patient.marked)
    series = (("plain", (), "UTE residuum"), ("markers", markers, "UTE residuum, markers"))
    for number, (name, shown, description) in enumerate(series, start=1):
        write_series(
            work / "mri" / name,
            limb,
            grid,
            shown,
            seed=seed,
            number=number,
            description=description,
            progress=lambda share, before=number - 1: tell("image", before + share, 2),  # type: ignore[misc]
        )


def _write_traces(
    work: Path, patient: _Patient, anatomy: Anatomy, mapping: Mapping, tell: Listener
) -> list[dict[str, Any]]:
    """Simulate and record every site; return what is true of each, for ``truth.json``."""
    truth, traces = work / "truth", work / "traces"
    truth.mkdir()
    traces.mkdir()
    save_anatomy(truth, anatomy)
    made, indented = robot.choose_discretisation(patient.detail, patient.limb.kind), patient.indented
    settings = replace(made.mesh, layers=patient.limb.layers)
    mesh = partial(robot.mesh_true_site, folder=truth, settings=settings, within_mm=made.within_mm)
    jobs: list[robot.ForceJob] = []
    tell("meshes", 0, len(indented))
    for site, site_mesh in zip(indented, mapping(mesh, indented), strict=True):
        steps = made.steps(site.thickness)
        jobs.append(robot.ForceJob(site, site_mesh, steps, patient.parameters, patient.measurements))
        tell("meshes", len(jobs), len(indented))
    tell("forces", 0, len(jobs))
    facts = []
    forces = mapping(robot.simulate_true_force, jobs)
    for i, (site, found) in enumerate(zip(indented, forces, strict=True)):
        facts.append(_record_site(traces, site, found, patient.seed))
        tell("forces", i + 1, len(jobs))
    return facts


def _record_site(traces: Path, site: TrueSite, simulated: TrueForce, seed: int) -> dict[str, Any]:
    def follow(values: Array) -> Callable[[Array], Array]:
        return lambda t: np.interp(t, simulated.times, values)

    def draw(purpose: int) -> np.random.Generator:
        return np.random.default_rng([seed, purpose, int(site.name)])

    made = robot.record(site.ramp, follow(simulated.force), draw(8))
    made.write(traces / f"site-{site.name}.csv")
    if simulated.layers:
        layers = {tissue: (rest, follow(lost)) for tissue, (rest, lost) in simulated.layers.items()}
        robot.write_ultrasound(traces / f"site-{site.name}-layers.csv", made, layers, draw(11))
    if len(simulated.skin_points):
        moves = interp1d(simulated.times, simulated.skin_moves)
        robot.write_surface(
            traces / f"site-{site.name}-surface.csv",
            made,
            simulated.skin_points,
            lambda t: moves(np.minimum(t, simulated.times[-1])),
            draw(12),
        )
    if simulated.speeds:
        speeds = {tissue: follow(speed) for tissue, speed in simulated.speeds.items()}
        robot.write_waves(traces / f"site-{site.name}-waves.csv", made, speeds, draw(13))
    return {
        **_site_to_dict(site),
        "depth_mm": site.depth,
        "speed_mm_s": site.speed,
        "fitted": site.fitted,
        "peak_force_N": float(simulated.force.max()),
        "clearance_mm": made.clearance,
        "touch_down_s": made.touch_s,
        "force_noise_N": made.force_noise,
        "simulation": simulated.facts,
    }


def _site_to_dict(site: TrueSite) -> dict[str, Any]:
    return {
        "name": site.name,
        "region": site.region,
        "position_mm": site.position.tolist(),
        "axis": site.axis.tolist(),
        "tissue_mm": site.thickness,
    }


def _truth_to_dict(patient: _Patient) -> dict[str, Any]:
    limb = patient.limb
    made = robot.choose_discretisation(patient.detail, limb.kind)
    return {
        "seed": patient.seed,
        "detail": patient.detail,
        "parameters": patient.parameters,
        "kappa_ratio": KAPPA_RATIO,
        "indenter_mm": INDENTER_MM,
        "limb": {
            "kind": limb.kind,
            "shape_mm_rad": asdict(limb.shape),
            "rotation": limb.rotation.tolist(),
            "origin_mm": limb.origin.tolist(),
        },
        "markers": [_site_to_dict(site) for site in patient.marked],
        "mesh": {
            **asdict(made.mesh),
            "layers": [asdict(layer) for layer in limb.layers],
            "within_mm": made.within_mm,
        },
    }


def render_template(name: str, **facts: Any) -> str:
    """Render a file of the phantom by its template."""
    loader = PackageLoader("limbfit.phantom", "templates")
    environment = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    return environment.get_template(name).render(facts)


def _format_study(patient: _Patient) -> str:
    """The content of ``study.toml`` for the indented sites, as a user would write it."""
    return render_template(
        "study.toml.j2",
        sites=patient.indented,
        detail=patient.detail,
        seed=patient.seed,
        limb=patient.limb,
        measurements=patient.measurements,
        socket=patient.has_socket,
        labels_file=LABELS_FILE.as_posix(),
        tendon=TENDON,
        tendon_label=TENDON_LABEL,
        indenter_mm=INDENTER_MM,
        indenter_edge_mm=INDENTER_EDGE_MM,
        socket_file=SOCKET_FILE.as_posix(),
        liner_mm=f"{LINER_MM:g}",
    )


def make_socket(anatomy: Anatomy, outer: Surface, kind: str = "transtibial") -> tuple[Socket, list[Area]]:
    """Make the socket around a limb in a liner, and its areas: a shank's bears on the patellar tendon.

    The anatomy of a shank has a tibia and a patella; ``outer`` is the closed surface of the liner, LPS mm,
    flat at the same proximal cut; ``kind`` is one of ``LIMBS``. Raises `SurfaceError` where the limb has no
    place for it.
    """
    directions = find_directions(anatomy, "right")
    regions = build_default_regions(anatomy, directions)
    areas = [Area(name, regions[name].position, radius, depth) for name, radius, depth in SOCKET_AREAS[kind]]
    knee, frame = find_knee_centre(anatomy), anatomy.frame
    if knee is None:
        trim = Trim([(anatomy.cut_point - BELOW_CUT_MM * anatomy.cut_normal, anatomy.cut_normal)])
    else:
        trim = _trim_around_tendon(anatomy, directions, knee)
    return rectify_limb(outer, frame, Recipe(trim, REDUCTION_PERCENT, areas)), areas


def _trim_around_tendon(anatomy: Anatomy, directions: Directions, knee: Array) -> Trim:
    """Trim as a patellar-tendon-bearing socket is: from the patella's middle to below the knee at the back.

    A brim below the knee all around would cut through the bar on the tendon, half of which lies above it.
    """
    front, skin = anatomy.bones["patella"].points.mean(axis=0), anatomy.skin.points
    near = np.abs(anatomy.height(skin) - anatomy.height(knee) + BELOW_KNEE_MM) < BAND_MM
    behind = ((skin[near] - knee) @ directions.anterior).min()
    back = knee + behind * directions.anterior - BELOW_KNEE_MM * directions.proximal
    slope = (front - back) @ directions.proximal / ((front - back) @ directions.anterior)
    return Trim([(front, directions.proximal - slope * directions.anterior)])


def write_socket(folder: Path, limb: Limb, anatomy: Anatomy) -> dict[str, Any]:
    """Write the socket of a limb into a study's folder and read it back; returns what is true of it."""
    outer = geometry.build_outer_surface(limb, LINER_MM)
    socket, areas = make_socket(anatomy, outer, limb.kind)
    (folder / SOCKET_FILE).parent.mkdir()
    write_surface(folder / SOCKET_FILE, socket.surface)
    read_socket(folder / SOCKET_FILE, outer=outer, frame=anatomy.frame, bones=anatomy.bones)
    return {
        "file": SOCKET_FILE.as_posix(),
        "liner_mm": LINER_MM,
        "reduction_percent": REDUCTION_PERCENT,
        "volume_mm3": socket.volume_mm3,
        "areas": [
            {
                "name": a.name,
                "position_mm": a.position.tolist(),
                "radius_mm": a.radius_mm,
                "depth_mm": a.depth_mm,
            }
            for a in areas
        ],
    }
