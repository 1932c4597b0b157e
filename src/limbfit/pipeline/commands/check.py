"""Read every input of a study and say what is wrong with it, before anything runs."""

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from ...anatomy.surfaces.surfaces import Anatomy
from ...errors import InputError
from ...identify.checks.domain import Extent, RecordedRange, describe_outside
from ...indentation import read_indenter
from ...results.identification import OutsideRecords
from ...results.limb import TraceFacts
from ...study import Indentation, Study
from ...traces import SurfaceMotion
from ..engine.context import Listener, Progress, ignore_progress
from ..engine.store import Store
from ..identification.calibrate import check_calibrate
from ..limb.segment import check_labels, read_marked_image, read_study_image, read_study_labels
from ..limb.sites import place_site
from ..limb.surfaces import read_given_anatomy
from ..records.record_checks import choose_surface_points, record_flags
from ..records.traces import SecondaryMeasurement, describe_record, read_observed, read_record
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.loading import LimbAxis, LoadHistory, describe_indentation, name_load, time_socket_loads
from ..socket.measured import describe_measured
from ..socket.shape import build_loadable_socket, build_regions, check_load, check_regions
from .acquire import build_device_settings
from .experiments import EXPERIMENTS, check_experiment
from .other_solvers import FORMATS, check_export
from .run import is_done

_COMMANDS = {"protocol": "design --protocol", "socket_design": "socket design"}


def check_study(study: Study, *, listener: Listener = ignore_progress) -> dict[str, Any]:
    """Facts about a study's inputs; raises at the first that cannot be used.

    Returns ``study``, ``facts`` (sentences), ``sites`` (peak force, depth, touch-down of each record),
    ``flags`` (what looks wrong about records and places, with the evidence), ``refused`` (``commands`` that
    this study cannot have with their defaults, and ``why``), ``outside_records`` (by name of a site or load
    what it does that no fitted record does) and ``outside_text``, the same in words. Raises `InputError` for
    an image, label map, surface, site or record that cannot be used.
    """
    listener(Progress("check", 0, 2, "geometry"))
    limb, bones, geometry_facts = _read_geometry(study)
    facts = [*study.notes, *geometry_facts, *_describe_indenters(study)]
    listener(Progress("check", 1, 2, "records"))
    records: dict[str, TraceFacts] = {}
    secondary: dict[str, SecondaryMeasurement] = {}
    steps_s: dict[str, float] = {}
    for one in study.recorded:
        trace, smooth, record = read_record(study, one)
        records[one.name] = record
        secondary[one.name] = read_observed(study, one, trace, record.touch_down_s, smooth)
        steps_s[one.name] = float(np.median(np.diff(trace.time_s)))
        facts.append(f"site {one.name}: {describe_record(record)}")
    facts += _describe_fit(study)
    motions = {name: measured.motion for name, measured in secondary.items()}
    facts += _describe_surface_motion(study, motions, limb)
    facts += _describe_waves(secondary)
    if records and limb is None:
        facts.append(
            "the sites are not placed yet: stiffness is compared without the thickness of the tissue "
            "(limbfit run --until sites, then check again)"
        )
    anatomy = None if limb is None else limb.anatomy
    if "socket" in study.model_fields_set:
        facts += _describe_socket(study, anatomy, bones)
    facts += _describe_clamps(study, limb)
    refused = list_refused_commands(study, limb)
    facts += [f"cannot run: limbfit {', '.join(row['commands'])}: {row['why']}" for row in refused]
    flags = record_flags(study, records, steps_s, {} if limb is None else limb.places, anatomy)
    outside = _describe_outside(study, records, limb)
    listener(Progress("check", 2, 2))
    return {
        "study": study.study.name,
        "facts": facts,
        "sites": {name: record.to_plain() for name, record in records.items()},
        "flags": [flag.to_dict() for flag in flags],
        "refused": refused,
        "outside_records": {name: [row.to_plain() for row in rows] for name, rows in outside.items()},
        "outside_text": describe_outside(outside),
    }


def _read_geometry(study: Study) -> tuple[LimbGeometry | None, tuple[str, ...] | None, list[str]]:
    """The limb where its sites are known, the bones of a given label map, and facts."""
    if study.surfaces is not None:
        anatomy, notes = read_given_anatomy(study)
        facts = [*notes, *_describe_surfaces(anatomy)]
        places = {site.name: place_site(site, study, anatomy, None) for site in study.sites}
        return LimbGeometry(anatomy, places), None, facts
    facts, bones = _describe_image(study)
    store = Store(study.results)
    if store.stamp("sites") is None:  # then there is no need to read every image for its digest
        return None, bones, facts
    return LimbGeometry.from_store(store) if is_done(study, "sites") else None, bones, facts


def _describe_indenters(study: Study) -> Iterator[str]:
    for name, table in study.used_indenters.items():
        if table.file is not None:
            here = table.model_copy(update={"file": study.path(table.file)})
            width = read_indenter(here, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), None).width
            yield f"indenter{'' if name is None else ' ' + name}: {table.file}, {width:.1f} mm wide"


def _describe_fit(study: Study) -> Iterator[str]:
    """How many sites and records are fitted, and with which priors."""
    if not study.sites:
        yield "the study has no site yet: add [[sites]], or place sites in limbfit studio"
        return
    number = len(study.records_at(*study.fitted))
    more = f", with {number} records" if number > len(study.fitted) else ""
    yield f"{len(study.fitted)} of {len(study.sites)} sites are fitted{more}"
    if study.priors:
        priors = (f"{name} {p.median:g}, factor {p.factor:g}" for name, p in study.priors.items())
        yield f"lognormal priors (median, one standard deviation): {'; '.join(priors)}"


def _describe_waves(secondary: Mapping[str, SecondaryMeasurement]) -> Iterator[str]:
    for name, measured in secondary.items():
        for place, means in measured.waves:
            speeds = f"{means.speed_m_s.min():.2f} to {means.speed_m_s.max():.2f} m/s"
            readings = int(means.samples.sum())
            yield f"site {name}: shear waves at {place.name}, {speeds} in {readings} readings"


def _describe_clamps(study: Study, limb: LimbGeometry | None) -> Iterator[str]:
    """How the pins press, and where the limb is known how many meet it at each site."""
    pins = study.clamps
    if pins is None:
        return
    said = f"clamps: {len(pins.angles)} pins of {pins.force_N:g} N, {pins.lead_s:g} s before touch-down"
    if limb is None:
        yield f"{said}; they are placed after limbfit run --until sites"
    else:
        met = [f"{count} at site {name}" for name, count in limb.clamping_pins(study).items()]
        yield f"{said}; {', '.join(met)} meet the skin"


def list_refused_commands(study: Study, limb: LimbGeometry | None) -> list[dict[str, Any]]:
    """``commands`` that would be refused, and ``why``; ``limb``: None where it is not known yet."""
    found: dict[str, list[str]] = {}
    checks: list[tuple[str, Callable[[], Any]]] = [("run", partial(check_calibrate, study, limb))]
    for experiment in EXPERIMENTS:
        name = experiment.name
        command = _COMMANDS.get(name, name.replace("sensitivity-", "sensitivity --only "))
        checks.append((command, partial(check_experiment, experiment, study, limb, experiment.options)))
    checks += [(f"export --to {to}", partial(check_export, study, to)) for to in FORMATS]
    checks += [
        (f"acquire --site {one.name}", partial(build_device_settings, study, one, None, False))
        for one in study.indentations
    ]
    for command, check in checks:
        try:
            check()
        except InputError as error:
            why = str(InputError(error.what, place=error.place, remedy=error.remedy))
            found.setdefault(why, []).append(command)
    return [{"commands": commands, "why": why} for why, commands in found.items()]


def _describe_outside(
    study: Study, records: Mapping[str, TraceFacts], limb: LimbGeometry | None
) -> dict[str, list[OutsideRecords]]:
    """What other records, planned indentations and the socket do that no fitted record does, by name.

    Only what is known before a simulation: times, pressure, depth, and places where the limb is known.
    """
    axis = None if limb is None else LimbAxis(limb.anatomy)

    def describe(one: Indentation, tested: RecordedRange | None = None) -> list[Extent]:
        facts = records.get(one.name)
        if facts is not None:
            history = LoadHistory.from_knots(facts.knots_s, facts.knots_N or facts.knots_mm)
            depth_mm, force_N = facts.depth_mm, facts.peak_force_N
        else:
            history = LoadHistory.from_knots(*one.site.planned_knots)
            depth_mm, force_N = max(one.site.planned_knots[1]), None
        place = None if limb is None else limb.place(one.site)
        indenter = study.indenter_of(one)
        return describe_indentation(history, depth_mm, indenter, place, axis, force_N=force_N, tested=tested)

    fitted = study.records_at(*study.fitted)
    if not fitted:
        return {}
    places = [limb.place(site)[0] for site in study.fitted] if limb is not None else []
    angles = axis.measure_angle(np.array(places)).tolist() if axis is not None else ()
    tested = RecordedRange.from_records(map(describe, fitted), angles)
    held = [record for record in study.recorded if not record.site.fitted]
    planned = [site for site in study.sites if site.depth_mm is not None and not study.records_at(site)]
    others: list[Indentation] = [*held, *planned]
    found = {f"site {one.name}": tested.find_outside(describe(one, tested)) for one in others}
    if "socket" in study.model_fields_set:
        for name, history in time_socket_loads(study.socket).items():
            found[name_load(name)] = tested.find_outside([history.time])
    return found


def _describe_surface_motion(
    study: Study, motions: Mapping[str, SurfaceMotion | None], limb: LimbGeometry | None
) -> Iterator[str]:
    """How the skin around the indenter moves, and which of its points are compared where sites are known."""
    chosen = {} if limb is None else choose_surface_points(limb, study, motions)
    for record in study.recorded:
        motion = motions[record.name]
        if motion is None:
            continue
        said = (
            f"site {record.name}: surface of {len(motion.points)} points at {len(motion.time_s)} times in "
            f"contact, up to {motion.max_motion_mm:.2f} mm"
        )
        if record.name in chosen:
            said += f"; {chosen[record.name].words}"
        yield said


def _describe_image(study: Study) -> tuple[list[str], tuple[str, ...] | None]:
    """Facts, and the names of the bones where a label map is given."""
    volume, facts = read_study_image(study), []
    for name, image in (("image", volume), ("image with markers", read_marked_image(study))):
        if image is not None:
            size = " x ".join(str(n) for n in image.size)
            spacing = " x ".join(f"{s:.3g}" for s in image.spacing)
            facts.append(f"{name}: {size} voxels of {spacing} mm")
            facts += [f"warning: {name}: {note}" for note in image.notes]
    given, bones = read_study_labels(study, volume), None
    if given is not None:
        labels, notes = given
        check_labels(study, labels)
        bones = labels.bone_names
        facts.append("corrected labels: " + ", ".join(labels.names.values()))
        facts += [f"label map: {note}" for note in notes]
    return facts, bones


def _describe_socket(study: Study, anatomy: Anatomy | None, bones: Collection[str] | None) -> list[str]:
    """What ``[socket]`` says; where the limb is known, the socket around its bare skin.

    Loads are checked where at least the names of the ``bones`` are known.
    """
    table = study.socket
    liner = f"a liner of {table.liner.thickness_mm:g} mm" if table.liner.thickness_mm else "no liner"
    travel = f" over {table.travel_mm:g} mm" if table.travel_mm else ""
    meshed = f"; limb meshed at {table.edge_mm:g} mm" if table.edge_mm else ""
    facts = [
        f"socket: {liner}, friction {table.friction}, donning by {table.donning}{travel}; "
        f"{', '.join(load.name for load in table.loads) or 'no load'}{meshed}"
    ]
    if anatomy is None:
        if bones is not None:
            for load in table.loads:
                check_load(study, load, bones)
        describe_measured(study, None)
        return [*facts, "the socket's shape is checked after limbfit run --until sites"]
    socket = build_loadable_socket(study, anatomy, anatomy.skin)
    named = [one.region for one in table.design.regions]
    check_regions(study, named, "socket.design.regions", build_regions(study, anatomy))
    depth = socket.offset(anatomy.skin)
    return [
        *facts,
        *(f"socket: {note}" for note in socket.notes),
        f"socket: {socket.volume_mm3 / 1000:.0f} cm3, from {-depth.min():.1f} mm outside the skin to "
        f"{depth.max():.1f} mm inside it",
        *describe_measured(study, anatomy),
    ]


def _describe_surfaces(anatomy: Anatomy) -> list[str]:
    facts = [
        f"{name}: {surface.volume / 1000:.1f} cm3, {len(surface.faces)} triangles"
        for name, surface in {"skin": anatomy.skin, **anatomy.bones, **anatomy.regions}.items()
    ]
    largest = np.ptp(anatomy.skin.points, axis=0)
    return [*facts, "extent of the skin: " + " x ".join(f"{x:.0f}" for x in largest) + " mm"]
