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

# Studies that state a key in vain: what is set in which study, and the key that is refused.
AMPUTATED = ("geometry.amputation", {"point": [0.0, 0.0, 0.0]})
IN_VAIN: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    (GIVEN, {"segmentation.contrast": "T1"}, "segmentation"),
    *[
        (
            IMAGED,
            {"segmentation.labels": "labels.nrrd", f"segmentation.{key}": ACTS[f"segmentation.{key}"][1]},
            f"segmentation.{key}",
        )
        for key in ("contrast", "seeds", "bias_correction", "min_bone_volume_mm3")
    ],
    (
        IMAGED,
        {"segmentation.seeds": {"tibia": [[0.0, 0.0, 0.0]]}, "segmentation.min_bone_volume_mm3": 500.0},
        "segmentation.min_bone_volume_mm3",
    ),
    (
        IMAGED,
        {"segmentation.contrast": "CT", "segmentation.bias_correction": True},
        "segmentation.bias_correction",
    ),
    (IMAGED, {"image.path": "labels.nrrd", "image.series": "1.2"}, "image.series"),
    (IMAGED, {"sites": GIVEN["sites"], "records": []}, "image.markers"),
    (GIVEN, {"geometry.surface_edge_mm": 3.0}, "geometry.surface_edge_mm"),
    (GIVEN, {"geometry.amputation_pad_mm": 15.0}, "geometry.amputation_pad_mm"),
    (GIVEN, {"surfaces": {"skin": "skin.stl"}, "geometry.bone_policy": "trim-bone"}, "geometry.bone_policy"),
    (
        GIVEN,
        {"surfaces": {"skin": "skin.stl"}, "geometry.bone_clearance_mm": 2.0},
        "geometry.bone_clearance_mm",
    ),
    (GIVEN, {"mesh": {"edge_near_mm": 8, "edge_far_mm": 8, "growth": 0.5}}, "mesh.growth"),
    (GIVEN, {"mesh": {"edge_near_mm": 8, "edge_far_mm": 8, "near_radius_mm": 9}}, "mesh.near_radius_mm"),
    (GIVEN, {"mesh": {"edge_near_mm": 9, "edge_far_mm": 8}}, "mesh.edge_near_mm"),
    (GIVEN, {"mesh.coarse": {"edge_near_mm": 8, "edge_far_mm": 8, "growth": 0.5}}, "mesh.coarse.growth"),
    (
        GIVEN,
        {"mesh.coarse": {"edge_near_mm": 8, "edge_far_mm": 8, "near_radius_mm": 9}},
        "mesh.coarse.near_radius_mm",
    ),
    (GIVEN, {"mesh.coarse": {"edge_near_mm": 9, "edge_far_mm": 8}}, "mesh.coarse.edge_near_mm"),
    (
        GIVEN,
        {
            "mesh": {
                **{"accuracy": "fast", "edge_near_mm": 4, "edge_far_mm": 20},
                **{"near_radius_mm": 9, "growth": 0.5, "flatness": 1.0},
            }
        },
        "mesh.accuracy",
    ),
    (GIVEN, {"indenter": {"shape": "sphere", "edge_radius_mm": 1.0}}, "indenter.edge_radius_mm"),
    (GIVEN, {"sites": GIVEN["sites"][1:], "traces.time_s": "t"}, "traces"),
    (
        GIVEN,
        {"calibration": {"stopping": "paper", "relative_tolerance": 0.01}},
        "calibration.relative_tolerance",
    ),
    (
        GIVEN,
        {"calibration.force_error_percent": 2.0, "calibration.objective": "paper"},
        "calibration.force_error_percent",
    ),
    (GIVEN, {"calibration.prior_tissues": {"skin": "none"}}, "calibration.prior_tissues"),
    (GIVEN, {"calibration.seed": 3}, "calibration.seed"),
    (GIVEN, {"calibration.use_socket_pressures": True}, "calibration.use_socket_pressures"),
    (GIVEN, {"clamps.force_N": 9.0, "calibration.search_radius_mm": 50.0}, "calibration.search_radius_mm"),
    *[
        (
            GIVEN,
            {"mesh.edge_near_mm": 4.0, "calibration": {"search_radius_mm": 0, key: 2}},
            f"calibration.{key}",
        )
        for key in ("corrections", "correction_tolerance_percent")
    ],
    *[
        (GIVEN, {"uncertainty": {"sources": False, key: 1.0}}, f"uncertainty.{key}")
        for key in ("layer_mm", "position_mm", "axis_degrees", "edge_radius_mm")
    ],
    (
        GIVEN,
        {"indenter.shape": "cylinder", "uncertainty.edge_radius_mm": 1.0},
        "uncertainty.edge_radius_mm",
    ),
    *[
        (GIVEN, {"execution": {"workers": 1, key: 9.0}}, f"execution.{key}")
        for key in ("time_limit_s", "memory_limit_GB")
    ],
    *[
        (GIVEN, {"socket": {"file": "other.stl", key: value}}, f"socket.{key}")
        for key, value in {
            **{"reduction_percent": 2.0, "trim_mm": 5.0, "flare_mm": 0.0, "distal": "bearing"},
            **{"areas": [{"name": "1", "region": "tibial crest", "radius_mm": 9.0, "depth_mm": 2.0}]},
            **{"trim_planes": [{"point": [0.0, 0.0, 9.0]}], "trimline": [[0, 0, 0], [9, 0, 0], [0, 9, 0]]},
            **{"distal_clearance_mm": 2.0, "face_edge_mm": 5.0},
        }.items()
    ],
    (GIVEN, {"socket.unit": "m"}, "socket.unit"),
    (GIVEN, {"socket.space": "RAS"}, "socket.space"),
    (GIVEN, {"socket": {"distal": "bearing", "distal_clearance_mm": 2.0}}, "socket.distal_clearance_mm"),
    (GIVEN, {"socket.travel_mm": 20.0}, "socket.travel_mm"),
    *[
        (GIVEN, {"socket": {"liner": {"thickness_mm": 0, key: value}}}, f"socket.liner.{key}")
        for key, value in {"material": "gel", "c_kPa": 9.0, "m": 2.0, "gamma": 1.0, "tau_s": 1.0}.items()
    ],
    (
        GIVEN,
        {"socket": {"loads": [{"name": "1", "force_N": [0, 0, 9]}], "body_weight_N": 700.0}},
        "socket.body_weight_N",
    ),
    (
        GIVEN,
        {
            "indenters.ball": {"shape": "sphere", "edge_radius_mm": 1.0},
            "sites.0.indenter": "ball",
        },
        "indenters.ball.edge_radius_mm",
    ),
    (
        GIVEN,
        {
            "indenters.ball.width_mm": 10.0,
            "sites.0.indenter": "ball",
            "sites.1.indenter": "ball",
            "indenter.width_mm": 9.0,
        },
        "indenter",
    ),
    (
        GIVEN,
        {
            "indenters.ball.width_mm": 10.0,
            "sites.0": {"name": "1", "position": [0.0, -50.0, 10.0], "indenter": "ball"},
            "records": [{"site": "1", "name": "fast", "trace": "1.csv", "indenter": "ball"}],
        },
        "sites.indenter",
    ),
    (GIVEN, {"material.fibres": {"muscle": "axis"}}, "material.fibres"),
    (GIVEN, {"material.relaxation_span_s": [0.1, 1e3]}, "material.relaxation_span_s"),
    (GIVEN, {"material.activation": {"time_s": [0.0, 1.0], "share": [1.0, 0.5]}}, "material.activation"),
    (GIVEN, {"sites.1.control": "force"}, "sites.control"),
    (GIVEN, {"sites.0.ultrasound_sd_mm": 0.2}, "sites.ultrasound_sd_mm"),
    (GIVEN, {"sites.0.surface_sd_mm": 0.2}, "sites.surface_sd_mm"),
    (GIVEN, {"sites.0.surface_frame": "site"}, "sites.surface_frame"),
    (GIVEN, {"sites.0.shear_waves_sd_m_s": 0.2}, "sites.shear_waves_sd_m_s"),
    (GIVEN, {"sites.0.shear_waves_bias_m_s": 0.2}, "sites.shear_waves_bias_m_s"),
    *[
        (
            GIVEN,
            {"records": [{"site": "1", "name": "fast", "trace": "1.csv", key: value}]},
            f"records.1-fast.{key}",
        )
        for key, value in {
            **{"ultrasound_sd_mm": 0.2, "surface_sd_mm": 0.2, "surface_frame": "site"},
            **{"shear_waves_sd_m_s": 0.2, "shear_waves_bias_m_s": 0.2},
        }.items()
    ],
    (IMAGED, {"image.markers": "labels.nrrd", "image.markers_series": "1.2"}, "image.markers_series"),
    (
        GIVEN,
        {"socket.design": {"adapter_diameter_mm": 0, "adapter_mm": 9.0}},
        "socket.design.adapter_mm",
    ),
    (
        IMAGED,
        {"calibration.fixed": ["skin.c_kPa"]},
        "calibration.prior.skin.c_kPa",
    ),
    (GIVEN, {"sites.1.weight": 2.0}, "sites.weight"),
    (GIVEN, {"sites.0.speed_mm_s": 2.0}, "sites.speed_mm_s"),
    (GIVEN, {"indenter.shape": "cylinder", "sites.0.edge": [0.0, 0.0, 1.0]}, "sites.edge"),
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
