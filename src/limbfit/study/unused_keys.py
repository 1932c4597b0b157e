"""Keys of a study that would be without effect beside its others: one table, from which they are refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import StudyError
from ..laws import ACTIVE, FIBRED, POWER, has_fibres
from ..shapes import SHAPES
from .meshing import ACCURACIES, CoarseMeshTable, MeshTable
from .records import Site
from .study import Study


@dataclass(frozen=True)
class Vain:
    """Keys that are in vain where ``when`` holds of the study: why, and what to do instead."""

    keys: tuple[str, ...]
    when: Callable[[Study], bool]
    why: str
    remedy: str = "leave it out"


@dataclass(frozen=True)
class VainOfSite:
    """The same for a key of one of the sites."""

    key: str
    when: Callable[[Study, Site], bool]
    why: str
    remedy: str = "leave it out"


def _is_uniform(table: MeshTable | CoarseMeshTable | None) -> bool:
    return table is not None and table.edge_far_mm <= table.edge_near_mm


def _is_capped(table: MeshTable | CoarseMeshTable | None) -> bool:
    return table is not None and table.edge_far_mm < table.edge_near_mm


def _is_one_file(study: Study) -> bool:
    return study.image is not None and study.path(study.image.path).is_file()


_OWN_LABELS = "the study's own labels win over the automatic segmentation"
_NO_WAVES = "the site has no shear waves"
_NO_BONES = "[surfaces] has no bones"
_ONE_LENGTH = "edge_far_mm is no longer than edge_near_mm, so edges have one length"
_AUTOMATIC = ("contrast", "seeds", "bias_correction", "min_bone_volume_mm3")
_SHAPE = (
    *("reduction_percent", "areas", "trim_mm", "trim_planes", "trimline", "flare_mm", "distal"),
    *("distal_clearance_mm", "face_edge_mm"),
)
_SOURCES = ("layer_mm", "position_mm", "axis_degrees", "edge_radius_mm")

VAIN: tuple[Vain, ...] = (
    Vain(("segmentation",), lambda s: s.surfaces is not None, "[surfaces] are not segmented"),
    Vain(tuple(f"segmentation.{key}" for key in _AUTOMATIC), lambda s: s.segmentation.is_given, _OWN_LABELS),
    Vain(
        ("segmentation.min_bone_volume_mm3",),
        lambda s: bool(s.segmentation.seeds),
        "with seeds, the bones are those that have one, however small",
    ),
    Vain(
        ("segmentation.bias_correction",),
        lambda s: s.segmentation.contrast == "CT",
        "CT has no bias field",
    ),
    Vain(("image.series",), _is_one_file, "image.path is a file, not a folder of series"),
    Vain(
        ("image.markers",),
        lambda s: (
            s.image is not None and s.image.marked is not None and all(_find_placed(t) for t in s.sites)
        ),
        "no site is matched to a marker",
        "give near instead of position, or leave it out",
    ),
    Vain(
        ("geometry.surface_edge_mm",),
        lambda s: s.surfaces is not None and s.geometry.amputation is None,
        "given surfaces are used as they are unless they are amputated",
    ),
    Vain(
        ("geometry.amputation_pad_mm",),
        lambda s: s.geometry.amputation is None,
        "there is no amputation",
        "give geometry.amputation, or leave it out",
    ),
    Vain(
        ("geometry.bone_policy", "geometry.bone_clearance_mm"),
        lambda s: s.surfaces is not None and not s.surfaces.bones,
        _NO_BONES,
    ),
    Vain(("mesh.near_radius_mm", "mesh.growth"), lambda s: _is_uniform(s.mesh), _ONE_LENGTH),
    Vain(("mesh.edge_near_mm",), lambda s: _is_capped(s.mesh), "edge_far_mm is shorter, and no edge longer"),
    Vain(
        ("mesh.coarse.near_radius_mm", "mesh.coarse.growth"),
        lambda s: _is_uniform(s.mesh.coarse),
        _ONE_LENGTH,
    ),
    Vain(
        ("mesh.coarse.edge_near_mm",),
        lambda s: _is_capped(s.mesh.coarse),
        "edge_far_mm is shorter, and no edge longer",
    ),
    Vain(
        ("indenter",),
        lambda s: all(one.indenter is not None for one in s.indentations),
        "every record and every planned indentation names another one",
    ),
    Vain(
        ("indenter.edge_radius_mm",),
        lambda s: not SHAPES[s.indenter.shape].has_edge,
        "the indenter has no edge to round",
    ),
    Vain(
        ("traces",),
        lambda s: not s.recorded,
        "no site has a record",
        "give sites.trace, or leave it out",
    ),
    Vain(
        ("calibration.relative_tolerance",),
        lambda s: s.calibration.stopping == "paper",
        'stopping = "paper" has limits of its own',
    ),
    Vain(
        ("calibration.force_error_percent",),
        lambda s: s.calibration.objective == "paper" and not s.priors,
        'it sets forces against priors and the touch-down; objective = "paper" ignores the touch-down, and '
        "there are no priors",
    ),
    Vain(
        ("calibration.prior_tissues",),
        lambda s: s.calibration.priors is None,
        "it belongs to the priors of people",
        'give calibration.priors = "population", or leave it out',
    ),
    Vain(
        ("calibration.seed",),
        lambda s: s.calibration.starts == 1,
        "one start is not random",
        "give calibration.starts, or leave it out",
    ),
    Vain(
        ("calibration.search_radius_mm",),
        lambda s: s.clamps is not None or bool(s.material.prestretch),
        "the whole limb is clamped or pre-stretched, so parameters are searched on whole meshes",
    ),
    Vain(
        ("calibration.corrections", "calibration.correction_tolerance_percent"),
        lambda s: not s.is_searched_apart,
        "parameters are searched on the meshes themselves, so nothing is corrected",
        "give calibration.search_radius_mm or [mesh.coarse], or leave it out",
    ),
    Vain(
        tuple(f"uncertainty.{key}" for key in _SOURCES),
        lambda s: not s.uncertainty.sources,
        "sources = false leaves it out",
    ),
    Vain(
        ("uncertainty.edge_radius_mm",),
        lambda s: not any(SHAPES[one.shape].is_edge_doubted for one in s.used_indenters.values()),
        "it is that of a square indenter",
    ),
    Vain(
        ("material.relaxation_span_s",),
        lambda s: s.material.law != POWER,
        "the tissues' law does not relax as a power of time",
        f'give material.law = "{POWER}", or leave it out',
    ),
    Vain(
        ("material.fibres",),
        lambda s: not has_fibres(s.material.law),
        "the tissues' law has no fibres",
        f'give material.law = "{FIBRED}", or leave it out',
    ),
    Vain(
        ("material.activation",),
        lambda s: s.material.law != ACTIVE,
        "the tissues' law has no active stress",
        f'give material.law = "{ACTIVE}", or leave it out',
    ),
    Vain(
        tuple(f"socket.{key}" for key in _SHAPE),
        lambda s: s.socket.file is not None,
        "the socket's shape is that of socket.file",
    ),
    Vain(
        ("socket.unit", "socket.space"),
        lambda s: s.socket.file is None,
        "it belongs to a socket from a file",
        "give socket.file, or leave it out",
    ),
    Vain(
        ("socket.distal_clearance_mm",),
        lambda s: s.socket.distal == "bearing",
        "the distal end bears",
    ),
    Vain(
        ("socket.travel_mm",),
        lambda s: s.socket.donning == "growth",
        'donning = "growth" has no travel',
        'give donning = "insertion", or leave it out',
    ),
    Vain(
        tuple(f"socket.liner.{key}" for key in ("material", "c_kPa", "m", "gamma", "tau_s")),
        lambda s: s.socket.liner.thickness_mm == 0,
        "a liner of 0 mm is none",
    ),
    Vain(
        ("socket.body_weight_N",),
        lambda s: all(load.preset is None for load in s.socket.loads),
        "no load is a preset",
    ),
    Vain(
        ("execution.time_limit_s", "execution.memory_limit_GB"),
        lambda s: s.execution.workers == 1,
        "one worker is the process itself, which nothing can stop",
        "give 2 workers or more, or leave it out",
    ),
)

VAIN_OF_SITE: tuple[VainOfSite, ...] = (
    VainOfSite("weight", lambda s, site: not s.records_at(site), "the site has no record to be weighted"),
    VainOfSite(
        "speed_mm_s",
        lambda s, site: bool(s.records_at(site)),
        "the record says how fast the indenter was",
    ),
    VainOfSite("control", lambda s, site: site.trace is None, "it is of the site's trace, and there is none"),
    VainOfSite("ultrasound_sd_mm", lambda s, site: site.ultrasound is None, "the site has no ultrasound"),
    VainOfSite("surface_sd_mm", lambda s, site: site.surface is None, "the site has no surface"),
    VainOfSite("surface_frame", lambda s, site: site.surface is None, "the site has no surface"),
    VainOfSite("shear_waves_sd_m_s", lambda s, site: site.shear_waves is None, _NO_WAVES),
    VainOfSite("shear_waves_bias_m_s", lambda s, site: site.shear_waves is None, _NO_WAVES),
    VainOfSite(
        "indenter",
        lambda s, site: site.trace is None and bool(s.records_at(site)),
        "the site's records are stated in [[records]]",
        "give it there",
    ),
    VainOfSite(
        "edge",
        lambda s, site: (
            all(SHAPES[one.shape].is_round for one in s.indenters_at(site))
            and not any(
                one.shear_waves or (one.surface and one.surface_frame == "site") for one in s.records_at(site)
            )
        ),
        "the indenter is round",
    ),
)


def refuse_vain(study: Study, content: Mapping[str, Any]) -> None:
    """Refuse what ``content``, the file as read, states without effect; defaults are no statement.

    Raises
    ------
    StudyError
        With the key, why it is in vain and what to do.
    """
    for rule in VAIN:
        for key in rule.keys:
            if _list_states(content, key) and rule.when(study):
                raise _build_error(study.file, key, rule.why, rule.remedy)
    for name, indenter in study.indenters.items():
        if "edge_radius_mm" in content["indenters"][name] and not SHAPES[indenter.shape].has_edge:
            place = f"indenters.{name}.edge_radius_mm"
            raise _build_error(study.file, place, "the indenter has no edge to round", "leave it out")
    if _has_every_edge(content.get("mesh", {})):
        raise _build_error(study.file, "mesh.accuracy", "all edge lengths are stated", "leave it or them out")
    for site, stated in zip(study.sites, content["sites"], strict=True):
        for one in VAIN_OF_SITE:
            if one.key in stated and one.when(study, site):
                raise _build_error(study.file, f"sites.{site.name}.{one.key}", one.why, one.remedy)


def _find_placed(site: Site) -> bool:
    return site.near is None


def _has_every_edge(mesh: Mapping[str, Any]) -> bool:
    return "accuracy" in mesh and ACCURACIES["standard"][0].keys() <= mesh.keys()


def _list_states(content: Mapping[str, Any], key: str) -> bool:
    """Whether a table states a dotted key; an empty table states nothing."""
    head, _, rest = key.partition(".")
    if head not in content:
        return False
    value = content[head]
    if rest:
        return isinstance(value, Mapping) and _list_states(value, rest)
    return value != {}


def _build_error(file: Path, key: str, why: str, remedy: str) -> StudyError:
    return StudyError(f"without effect: {why}", file=file, place=key, remedy=remedy)
