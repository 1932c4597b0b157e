"""Reading a study; errors name the file, the key and the remedy. Keys without effect are refused."""

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from ..anatomy.sites.markups import read_markups
from ..errors import StudyError, add_location
from ..extensions import load_extensions
from ..laws import ACTIVE, FIBRED, POWER, has_fibres
from ..shapes import SHAPES
from .meshing import ACCURACIES, EdgesTable
from .records import RecordTable, Site
from .study import Study
from .tables import TomlTable

Table = TypeVar("Table", bound=TomlTable)


def load_study(path: str | Path, *, recorded: bool = True) -> Study:
    """Read and check a study; ``path`` is the file or its folder.

    ``recorded``: the records of the sites must exist; not where they are to be made. Raises `StudyError` with
    the file, the key and the remedy.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "study.toml"
    if not file.is_file():
        raise StudyError("no such study", file=file, remedy="give a study.toml or the folder that holds one")
    content = read_toml(file)
    notes = _place_by_markups(content, file)
    table = content.get("study")
    named = table.get("extensions", []) if isinstance(table, dict) else []
    if isinstance(named, list) and all(isinstance(name, str) for name in named):  # others are refused below
        load_extensions(file.parent / name for name in named)
    with add_location(file=file):
        study = check_content(Study, content, "docs/study.md", file=str(file), notes=notes)
        for place, path in study.inputs.items():
            at = study.path(path)
            if (recorded or not place.startswith(("sites.", "records."))) and not at.exists():
                raise StudyError(f"{path} does not exist", place=place)
            if study.results.resolve().is_relative_to(at.resolve()):
                what = f"{path} holds the results of the study, and so changes with every run"
                raise StudyError(what, place=place, remedy="give it a folder of its own")
        for key, why, remedy in _find_unused_keys(study, content):
            raise StudyError(f"without effect: {why}", place=key, remedy=remedy)
    unused = [name for name in study.indenters if name not in study.used_indenters]
    what = "no record names it; only limbfit design --protocol does"
    notes = (*notes, *(f"indenters.{name}: {what}" for name in unused))
    return study.model_copy(update={"notes": notes})


def read_toml(file: Path) -> dict[str, Any]:
    """Read a TOML file. Raises `StudyError` for one that is not valid."""
    try:  # "-sig": editors on Windows may begin a file with a mark
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StudyError(f"not valid TOML: {error}", file=file) from None


def check_content(model: type[Table], content: dict[str, Any], page: str, **own: Any) -> Table:
    """The checked table of a file's content and of keys of its ``own``, which no file may have.

    Raises `StudyError` with the key, and the ``page`` of the documentation that lists the keys.
    """
    for key in own:
        if key in content:
            raise StudyError("unknown key", place=key, remedy=f"see {page} for the keys")
    try:  # as JSON, of which neither "12" nor true is a number
        return model.model_validate_json(json.dumps(content | own, default=str), strict=True)
    except ValidationError as error:
        raise _build_study_error(error, content, page) from None


def _place_by_markups(content: dict[str, Any], file: Path) -> tuple[str, ...]:
    """Give sites without a place that of the control point of their name; say which points are left over.

    What is malformed is left for the check of the types to refuse.
    """
    table, sites = content.get("markups"), content.get("sites")
    if not isinstance(table, dict) or not isinstance(table.get("file"), str) or not isinstance(sites, list):
        return ()
    source = file.parent / table["file"]
    if not source.is_file():
        raise StudyError(f"{table['file']} does not exist", file=file, place="markups.file")
    points = read_markups(source)
    for site in (site for site in sites if isinstance(site, dict)):
        name = str(site.get("name"))
        is_placed = "position" in site or "near" in site
        with add_location(file=file, place=f"sites.{name}"):
            if is_placed and name in points:
                what = "the site has a place here and a control point in the markups file"
                raise StudyError(what, remedy="leave one of them out")
            if not is_placed and name not in points:
                known = ", ".join(map(repr, points)) or "none"
                what = f"no control point of {table['file']} is labelled {name!r}"
                raise StudyError(what, remedy=f"it has {known}")
        if not is_placed:
            site[table.get("gives", "position")] = points[name].tolist()
    unused = sorted(set(points) - {str(site.get("name")) for site in sites if isinstance(site, dict)})
    return (f"control points without a site: {', '.join(unused)}",) if unused else ()


def _build_study_error(error: ValidationError, content: dict[str, Any], page: str) -> StudyError:
    found = error.errors()
    first = next((one for one in found if one["type"] == "value_error"), found[0])  # it says most
    more = len(found) - 1
    place, kind, given = _name_place(first["loc"], content), first["type"], first["input"]
    what, remedy = first["msg"].removeprefix("Value error, "), None
    if kind == "extra_forbidden":
        what, remedy = "unknown key", f"see {page} for the keys"
    elif kind == "string_pattern_mismatch":
        what, remedy = f"{given!r} is no name", "begin with a letter; then A to Z, digits or _, up to 30"
    elif kind == "tuple_type" and isinstance(given, dict):
        what, remedy = "one table, and not a list of tables", f"write it in two brackets: [[{place}]]"
    elif kind in ("model_type", "dict_type"):
        what = "Input should be a table"
    return StudyError(what + (f" (and {more} more)" if more else ""), place=place, remedy=remedy)


def _name_place(keys: tuple[int | str, ...], content: Any) -> str | None:
    """Name the place that ``keys`` lead to, as ``sites.05.weight``; a table without a name by its number."""
    parts = []
    for depth, key in enumerate(keys):
        try:
            content = content[key]
        except (LookupError, TypeError):  # a key that is missing, or stands for a type that a value may have
            content = None
        part = str(key + 1 if isinstance(key, int) else key)
        if isinstance(key, int) and isinstance(content, dict) and keys[depth + 1 :] != ("name",):
            part = "-".join(str(content[name]) for name in ("site", "name") if name in content) or part
        parts.append(part)
    return ".".join(part for part in parts if "[" not in part) or None


@dataclass(frozen=True)
class UnusedKeys:
    """Keys without effect if ``when`` is true of the study (and the site): why, and what to give instead."""

    when: Callable[..., bool]
    why: str
    give: str = ""

    @property
    def remedy(self) -> str:
        """What to do."""
        return f"give {self.give}, or leave it out" if self.give else "leave it out"


Rules = dict[tuple[str, ...], UnusedKeys]


def _list_edge_rules(place: str, find: Callable[[Study], EdgesTable | None]) -> Rules:
    def find_excess(study: Study) -> float:
        table = find(study)
        return 1.0 if table is None else table.edge_far_mm - table.edge_near_mm

    one = "edge_far_mm is no longer than edge_near_mm, so edges have one length"
    shorter = "edge_far_mm is shorter, and no edge longer"
    return {
        (f"{place}.near_radius_mm", f"{place}.growth"): UnusedKeys(lambda s: find_excess(s) <= 0.0, one),
        (f"{place}.edge_near_mm",): UnusedKeys(lambda s: find_excess(s) < 0.0, shorter),
    }


_AUTOMATIC_KEYS = ("contrast", "seeds", "bias_correction", "min_bone_volume_mm3")
_SHAPE_KEYS = (
    *("reduction_percent", "areas", "trim_mm", "trim_planes", "trimline", "flare_mm", "distal"),
    *("distal_clearance_mm", "face_edge_mm"),
)
_SOURCE_KEYS = ("layer_mm", "position_mm", "axis_degrees", "edge_radius_mm")

UNUSED_KEYS: Rules = {
    ("segmentation",): UnusedKeys(lambda s: s.surfaces is not None, "[surfaces] are not segmented"),
    tuple(f"segmentation.{key}" for key in _AUTOMATIC_KEYS): UnusedKeys(
        lambda s: s.segmentation.is_given, "the study's own labels win over the automatic segmentation"
    ),
    ("segmentation.min_bone_volume_mm3",): UnusedKeys(
        lambda s: bool(s.segmentation.seeds), "with seeds, the bones are those that have one, however small"
    ),
    ("segmentation.bias_correction",): UnusedKeys(
        lambda s: s.segmentation.contrast == "CT", "CT has no bias field"
    ),
    ("image.series",): UnusedKeys(
        lambda s: s.image is not None and s.path(s.image.path).is_file(),
        "image.path is a file, not a folder of series",
    ),
    ("image.markers_series",): UnusedKeys(
        lambda s: s.image is not None and s.image.marked is not None and s.path(s.image.marked).is_file(),
        "image.markers is a file, not a folder of series",
    ),
    ("image.markers",): UnusedKeys(
        lambda s: (
            s.image is not None
            and s.image.marked is not None
            and bool(s.sites)
            and all(site.near is None for site in s.sites)
        ),
        "no site is matched to a marker",
        give="near instead of position",
    ),
    ("geometry.surface_edge_mm",): UnusedKeys(
        lambda s: s.surfaces is not None and s.geometry.amputation is None,
        "given surfaces are used as they are unless they are amputated",
    ),
    ("geometry.amputation_pad_mm",): UnusedKeys(
        lambda s: s.geometry.amputation is None, "there is no amputation", give="geometry.amputation"
    ),
    ("geometry.bone_policy", "geometry.bone_clearance_mm"): UnusedKeys(
        lambda s: s.surfaces is not None and not s.surfaces.bones, "[surfaces] has no bones"
    ),
    **_list_edge_rules("mesh", lambda s: s.mesh),
    **_list_edge_rules("mesh.coarse", lambda s: s.mesh.coarse),
    ("indenter",): UnusedKeys(
        lambda s: bool(s.sites) and all(one.indenter is not None for one in s.indentations),
        "every record and every planned indentation names another one",
    ),
    ("traces",): UnusedKeys(
        lambda s: bool(s.sites) and not s.recorded, "no site has a record", give="sites.trace"
    ),
    ("calibration.relative_tolerance",): UnusedKeys(
        lambda s: s.calibration.stopping == "paper", 'stopping = "paper" has limits of its own'
    ),
    ("calibration.force_error_percent",): UnusedKeys(
        lambda s: s.calibration.objective == "paper" and not s.priors,
        'it sets forces against priors and the touch-down; objective = "paper" ignores the touch-down, and '
        "there are no priors",
    ),
    ("calibration.prior_tissues",): UnusedKeys(
        lambda s: s.calibration.priors is None,
        "it belongs to the priors of people",
        give='calibration.priors = "population"',
    ),
    ("calibration.seed",): UnusedKeys(
        lambda s: s.calibration.starts == 1, "one start is not random", give="calibration.starts"
    ),
    ("calibration.use_socket_pressures",): UnusedKeys(
        lambda s: not s.socket.measured, "no pressure was measured in the socket", give="[[socket.measured]]"
    ),
    ("calibration.search_radius_mm",): UnusedKeys(
        lambda s: s.clamps is not None or bool(s.material.prestretch),
        "the whole limb is clamped or pre-stretched, so parameters are searched on whole meshes",
    ),
    ("calibration.corrections", "calibration.correction_tolerance_percent"): UnusedKeys(
        lambda s: not s.is_searched_apart,
        "parameters are searched on the meshes themselves, so nothing is corrected",
        give="calibration.search_radius_mm or [mesh.coarse]",
    ),
    tuple(f"uncertainty.{key}" for key in _SOURCE_KEYS): UnusedKeys(
        lambda s: not s.uncertainty.sources, "sources = false leaves it out"
    ),
    ("uncertainty.edge_radius_mm",): UnusedKeys(
        lambda s: not any(SHAPES[one.shape].is_edge_doubted for one in s.used_indenters.values()),
        "it is that of a square indenter",
    ),
    ("material.relaxation_span_s",): UnusedKeys(
        lambda s: s.material.law != POWER,
        "the tissues' law does not relax as a power of time",
        give=f'material.law = "{POWER}"',
    ),
    ("material.fibres",): UnusedKeys(
        lambda s: not has_fibres(s.material.law),
        "the tissues' law has no fibres",
        give=f'material.law = "{FIBRED}"',
    ),
    ("material.activation",): UnusedKeys(
        lambda s: s.material.law != ACTIVE,
        "the tissues' law has no active stress",
        give=f'material.law = "{ACTIVE}"',
    ),
    tuple(f"socket.{key}" for key in _SHAPE_KEYS): UnusedKeys(
        lambda s: s.socket.file is not None, "the socket's shape is that of socket.file"
    ),
    ("socket.unit", "socket.space"): UnusedKeys(
        lambda s: s.socket.file is None, "it belongs to a socket from a file", give="socket.file"
    ),
    ("socket.distal_clearance_mm",): UnusedKeys(
        lambda s: s.socket.distal == "bearing", "the distal end bears"
    ),
    ("socket.travel_mm",): UnusedKeys(
        lambda s: s.socket.donning == "growth",
        'donning = "growth" has no travel',
        give='donning = "insertion"',
    ),
    ("socket.design.adapter_mm",): UnusedKeys(
        lambda s: s.socket.design.adapter_diameter_mm == 0, "a diameter of 0 mm is no adapter"
    ),
    tuple(f"socket.liner.{key}" for key in ("material", "c_kPa", "m", "gamma", "tau_s")): UnusedKeys(
        lambda s: s.socket.liner.thickness_mm == 0, "a liner of 0 mm is none"
    ),
    ("socket.body_weight_N",): UnusedKeys(
        lambda s: all(load.preset is None for load in s.socket.loads), "no load is a preset"
    ),
    ("execution.time_limit_s", "execution.memory_limit_GB"): UnusedKeys(
        lambda s: s.execution.workers == 1,
        "one worker is the process itself, which nothing can stop",
        give="2 workers or more",
    ),
}

# Of a record, whether its site states it or a table of its own.
UNUSED_RECORD_KEYS: Rules = {
    ("ultrasound_sd_mm",): UnusedKeys(lambda s, one: one.ultrasound is None, "it has no ultrasound"),
    ("surface_sd_mm", "surface_frame"): UnusedKeys(lambda s, one: one.surface is None, "it has no surface"),
    ("shear_waves_sd_m_s", "shear_waves_bias_m_s"): UnusedKeys(
        lambda s, one: one.shear_waves is None, "it has no shear waves"
    ),
}

UNUSED_SITE_KEYS: Rules = {
    ("weight",): UnusedKeys(lambda s, site: not s.records_at(site), "the site has no record to be weighted"),
    ("speed_mm_s",): UnusedKeys(
        lambda s, site: bool(s.records_at(site)), "the record says how fast the indenter was"
    ),
    ("control",): UnusedKeys(
        lambda s, site: site.trace is None, "it is of the site's trace, and there is none"
    ),
    **UNUSED_RECORD_KEYS,
    ("indenter",): UnusedKeys(
        lambda s, site: site.trace is None and bool(s.records_at(site)),
        "the site's records are stated in [[records]]",
        give="it there",
    ),
    ("edge",): UnusedKeys(
        lambda s, site: (
            all(SHAPES[one.shape].is_round for one in s.indenters_at(site))
            and not any(
                one.shear_waves or (one.surface and one.surface_frame == "site") for one in s.records_at(site)
            )
        ),
        "the indenter is round",
    ),
}


def _find_unused_keys(study: Study, content: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Each key that ``content``, the file as read, states without effect, with why and what to do."""
    for keys, rule in UNUSED_KEYS.items():
        for key in keys:
            if _is_stated(content, key) and rule.when(study):
                yield key, rule.why, rule.remedy
    for name, indenter in study.all_indenters.items():
        place = "indenter.edge_radius_mm" if name is None else f"indenters.{name}.edge_radius_mm"
        if _is_stated(content, place) and not SHAPES[indenter.shape].has_edge:
            yield place, "the indenter has no edge to round", "leave it out"
    edges = ACCURACIES["standard"][0].keys() | ({"coarse"} if study.mesh.coarse is not None else set())
    if "accuracy" in (mesh := content.get("mesh", {})) and edges <= mesh.keys():
        yield "mesh.accuracy", "all edge lengths are stated", "leave it or them out"
    for name in sorted(study.calibration.prior.keys() & set(study.fixed)):
        why = "the parameter stays at its start"
        yield f"calibration.prior.{name}", why, "leave it out, or let the parameter move"
    tables: list[Site | RecordTable] = [*study.sites, *study.records]
    for table, stated in zip(tables, (*content.get("sites", ()), *content.get("records", ())), strict=True):
        for keys, rule in (UNUSED_SITE_KEYS if isinstance(table, Site) else UNUSED_RECORD_KEYS).items():
            for key in keys:
                if key in stated and rule.when(study, table):
                    yield f"{table.key}.{key}", rule.why, rule.remedy


def _is_stated(content: Mapping[str, Any], key: str) -> bool:
    """True if a table states a dotted key; an empty table states nothing."""
    head, _, rest = key.partition(".")
    if head not in content:
        return False
    value = content[head]
    if rest:
        return isinstance(value, Mapping) and _is_stated(value, rest)
    return value != {}
