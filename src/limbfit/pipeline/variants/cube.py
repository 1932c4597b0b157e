"""The cube of the paper's figures 8 and 9: tissues compared by their stress in uniaxial compression.

A cube of 10 mm between frictionless plates that hold on to it: compressed over 0.5 s, brought back over
0.5 s, held for 1 s, its sides free. The paper does not say how far it was compressed.
"""

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from ... import report
from ...arrays import Array
from ...errors import InputError, RunError
from ...fe import History, Material, Ogden, Problem, StepControl, Support, System, iterate
from ...fe.materials import PronyTerms
from ...fe.observables import compute_element_fields
from ...indentation import build_materials
from ...laws import KPA, LAWS, OGDEN
from ...mesh import Mesh
from ...mesh.cells import HEX, build_boxes
from ...relaxation import DEFAULT_SPAN_S
from ...results.variants import CubeResult, CubeTissue
from ...study import Study
from ..engine.context import Context
from ..engine.store import write_curves, write_result
from ..simulation.limb_geometry import LimbGeometry
from .variants import format_column


class PublishedTissue(BaseModel):
    """A tissue of the literature; ``published.toml`` says what its keys are."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    kind: Literal["skin", "muscle"]
    values: str
    terms: tuple[tuple[float, float], ...]
    bulk_kPa: float
    relaxation: tuple[float, float] | tuple[()] | None = None
    conversion: str
    source: str

    def material(self, relaxation: PronyTerms) -> Ogden:
        """The tissue for the solver, MPa; ``relaxation`` is taken where none was published."""
        if self.relaxation is not None:
            relaxation = (self.relaxation,) if self.relaxation else ()
        shear = 0.5 * sum(c for c, _ in self.terms)
        terms = tuple((c * KPA, m) for c, m in self.terms)
        return Ogden(terms, relaxation, kappa_ratio=self.bulk_kPa / shear)


_FILE = Path(__file__).with_name("published.toml")
PUBLISHED = tuple(
    PublishedTissue(**row) for row in tomllib.loads(_FILE.read_text(encoding="utf-8"))["tissues"]
)
SIDE_MM, RAMP_S, HOLD_S = 10.0, 0.5, 1.0
STEPS = 40  # in each ramp, and in the time held
COMPRESSION_PERCENT = 20.0


def compress_cube(
    output: Path | None = None,
    *,
    parameters: dict[str, dict[str, float]] | None = None,
    kappa_ratio: float = 100.0,
    law: str = OGDEN,
    relaxation_span_s: tuple[float, float] = DEFAULT_SPAN_S,
    compression_percent: float = COMPRESSION_PERCENT,
) -> dict[str, Any]:
    """Compress a cube of each given tissue, of the paper's and of the published ones.

    Returns ``tissues``: for each its name, kind, law, peak stress, what is left of it and its change of
    volume; ``time_s``, and ``stress_kPa`` for each tissue (Cauchy stress along the compression, positive when
    pushing). Raises `InputError` for a compression that is no compression.

    Parameters
    ----------
    output : folder for ``cube.json``, ``cube.csv`` and ``cube.svg``; None: nothing is written.
    parameters : ``{tissue: {name: value}}``, outermost first; the last one stands beside published
        muscle, all others beside published skin. None: published tissues only.
    kappa_ratio : bulk modulus over the shear modulus of the given tissues.
    law : name of their law.
    relaxation_span_s : first and last time of relaxation as a power of time.
    compression_percent : of the side of the cube.
    """
    check_compression(compression_percent)
    ramp = np.arange(1, STEPS + 1) / STEPS  # even in each ramp, dense at first while the cube is held
    times = np.concatenate([RAMP_S * ramp, RAMP_S * (1 + ramp), 2 * RAMP_S + HOLD_S * ramp**1.5])
    rows, stresses = [], {}
    own = build_materials(parameters or {}, kappa_ratio, law, relaxation_span_s=relaxation_span_s)
    back = int(np.argmin(np.abs(times - 2 * RAMP_S)))  # at its height again
    for material, facts in _list_tissues(parameters or {}, own, law):
        stress, least, most = compress(material, times, compression_percent)
        stresses[facts["tissue"]] = stress.tolist()
        told = {"peak_kPa": stress.max(), "back_kPa": stress[back], "end_kPa": stress[-1]}
        rows.append(CubeTissue(**facts, **_list_moduli(material), **told, J_min=least, J_max=most))
    content = CubeResult(
        side_mm=SIDE_MM,
        compression_percent=compression_percent,
        ramp_s=RAMP_S,
        hold_s=HOLD_S,
        element="hex8",
        tissues=rows,
        time_s=times.tolist(),
        stress_kPa=stresses,
    )
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        write_result(output / "cube.json", content)
        curves = {format_column(name, "kPa"): np.array([0.0, *stress]) for name, stress in stresses.items()}
        write_curves(output / "cube.csv", time_s=np.r_[0.0, times], **curves)
        (output / "cube.svg").write_text(report.draw_cube(content), encoding="utf-8")
    return content.to_plain()


def _list_moduli(material: Material) -> dict[str, Any]:
    """The law of a tissue as it is stored: moduli in kPa, relaxation and Ogden terms."""
    table = material.table()
    return {
        "shear_modulus_kPa": material.instantaneous_modulus / (1.0 + table.prony[:, 0].sum()) / KPA,
        "instantaneous_modulus_kPa": material.instantaneous_modulus / KPA,
        "bulk_modulus_kPa": table.kappa / KPA,
        "prony": table.prony.tolist(),
        "terms": [(c / KPA, m) for c, m in table.terms] if table.has_terms else [],
    }


def check_compression(percent: float) -> None:
    """Raise `InputError` for a compression that is none, or too large."""
    if not 0.0 < percent <= 60.0:
        raise InputError(
            f"a compression of {percent:g} % is not possible here",
            place="compression",
            remedy="give one above 0 and up to 60 %",
        )


def check_cube(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse tissues with fibres, and what is no compression."""
    check_compression(options["compression_percent"])
    if study.fibres:
        what = "the cube compares isotropic tissues, and this study has fibres"
        raise InputError(what, file=study.file, place="material.law")


def run_cube(context: Context, folder: Path, *, compression_percent: float = COMPRESSION_PERCENT) -> None:
    """The experiment: this study's identified tissues beside the published ones."""
    context.tell("cube", 0, 1, "compressing")
    compress_cube(
        folder,
        parameters=context.results.calibration.parameters,
        kappa_ratio=context.study.material.kappa_ratio,
        law=context.study.material.law,
        relaxation_span_s=context.study.material.relaxation_span_s,
        compression_percent=compression_percent,
    )


def _list_tissues(
    parameters: dict[str, dict[str, float]], own: dict[str, Material], law: str
) -> Iterator[tuple[Material, dict[str, Any]]]:
    """The given tissues and the published ones, and what is said of each."""
    for tissue, values in parameters.items():
        stated = (f"{p.key} = {values[p.key]:.4g} {p.unit}".rstrip() for p in LAWS[law].parameters)
        facts = {
            "tissue": f"{tissue} (this study)",
            "kind": "muscle" if tissue == list(parameters)[-1] else "skin",
            "law": LAWS[law].words,
            "values": ", ".join(stated),
            "conversion": "none",
            "source": "this study",
        }
        yield own[tissue], facts
    # The paper's, where no study gives its own.
    relaxation: dict[str, PronyTerms] = {"skin": ((3.57, 0.32),), "muscle": ((3.47, 0.34),)}
    if parameters:
        first, last = (tuple(map(tuple, list(own.values())[i].table().prony)) for i in (0, -1))
        relaxation = {"skin": first, "muscle": last}
    for known in PUBLISHED:
        facts = {key: getattr(known, key) for key in ("kind", "values", "conversion", "source")}
        facts |= {"tissue": known.name, "law": "sum of Ogden terms"}
        yield known.material(relaxation[known.kind]), facts


def compress(material: Material, times: Array, compression_percent: float) -> tuple[Array, float, float]:
    """Stress (k,) in kPa at ``times`` s, and the least and largest ratio of volumes."""
    depth = SIDE_MM * compression_percent / 100.0
    ramp = np.array([0.0, RAMP_S, 2 * RAMP_S, 2 * RAMP_S + HOLD_S])
    side = np.array([0.0, SIDE_MM])
    points, corners = build_boxes(side, side, side)
    mesh = Mesh(points, corners[:, HEX], "hex8", np.zeros(len(corners), dtype=int), ("cube",), {}, {})
    planes = [Support(np.flatnonzero(mesh.points[:, i] == 0.0), i) for i in range(3)]
    top = Support(np.flatnonzero(mesh.points[:, 2] == SIDE_MM), 2, -1.0)
    problem = Problem(
        mesh=mesh,
        materials={"cube": material},
        fixed=np.zeros(0, dtype=int),
        contact_faces=np.zeros((0, 4), dtype=int),
        indenter=None,
        history=History(ramp, np.array([0.0, depth, 0.0, 0.0])),
        supports=(*planes, top),
    )
    system, laws = System(problem), problem.build_laws()
    found: dict[float, tuple[float, float]] = {}
    for step in iterate(problem, StepControl(times=tuple(times), tolerance=1e-7)):
        fields = compute_element_fields(system, laws, step.state)
        found[step.time] = (-float(fields.cauchy[0, 2]), float(fields.J[0]))
    missing = [t for t in times if t not in found]
    if missing:
        raise RunError(f"the cube could not be solved beyond {missing[0]:.3g} s; compress it less far")
    stress, volume = np.array([found[t] for t in times]).T
    return stress / KPA, float(volume.min()), float(volume.max())
