"""The people of a trial: inputs drawn by a Sobol sequence, and the study of each with each socket.

The sequence is nested: more people extend it, and every rule has the same people.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from scipy.stats import norm, qmc

from ..anatomy.surfaces.files import write_surface
from ..anatomy.surfaces.surfaces import Anatomy
from ..arrays import Array
from ..errors import InputError, SurfaceError
from ..laws import Parameters, list_flat_names
from ..pipeline.commands.simulate import choose_parameters
from ..pipeline.engine.store import Store
from ..priors import NONE, TISSUES, of_tissues
from ..study import Study, load_study
from ..study.tables import GeometryTable
from .limbs import DrawnLimb, LimbSource, open_limb_source
from .trial import RuleTable, Trial

WEIGHT, LINER = "body weight (N)", "liner (mm)"
SURFACES = "limb"  # folder of a person's surfaces
_SAFE = 1e-9  # numbers stay so far from 0 and 1, where a normal score is infinite


@dataclass(frozen=True)
class Person:
    """A drawn person: ``inputs`` by name, and the thickness of the liner, also where all have the same."""

    number: int
    inputs: Mapping[str, float]
    liner_mm: float


class People:
    """Everybody who may be drawn for a trial, by number from 1.

    Raises `InputError` for shapes, tissues or an identified study that cannot be used.
    """

    def __init__(self, trial: Trial) -> None:
        self.trial = trial
        self.source: LimbSource = open_limb_source(trial)
        self.tables: dict[str, dict[str, Any]] = {name: dict(table) for name, table in trial.person.items()}
        names, self._medians, self._spread = self._read_tissues()
        self.tissue_names = tuple(names)
        thickness = trial.liner.thickness_mm
        self._liners = thickness if isinstance(thickness, tuple) else (thickness, thickness)
        self.names = (*self.source.names, *names, WEIGHT, *([LINER] if len(set(self._liners)) > 1 else []))

    def _read_tissues(self) -> tuple[list[str], Array, Array]:
        """Names, medians (p,) and what normal scores (p,) move their logarithms by (p, p)."""
        place = self.trial.tissues.study
        if place is None:
            try:
                geometry = GeometryTable.model_validate(self.tables.get("geometry", {}))
            except ValueError as error:
                what = str(error).split("\n")[-1].strip()
                raise InputError(what, file=self.trial.file, place="person.geometry") from None
            tissues = [*(one.name for one in geometry.model_layers), geometry.core]
            stated = self.tables.get("calibration", {}).get("prior_tissues", {})
            others = {one: NONE for one in tissues if one not in TISSUES}
            priors = of_tissues(tissues, others | stated)
            median, factor = np.array(list(priors.values())).reshape(-1, 2).T
            return list(priors), median, np.diag(np.log(factor))
        study = load_study(self.trial.path(place), recorded=False)
        if study.geometry.regions:
            what, remedy = "regions such as a tendon are not drawn", "identify a study without them"
            raise InputError(what, file=study.file, place="geometry.regions", remedy=remedy)
        if Store(study.results).stamp("calibrate") is None:
            raise InputError("nothing was identified", file=study.file, remedy="limbfit run first")
        found, _ = choose_parameters(study)
        covariance = np.array(Store(study.results).results.calibration.uncertainty.covariance_log)
        for name in ("geometry", "material"):  # of that study, where the trial does not state its own
            keys = {"layers", "core", "skin_layer_mm"} if name == "geometry" else None
            stated = getattr(study, name).model_dump(mode="json", include=keys, exclude_unset=True)
            self.tables[name] = stated | self.tables.get(name, {})
        value, vector = np.linalg.eigh(covariance)  # some parameters may be held: it has no Cholesky factor
        names = [".".join(name) for name in list_flat_names(study.tissues, study.material.law)]
        return names, study.vector(found), vector * np.sqrt(np.clip(value, 0.0, None))

    def draw(self, number: int) -> Person:
        """The person with a number. The first n of a trial are the same however many follow."""
        ends = np.cumsum([len(self.source.names), len(self.tissue_names), 2])
        sequence = qmc.Sobol(ends[-1], seed=self.trial.population.seed)
        if number > 1:
            sequence.fast_forward(number - 1)
        u = np.clip(sequence.random(1)[0], _SAFE, 1.0 - _SAFE)
        shapes, tissues, last = np.split(u, ends[:-1])
        values = self._medians * np.exp(self._spread @ norm.ppf(tissues))
        weight = self.trial.weight.median_N * self.trial.weight.factor ** float(norm.ppf(last[0]))
        liner = self._liners[0] + (self._liners[1] - self._liners[0]) * float(last[1])
        found = [*self.source.to_inputs(shapes), *values, weight, liner]
        # Without a liner that all have.
        return Person(number, dict(zip(self.names, map(float, found))), liner)

    def to_features(self, inputs: Array) -> Array:
        """Inputs (..., d) for a surrogate: of tissues and weight, which are lognormal, the logarithms."""
        is_lognormal = np.isin(self.names, [*self.tissue_names, WEIGHT])
        return np.where(is_lognormal, np.log(np.where(is_lognormal, inputs, 1.0)), inputs)

    def build_limb(self, person: Person, folder: Path) -> DrawnLimb:
        """Build a person's limb, and write its surfaces into ``folder / SURFACES``."""
        limb = self.source.build(np.array([person.inputs[name] for name in self.source.names]))
        (folder / SURFACES).mkdir(parents=True, exist_ok=True)
        for name, surface in limb.surfaces.items():
            write_surface(folder / SURFACES / f"{name}.stl", surface)
        return limb

    def write_study(self, person: Person, rule: RuleTable, limb: DrawnLimb, folder: Path) -> Study:
        """Write the study of a person with a socket into a folder beside that of the surfaces, and read it.

        Raises `InputError` for keys of the trial's ``person`` or of the rule that a study does not have.
        """
        skin = limb.surfaces["skin"].points
        front = skin[np.argmin(skin[:, 1] + np.abs(skin[:, 2] - skin[:, 2].mean()))]
        bones = {name: f"../{SURFACES}/{name}.stl" for name in limb.surfaces if name != "skin"}
        socket = self.tables.get("socket", {}) | rule.socket
        bears_weight = any("preset" in load for load in socket.get("loads", [{"preset": None}]))
        thickness = round(person.liner_mm, 3)  # one without thickness has no material
        material = {"material": self.trial.liner.material} if thickness else {}
        content = {
            "study": {"name": f"{self.trial.population.name}, person {person.number}, {rule.name}"},
            **{name: table for name, table in self.tables.items() if name != "socket"},
            "surfaces": {"skin": f"../{SURFACES}/skin.stl", "bones": bones},
            "execution": {"workers": 1},  # people, not their simulations, run side by side
            # Studies have a site.
            "sites": [{"name": "1", "position": front.round(3).tolist(), "depth_mm": 5.0}],
            "socket": socket
            | ({"body_weight_N": round(person.inputs[WEIGHT], 3)} if bears_weight else {})
            | {"liner": {"thickness_mm": thickness} | material},
        }
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "study.toml").write_text(tomlkit.dumps(content), encoding="utf-8")
        return load_study(folder)

    def choose_parameters(self, person: Person, study: Study) -> Parameters:
        """Parameters of a person's tissues: those drawn, the others as the study starts them."""
        values = {tissue: dict(study.material.get(tissue, "start")) for tissue in study.tissues}
        for name in self.tissue_names:
            tissue, key = name.split(".")
            if key in values[tissue]:
                values[tissue][key] = person.inputs[name]
        return values

    def check_limb(self, anatomy: Anatomy) -> None:
        """Raise `SurfaceError` for bones nearer to the skin than ``shapes.least_tissue_mm``."""
        least = self.trial.shapes.least_tissue_mm
        for name, bone in anatomy.bones.items():
            inside = bone.points[anatomy.height(bone.points) < -least]
            thinnest = float(-anatomy.skin.signed_distance(inside).max()) if len(inside) else np.inf
            if thinnest < least:
                what = f"{name} comes as near as {max(thinnest, 0.0):.1f} mm to the skin"
                raise SurfaceError(what, place="shapes.least_tissue_mm")
