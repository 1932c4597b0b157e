"""Studies in which every key acts, and who computes something else when it has another value."""

import copy
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from test_study_docs import KEYS

from limbfit.extensions import load_extensions
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.pipeline.commands.run import STAGES, compute_keys
from limbfit.pipeline.engine.provenance import Keys
from limbfit.study import Study, load_study

SEEN = {"ultrasound": "3.csv", "surface": "3.csv", "shear_waves": "3.csv"}
# Studies in which each key acts: the second is for those that an image, layers or markers rule out.
IMAGED: dict[str, Any] = {
    "study": {"name": "one"},
    "image": {"path": "mri", "markers": "marked"},
    "geometry": {
        "layers": [{"name": "skin", "thickness_mm": 1.5}, {"name": "fat", "thickness": "map"}],
        "amputation": {"point": [0.0, 0.0, 0.0]},
        "proximal_cut": {"point": [0.0, 0.0, 90.0]},
    },
    "mesh": {"coarse": {}},
    "calibration": {"prior": {"skin.c_kPa": {"median": 5.0, "factor": 2.0}}, "starts": 2},
    "sites": [
        {"name": "1", "fitted": True, "trace": "1.csv", "near": [0.0, -50.0, 10.0], **SEEN},
        {"name": "2", "trace": "2.csv", "near": [0.0, 50.0, 10.0], "indenter": "ball"},
    ],
    "indenters": {"ball": {}},
    "records": [
        {"site": "2", "name": "fast", "trace": "2.csv", **SEEN},
        {"site": "2", "name": "slow", "trace": "2.csv"},
    ],
}
GIVEN: dict[str, Any] = {
    "study": {"name": "one"},
    "surfaces": {"skin": "skin.stl", "bones": {"tibia": "tibia.stl"}},
    "geometry": {"regions": [{"name": "scar", "surface": "other.stl"}]},
    "sites": [
        {"name": "1", "fitted": True, "trace": "1.csv", "position": [0.0, -50.0, 10.0]},
        {"name": "2", "depth_mm": 6.0, "position": [0.0, 50.0, 10.0]},
    ],
}
FILES = ("skin.stl", "tibia.stl", "other.stl", "1.csv", "2.csv", "3.csv", "labels.nrrd", "contours.csv")
START = {"c_kPa": 4.0, "m": 3.5, "gamma": 1.1, "tau_s": 1.9}

# Key, or where it is in the study (a site by number): who computes something else with which value.
ACTS: dict[str, tuple[str, Any]] = {
    "study.name": ("report", "two"),
    "study.description": ("report", "a limb"),
    "study.extensions": ("segment", ["extension.py"]),
    "image.path": ("segment", "marked"),
    "image.series": ("segment", "1.2.3"),
    "image.markers": ("segment", "same"),
    "image.markers_series": ("segment", "1.2.3"),
    "segmentation.labels": ("segment", "labels.nrrd"),
    "segmentation.contours": ("segment", "contours.csv"),
    "segmentation.contrast": ("segment", "T1"),
    "segmentation.seeds": ("segment", {"tibia": [[0.0, 0.0, 0.0]]}),
    "segmentation.bias_correction": ("segment", False),
    "segmentation.min_bone_volume_mm3": ("segment", 500.0),
    "geometry.layers.1.min_thickness_mm": ("mesh", 2.0),
    "geometry.layers.0.thickness_mm": ("mesh", 2.0),
    "geometry.layers.1.name": ("mesh", "adipose"),
    "geometry.layers.0": ("mesh", {"name": "skin", "thickness_mm": 2.5}),
    "geometry.core": ("mesh", "flesh"),
    "geometry.bone_policy": ("mesh", "thin-skin"),
    "geometry.bone_clearance_mm": ("mesh", 2.0),
    "geometry.amputation.point": ("surfaces", [0.0, 0.0, 9.0]),
    "geometry.amputation.normal": ("surfaces", [0.0, 0.1, 1.0]),
    "geometry.amputation_pad_mm": ("surfaces", 12.0),
    "geometry.proximal_cut.point": ("surfaces", [0.0, 0.0, 99.0]),
    "geometry.proximal_cut.normal": ("surfaces", [0.0, 0.1, 1.0]),
    "geometry.surface_edge_mm": ("surfaces", 2.5),
    "mesh.accuracy": ("mesh", "fast"),
    "mesh.element": ("mesh", "tet10"),
    "mesh.edge_near_mm": ("mesh", 4.0),
    "mesh.edge_far_mm": ("mesh", 25.0),
    "mesh.near_radius_mm": ("mesh", 15.0),
    "mesh.growth": ("mesh", 0.7),
    "mesh.flatness": ("mesh", 1.2),
    "mesh.engine": ("mesh", "netgen"),
    "mesh.time_limit_s": ("calibrate", 60.0),
    "mesh.coarse.edge_near_mm": ("mesh", 7.5),
    "mesh.coarse.edge_far_mm": ("mesh", 25.0),
    "mesh.coarse.near_radius_mm": ("mesh", 15.0),
    "mesh.coarse.growth": ("mesh", 0.7),
    "mesh.coarse.flatness": ("mesh", 1.2),
    "indenter.shape": ("calibrate", "cylinder"),
    "indenter.width_mm": ("sites", 18.0),
    "indenter.edge_radius_mm": ("calibrate", 1.0),
    "indenter.friction": ("calibrate", "sticky"),
    "indenters.ball": ("predict", {"shape": "stl", "file": "other.stl"}),
    "indenters.ball.shape": ("predict", "cylinder"),
    "indenters.ball.width_mm": ("sites", 18.0),
    "indenters.ball.edge_radius_mm": ("predict", 1.0),
    "indenters.ball.friction": ("predict", 0.3),
    "records.0.site": ("calibrate", "1"),
    "records.0.name": ("traces", "quick"),
    "records.0.trace": ("traces", "3.csv"),
    "records.0.touch_down_s": ("traces", 1.0),
    "records.0.peak_s": ("traces", 2.0),
    "records.1.indenter": ("sites", "ball"),
    "records.1.control": ("traces", "force"),
    "sites.0.control": ("traces", "force"),
    "sites.0.ultrasound": ("traces", "2.csv"),
    "sites.0.ultrasound_sd_mm": ("traces", 0.2),
    "sites.0.surface": ("traces", "2.csv"),
    "sites.0.surface_sd_mm": ("traces", 0.2),
    "sites.0.surface_frame": ("traces", "site"),
    "sites.0.shear_waves": ("traces", "2.csv"),
    "sites.0.shear_waves_sd_m_s": ("traces", 0.2),
    "sites.0.shear_waves_bias_m_s": ("traces", 0.2),
    "records.0.ultrasound": ("traces", "1.csv"),
    "records.0.ultrasound_sd_mm": ("traces", 0.2),
    "records.0.surface": ("traces", "1.csv"),
    "records.0.surface_sd_mm": ("traces", 0.2),
    "records.0.surface_frame": ("traces", "site"),
    "records.0.shear_waves": ("traces", "1.csv"),
    "records.0.shear_waves_sd_m_s": ("traces", 0.2),
    "records.0.shear_waves_bias_m_s": ("traces", 0.2),
    "traces.time_s": ("traces", "t"),
    "traces.displacement_mm": ("traces", "d"),
    "traces.force_N": ("traces", "F"),
    "traces.smoothing": ("traces", 1e-3),
    "sites.0.name": ("sites", "A"),
    "sites.0.region": ("report", "front"),
    "sites.1.fitted": ("calibrate", True),
    "sites.0.weight": ("calibrate", 2.0),
    "sites.0.trace": ("traces", "3.csv"),
    "sites.0.indenter": ("calibrate", "ball"),
    "sites.0.touch_down_s": ("traces", 1.0),
    "sites.0.peak_s": ("traces", 2.0),
    "sites.0.near": ("sites", [0.0, -51.0, 10.0]),
    "sites.0.axis": ("sites", [0.0, 1.0, 0.0]),
    "sites.0.edge": ("calibrate", [0.0, 0.0, 1.0]),
    "material.law": ("calibrate", "other"),
    "material.kappa_ratio": ("calibrate", 200.0),
    "material.start": ("calibrate", START),
    "material.lower": ("calibrate", {**START, "m": 2.5, "gamma": 0.5, "tau_s": 0.5}),
    "material.upper": ("calibrate", {name: 4 * value for name, value in START.items()}),
    "material.tissues.fat.start": ("calibrate", {"c_kPa": 2.0}),
    "material.tissues.fat.lower": ("calibrate", {"c_kPa": 1.0}),
    "material.tissues.fat.upper": ("calibrate", {"c_kPa": 10.0}),
    "calibration.stopping": ("calibrate", "paper"),
    "calibration.answer": ("calibrate", "most probable"),
    "calibration.relative_tolerance": ("calibrate", 0.02),
    "calibration.max_iterations": ("calibrate", 9),
    "calibration.fixed": ("calibrate", ["muscle.gamma"]),
    "calibration.tied": ("calibrate", [["skin.tau_s", "muscle.tau_s"]]),
    "calibration.prior.skin.c_kPa.median": ("calibrate", 6.0),
    "calibration.prior.skin.c_kPa.factor": ("calibrate", 1.5),
    "calibration.priors": ("calibrate", "population"),
    "calibration.force_error_percent": ("calibrate", 2.0),
    "calibration.surface_error_mm": ("calibrate", 0.7),
    "calibration.starts": ("calibrate", 3),
    "calibration.seed": ("calibrate", 1),
    "calibration.search_radius_mm": ("calibrate", 50.0),
    "calibration.corrections": ("calibrate", 2),
    "calibration.correction_tolerance_percent": ("calibrate", 0.2),
    "uncertainty.runs": ("uncertainty", 12),
    "uncertainty.checked": ("uncertainty", 1),
    "uncertainty.seed": ("uncertainty", 1),
    "uncertainty.sources": ("uncertainty", False),
    "uncertainty.layer_mm": ("uncertainty", 1.0),
    "uncertainty.position_mm": ("uncertainty", 1.0),
    "uncertainty.axis_degrees": ("uncertainty", 1.0),
    "uncertainty.edge_radius_mm": ("uncertainty", 0.5),
    "solver.load_steps": ("calibrate", 6),
    "solver.unload_steps": ("calibrate", 6),
    "solver.penalty_per_mm": ("calibrate", 90.0),
}
ACTS_ON_SURFACES: dict[str, tuple[str, Any]] = {
    "surfaces.skin": ("surfaces", "other.stl"),
    "surfaces.bones": ("surfaces", {"tibia": "other.stl"}),
    "surfaces.coordinates": ("surfaces", "RAS"),
    "surfaces.unit": ("surfaces", "cm"),
    "geometry.skin_layer_mm": ("mesh", 2.0),
    "geometry.amputation": ("surfaces", {"point": [0.0, 0.0, 0.0]}),
    "geometry.proximal_cut": ("surfaces", {"point": [0.0, 0.0, 90.0]}),
    "geometry.layers": ("mesh", [{"name": "hide", "thickness_mm": 3.0}]),
    "geometry.regions.0.name": ("mesh", "tendon"),
    "geometry.regions.0.surface": ("surfaces", "tibia.stl"),
    "calibration.objective": ("calibrate", "paper"),
    "material.prestretch": ("calibrate", {"skin": 1.1}),
    "clamps": ("calibrate", {"force_N": 15.0}),
    "clamps.force_N": ("calibrate", 14.0),
    "clamps.angles_degrees": ("calibrate", [90.0, -90.0]),
    "clamps.levels_mm": ("calibrate", [10.0]),
    "clamps.width_mm": ("mesh", 15.0),
    "clamps.clamping_s": ("calibrate", 1.0),
    "clamps.settling_s": ("calibrate", 9.0),
    "indenter": ("calibrate", {"shape": "stl", "file": "other.stl"}),
    "sites.0.position": ("sites", [0.0, -51.0, 10.0]),
    "sites.1.depth_mm": ("design", 7.0),
    "sites.1.speed_mm_s": ("design", 2.0),
}
# Of no stage: what reads them instead.
READ: dict[str, str] = {
    **dict.fromkeys(("solver.solver", "febio.program", "febio.penalty"), "pipeline/commands/simulate.py"),
    **dict.fromkeys(("febio.threads", "febio.time_limit_s"), "pipeline/commands/simulate.py"),
    **{key: "pipeline/engine/context.py" for key in KEYS if key.startswith("execution.")},
    **{key: "acquire/" for key in KEYS if key.startswith("acquire.")},
    "acquire.key_gap_ms": "cli/acquire.py",
    **dict.fromkeys(
        ("records.depth_mm", "records.speed_mm_s", "records.hold_s"), "pipeline/commands/acquire.py"
    ),
    **{key: "pipeline/socket/shape.py" for key in KEYS if key.startswith("socket.")},
    **{key: "study/socket.py" for key in KEYS if key.startswith("socket.liner.")},
    **{key: "pipeline/socket/measured.py" for key in KEYS if key.startswith("socket.measured.")},
    **dict.fromkeys(
        (
            *("socket.friction", "socket.donning", "socket.travel_mm"),
            *("socket.donning_s", "socket.hold_s", "socket.loads.duration_s", "socket.loads.hold_s"),
            "socket.liner.thickness_mm",
        ),
        "pipeline/socket/simulation.py",
    ),
    "socket.worn_s": "pipeline/socket/socket.py",
    **{key: "pipeline/socket/design.py" for key in KEYS if key.startswith("socket.design.")},
    **{f"socket.design.{key}": "pipeline/socket/shape.py" for key in ("adapter_diameter_mm", "adapter_mm")},
    **{f"markups.{key}": "study/loading.py" for key in ("file", "gives")},
}
# How else the tables above name them.
OTHER_NAMES = {
    "geometry.layers.thickness": "geometry.layers.0.thickness_mm",  # instead of it
    "geometry.regions.label": "geometry.regions.surface",  # instead of it
    "indenter.file": "indenter",
    **dict.fromkeys(("material.activation.time_s", "material.activation.share"), "material.activation"),
    "indenters.file": "indenters.ball",
    "calibration.prior.median": "calibration.prior.skin.c_kPa.median",
    "calibration.prior.factor": "calibration.prior.skin.c_kPa.factor",
}


def toml(value: Any) -> str:
    """A value as TOML; tables are written in line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def changed(content: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The study with one key set; ``sites.0.name`` and ``prior.skin.c_kPa.factor`` find their way."""
    content = copy.deepcopy(dict(content))
    key = key.replace("skin.c_kPa", "skin/c_kPa")
    *way, last = (part.replace("/", ".") for part in key.split("."))
    table: Any = content
    for part in way:
        table = table[int(part)] if part.isdecimal() else table.setdefault(part, {})
    table[int(last) if last.isdecimal() else last] = value
    return content


def prepare(folder: Path) -> Path:
    """The folder with every file that the studies name."""
    for name in FILES:
        (folder / name).write_text(name)
    (folder / "extension.py").write_text(
        "from dataclasses import replace\nfrom limbfit.laws import LAWS, register_law\n"
        'register_law(replace(LAWS["ogden"], name="other"))\n'
    )
    load_extensions([folder / "extension.py"])
    for name in ("mri", "marked"):
        (folder / name).mkdir()
        (folder / name / "image").write_text(name)
    return folder


def loaded(folder: Path, content: Mapping[str, Any]) -> Study:
    (folder / "study.toml").write_text("".join(f"{key} = {toml(part)}\n" for key, part in content.items()))
    return load_study(folder)


def decided(study: Study) -> dict[str, str]:
    """The key of every stage, and of the experiments that read more of a study."""
    known, stages = Keys(study), compute_keys(study)
    more = [e for e in EXPERIMENTS if e.name in ("uncertainty", "design")]
    return stages | {e.name: known.compute_key(e, stages, e.options).digest for e in more}


def decide(study: Study, name: str) -> str:
    """The key of one stage, without those below it where it reads the whole study, or of an experiment."""
    if name not in ("segment", "surfaces", "traces", "mesh"):
        return decided(study)[name]
    return Keys(study).compute_key(next(stage for stage in STAGES if stage.name == name), {}).digest


@cache
def decide_before(folder: Path, imaged: bool, name: str) -> str:
    return decide(loaded(folder, IMAGED if imaged else GIVEN), name)


@cache
def before(folder: Path, imaged: bool) -> dict[str, str]:
    return decided(loaded(folder, IMAGED if imaged else GIVEN))
