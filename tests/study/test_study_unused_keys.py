"""Every key of a study that could not change what is computed is refused, and no key is left over."""

from pathlib import Path
from typing import Any

import pytest
from keyed_studies import (
    ACTS,
    ACTS_ON_SURFACES,
    GIVEN,
    IMAGED,
    OTHER_NAMES,
    READ,
    before,
    changed,
    decided,
    loaded,
    prepare,
)
from test_study_docs import KEYS

from limbfit.errors import StudyError
from limbfit.study.loading import UNUSED_KEYS, UNUSED_RECORD_KEYS, UNUSED_SITE_KEYS

AMPUTATED = ("geometry.amputation", {"point": [0.0, 0.0, 0.0]})
Vain = tuple[dict[str, Any], dict[str, Any], str]


def vain(content: dict[str, Any], changes: dict[str, Any], key: str = "") -> Vain:
    """A study that states a key in vain: the last that is set in it, unless it is another one."""
    parts = [part for part in list(changes)[-1].split(".") if not part.isdecimal()]
    return content, changes, key or ".".join(parts)


NO_BONES = {"skin": "skin.stl"}
FAST = {"site": "1", "name": "fast", "trace": "1.csv"}
IN_VAIN: list[Vain] = [
    vain(GIVEN, {"segmentation.contrast": "T1"}, "segmentation"),
    *[
        vain(
            IMAGED,
            {"segmentation.labels": "labels.nrrd", f"segmentation.{key}": ACTS[f"segmentation.{key}"][1]},
        )
        for key in ("contrast", "seeds", "bias_correction", "min_bone_volume_mm3")
    ],
    vain(
        IMAGED,
        {"segmentation.seeds": {"tibia": [[0.0, 0.0, 0.0]]}, "segmentation.min_bone_volume_mm3": 500.0},
    ),
    vain(IMAGED, {"segmentation.contrast": "CT", "segmentation.bias_correction": True}),
    vain(IMAGED, {"image.path": "labels.nrrd", "image.series": "1.2"}),
    vain(IMAGED, {"sites": GIVEN["sites"], "records": []}, "image.markers"),
    vain(GIVEN, {"geometry.surface_edge_mm": 3.0}),
    vain(GIVEN, {"geometry.amputation_pad_mm": 15.0}),
    vain(GIVEN, {"surfaces": NO_BONES, "geometry.bone_policy": "trim-bone"}),
    vain(GIVEN, {"surfaces": NO_BONES, "geometry.bone_clearance_mm": 2.0}),
    *[
        vain(GIVEN, {f"{mesh}.edge_far_mm": 8, f"{mesh}.edge_near_mm": near, f"{mesh}.{key}": value})
        for mesh in ("mesh", "mesh.coarse")
        for near, key, value in ((8, "growth", 0.5), (8, "near_radius_mm", 9), (9, "edge_near_mm", 9))
    ],
    vain(
        GIVEN,
        {
            **{"mesh.edge_near_mm": 4, "mesh.edge_far_mm": 20, "mesh.near_radius_mm": 9},
            **{"mesh.growth": 0.5, "mesh.flatness": 1.0, "mesh.accuracy": "fast"},
        },
    ),
    vain(GIVEN, {"indenter.shape": "sphere", "indenter.edge_radius_mm": 1.0}),
    vain(GIVEN, {"sites": GIVEN["sites"][1:], "traces.time_s": "t"}, "traces"),
    vain(GIVEN, {"calibration.stopping": "paper", "calibration.relative_tolerance": 0.01}),
    vain(GIVEN, {"calibration.objective": "paper", "calibration.force_error_percent": 2.0}),
    vain(GIVEN, {"calibration.prior_tissues": {"skin": "none"}}),
    vain(GIVEN, {"calibration.seed": 3}),
    vain(GIVEN, {"calibration.use_socket_pressures": True}),
    vain(GIVEN, {"clamps.force_N": 9.0, "calibration.search_radius_mm": 50.0}),
    *[
        vain(GIVEN, {"mesh.edge_near_mm": 4.0, "calibration.search_radius_mm": 0, f"calibration.{key}": 2})
        for key in ("corrections", "correction_tolerance_percent")
    ],
    *[
        vain(GIVEN, {"uncertainty.sources": False, f"uncertainty.{key}": 1.0})
        for key in ("layer_mm", "position_mm", "axis_degrees", "edge_radius_mm")
    ],
    vain(GIVEN, {"indenter.shape": "cylinder", "uncertainty.edge_radius_mm": 1.0}),
    *[
        vain(GIVEN, {"execution.workers": 1, f"execution.{key}": 9.0})
        for key in ("time_limit_s", "memory_limit_GB")
    ],
    *[
        vain(GIVEN, {"socket.file": "other.stl", f"socket.{key}": value})
        for key, value in {
            **{"reduction_percent": 2.0, "trim_mm": 5.0, "flare_mm": 0.0, "distal": "bearing"},
            **{"areas": [{"name": "1", "region": "tibial crest", "radius_mm": 9.0, "depth_mm": 2.0}]},
            **{"trim_planes": [{"point": [0.0, 0.0, 9.0]}], "trimline": [[0, 0, 0], [9, 0, 0], [0, 9, 0]]},
            **{"distal_clearance_mm": 2.0, "face_edge_mm": 5.0},
        }.items()
    ],
    vain(GIVEN, {"socket.unit": "m"}),
    vain(GIVEN, {"socket.space": "RAS"}),
    vain(GIVEN, {"socket.distal": "bearing", "socket.distal_clearance_mm": 2.0}),
    vain(GIVEN, {"socket.travel_mm": 20.0}),
    *[
        vain(GIVEN, {"socket.liner.thickness_mm": 0, f"socket.liner.{key}": value})
        for key, value in {"material": "gel", "c_kPa": 9.0, "m": 2.0, "gamma": 1.0, "tau_s": 1.0}.items()
    ],
    vain(GIVEN, {"socket.loads": [{"name": "1", "force_N": [0, 0, 9]}], "socket.body_weight_N": 700.0}),
    vain(
        GIVEN,
        {"sites.0.indenter": "ball", "indenters.ball.shape": "sphere", "indenters.ball.edge_radius_mm": 1.0},
    ),
    vain(
        GIVEN,
        {
            **{"indenters.ball.width_mm": 10.0, "sites.0.indenter": "ball", "sites.1.indenter": "ball"},
            "indenter.width_mm": 9.0,
        },
        "indenter",
    ),
    vain(
        GIVEN,
        {
            "indenters.ball.width_mm": 10.0,
            "sites.0": {"name": "1", "position": [0.0, -50.0, 10.0], "indenter": "ball"},
            "records": [{**FAST, "indenter": "ball"}],
        },
        "sites.indenter",
    ),
    vain(GIVEN, {"material.fibres": {"muscle": "axis"}}),
    vain(GIVEN, {"material.relaxation_span_s": [0.1, 1e3]}),
    vain(GIVEN, {"material.activation": {"time_s": [0.0, 1.0], "share": [1.0, 0.5]}}),
    vain(GIVEN, {"sites.1.control": "force"}),
    *[
        one
        for key, value in {
            **{"ultrasound_sd_mm": 0.2, "surface_sd_mm": 0.2, "surface_frame": "site"},
            **{"shear_waves_sd_m_s": 0.2, "shear_waves_bias_m_s": 0.2},
        }.items()
        for one in (
            vain(GIVEN, {f"sites.0.{key}": value}),
            vain(GIVEN, {"records": [{**FAST, key: value}]}, f"records.1-fast.{key}"),
        )
    ],
    vain(IMAGED, {"image.markers": "labels.nrrd", "image.markers_series": "1.2"}),
    vain(GIVEN, {"socket.design.adapter_diameter_mm": 0, "socket.design.adapter_mm": 9.0}),
    vain(IMAGED, {"calibration.fixed": ["skin.c_kPa"]}, "calibration.prior.skin.c_kPa"),
    vain(GIVEN, {"sites.1.weight": 2.0}),
    vain(GIVEN, {"sites.0.speed_mm_s": 2.0}),
    vain(GIVEN, {"indenter.shape": "cylinder", "sites.0.edge": [0.0, 0.0, 1.0]}),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("study"))


def plain(key: str) -> str:
    """A key of the tables as KEYS has it: sites and layers without numbers, no tissue."""
    parts = [part for part in key.replace("skin.c_kPa.", "").split(".") if not part.isdecimal()]
    return ".".join(parts).replace("tissues.fat.", "tissues.").replace("indenters.ball.", "indenters.")


def test_every_key_acts_or_is_refused() -> None:
    known = {plain(key) for key in (*ACTS, *ACTS_ON_SURFACES, *READ)}
    refused = {key for _, _, key in IN_VAIN}
    silent = [key for key in KEYS if OTHER_NAMES.get(key, key) not in known | set(ACTS) | refused]
    assert silent == []


@pytest.mark.parametrize(("content", "changes", "key"), IN_VAIN, ids=[key for _, _, key in IN_VAIN])
def test_a_key_without_effect_is_refused(folder: Path, content: Any, changes: Any, key: str) -> None:
    for one, value in changes.items():
        content = changed(content, one, value)
    with pytest.raises(StudyError, match="without effect") as caught:
        loaded(folder, content)
    named = str(caught.value.place)
    assert ".".join(part for part in named.split(".") if part not in ("1", "2")) == key
    assert caught.value.remedy


def test_every_refusal_is_tried() -> None:
    tried = {key for _, _, key in IN_VAIN}
    stated = {key for keys in UNUSED_KEYS for key in keys}
    stated |= {f"sites.{key}" for keys in UNUSED_SITE_KEYS for key in keys}
    stated |= {f"records.1-fast.{key}" for keys in UNUSED_RECORD_KEYS for key in keys}
    by_name = {"mesh.accuracy", "indenter.edge_radius_mm", "indenters.ball.edge_radius_mm"}
    by_name |= {"calibration.prior.skin.c_kPa"}
    assert stated | by_name == tried


def test_an_accuracy_that_adds_a_coarse_mesh_acts_beside_all_edges(folder: Path) -> None:
    edges = {"edge_near_mm": 3.0, "edge_far_mm": 24.0, "near_radius_mm": 14.0, "growth": 0.6, "flatness": 1.6}
    assert loaded(folder, changed(GIVEN, "mesh", {"accuracy": "fine", **edges})).mesh.coarse is not None


def test_what_an_amputation_takes_is_not_in_vain(folder: Path) -> None:
    content = changed(GIVEN, *AMPUTATED)
    content["geometry"] |= {"surface_edge_mm": 2.5, "amputation_pad_mm": 9.0}
    assert decided(loaded(folder, content))["surfaces"] != before(folder, False)["surfaces"]
