"""A study as a whole: its tables, and what must hold between them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from ..errors import InputError, StudyError
from ..laws import LAWS, OGDEN, Parameters, TissueLaw, flat_names, to_parameters, to_vector
from ..priors import of_tissues
from .acquisition import AcquireTable
from .material import MaterialTable
from .meshing import MeshTable
from .socket import SocketTable
from .tables import (
    CalibrationTable,
    ExecutionTable,
    FebioTable,
    GeometryTable,
    ImageTable,
    IndenterTable,
    MarkupsTable,
    PriorTable,
    SegmentationTable,
    Site,
    SolverTable,
    StudyTable,
    SurfacesTable,
    TomlTable,
    TracesTable,
    UncertaintyTable,
)


class Study(TomlTable):
    """A checked study; ``folder`` is where it lives, ``notes`` what its user should know."""

    study: StudyTable
    image: ImageTable | None = None
    segmentation: SegmentationTable = SegmentationTable()
    surfaces: SurfacesTable | None = None
    geometry: GeometryTable = GeometryTable()
    mesh: MeshTable = MeshTable()
    indenter: IndenterTable = IndenterTable()
    traces: TracesTable = TracesTable()
    markups: MarkupsTable | None = None
    sites: tuple[Site, ...]
    material: MaterialTable = MaterialTable()
    calibration: CalibrationTable = CalibrationTable()
    uncertainty: UncertaintyTable = UncertaintyTable()
    solver: SolverTable = SolverTable()
    febio: FebioTable = FebioTable()
    execution: ExecutionTable = ExecutionTable()
    acquire: AcquireTable = AcquireTable()
    socket: SocketTable = SocketTable()
    file: Path = Field(default=Path("study.toml"), exclude=True)
    notes: tuple[str, ...] = Field(default=(), exclude=True)

    @property
    def folder(self) -> Path:
        return self.file.parent

    @property
    def results(self) -> Path:
        return self.folder / "results"

    @property
    def fitted(self) -> tuple[Site, ...]:
        return tuple(site for site in self.sites if site.fitted)

    @property
    def tissues(self) -> tuple[str, ...]:
        """Names of the materials and of the mesh's regions: the layers, outermost first, and the core."""
        return (*(layer.name for layer in self.geometry.model_layers), self.geometry.core)

    @property
    def law(self) -> TissueLaw:
        """The law of all tissues."""
        return LAWS[self.material.law]

    @property
    def extensions(self) -> tuple[Path, ...]:
        """The files of `StudyTable.extensions`, as paths of this machine."""
        return tuple(self.path(file) for file in self.study.extensions)

    @property
    def indenter_here(self) -> IndenterTable:
        """The indenter, its file as a path of this machine."""
        file = self.indenter.file
        return self.indenter.model_copy(update={"file": None if file is None else self.path(file)})

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """(tissue, parameter) in the order of every flat vector."""
        return flat_names(self.tissues, self.material.law)

    def by_tissue(self, vector: Iterable[float]) -> Parameters:
        """A flat vector as ``{tissue: {name: value}}``."""
        return to_parameters(vector, self.tissues, self.material.law)

    def vector(self, parameters: Parameters) -> NDArray[np.float64]:
        """The flat vector of ``{tissue: {name: value}}``."""
        return to_vector(parameters, self.tissues, self.material.law)

    @property
    def priors(self) -> dict[str, PriorTable]:
        """What is known of parameters beforehand, by name: what is stated, else what people are like."""
        table, people = self.calibration, {}
        if table.priors is not None:
            known = of_tissues(self.tissues, table.prior_tissues)
            people = {
                name: PriorTable(median=median, factor=factor)
                for name, (median, factor) in known.items()
                if name not in table.fixed
            }
        return people | table.prior

    @property
    def within_mm(self) -> float | None:
        """How far from a site its mesh counts where parameters are searched; None: as far as it goes."""
        return self.calibration.search_radius_mm or None

    @property
    def is_searched_apart(self) -> bool:
        """Whether parameters are searched on something smaller than the study's own meshes."""
        return self.mesh.coarse is not None or self.within_mm is not None

    @property
    def inputs(self) -> dict[str, Path]:
        """Every file and folder that the study names, by its key."""
        named: dict[str, Path | None] = {
            "segmentation.labels": self.segmentation.labels,
            "segmentation.contours": self.segmentation.contours,
            "indenter.file": self.indenter.file,
            "socket.file": self.socket.file,
            **{f"study.extensions.{i}": path for i, path in enumerate(self.study.extensions)},
            **{f"sites.{site.name}.trace": site.trace for site in self.sites},
        }
        if self.image is not None:
            named |= {"image.path": self.image.path, "image.markers": self.image.marked}
        if self.surfaces is not None:
            named["surfaces.skin"] = self.surfaces.skin
            named |= {f"surfaces.bones.{name}": path for name, path in self.surfaces.bones.items()}
        if self.markups is not None:
            named["markups.file"] = self.markups.file
        return {key: path for key, path in named.items() if path is not None}

    def path(self, relative: Path) -> Path:
        """A path of the study file as a path of this machine."""
        return self.folder / relative

    def is_recorded(self, site: Site) -> bool:
        """Whether the record that a site names has been made."""
        return site.trace is not None and self.path(site.trace).is_file()

    def site(self, name: str) -> Site:
        for site in self.sites:
            if site.name == name:
                return site
        raise StudyError(
            f"no site is named {name!r}",
            file=self.file,
            place="sites",
            remedy="the study has " + ", ".join(s.name for s in self.sites),
        )

    @field_validator("sites")
    @classmethod
    def _sites(cls, sites: tuple[Site, ...]) -> tuple[Site, ...]:
        names = [site.name for site in sites]
        if not names:
            raise ValueError("the study has no site")
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ValueError(f"site names must differ; given twice: {', '.join(doubled)}")
        return sites

    @model_validator(mode="after")
    def _materials_of_tissues(self) -> Study:
        material, tissues = self.material, self.tissues
        unknown = [tissue for tissue in material.tissues if tissue not in tissues]
        if unknown:
            known = ", ".join(tissues)
            raise ValueError(
                f"material.tissues.{unknown[0]}: the model has no such tissue; its tissues are {known}"
            )
        for name in material.keys:
            lower = max(material.of(tissue, "lower")[name] for tissue in tissues)
            upper = min(material.of(tissue, "upper")[name] for tissue in tissues)
            if not lower < upper:
                raise ValueError(
                    f"material: the tissues' bounds of {name} have no range in common, "
                    "and the stage of one material needs one; widen them"
                )
        return self

    @model_validator(mode="after")
    def _parameters_of_tissues(self) -> Study:
        known = [f"{tissue}.{name}" for tissue, name in self.parameters]
        for name in self.calibration.named:
            if name not in known:
                raise ValueError(f"calibration: no parameter is named {name!r}; they are {', '.join(known)}")
        return self

    @model_validator(mode="after")
    def _priors_of_people(self) -> Study:
        if self.calibration.priors is None:
            return self
        if self.material.law != OGDEN:
            raise ValueError(
                f'calibration.priors: people are described by the law "{OGDEN}", the study has '
                f'"{self.material.law}"; leave it out, or state calibration.prior'
            )
        try:
            of_tissues(self.tissues, self.calibration.prior_tissues)
        except InputError as error:
            raise ValueError(f"calibration.prior_tissues: {error}") from None
        return self

    @model_validator(mode="after")
    def _one_door(self) -> Study:
        if (self.image is None) == (self.surfaces is None):
            raise ValueError("give either [image] or [surfaces]: geometry enters by one door")
        if self.surfaces is not None and any(layer.thickness for layer in self.geometry.layers):
            raise ValueError('a layer with thickness = "map" needs the fat of an [image], not [surfaces]')
        if self.surfaces is not None or (self.image is not None and self.image.markers is None):
            blind = [site.name for site in self.sites if site.position is None]
            if blind:
                raise ValueError(
                    f"site {blind[0]}: 'near' needs image.markers; give 'position' where there are no markers"
                )
        return self
