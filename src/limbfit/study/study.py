"""A study as a whole: its tables, and what must hold between them."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from .. import laws
from ..errors import StudyError
from ..priors import of_tissues
from ..relaxation import choose_relaxation_times
from . import tables
from .material import MaterialTable
from .meshing import MeshTable, list_indenter_widths, replace_edges
from .records import RECORDED, STORED_ENDINGS, Indentation, Record, RecordTable, Site, list_records
from .socket import SocketTable


def _replace_lists(content: Any) -> Any:
    """Tuples for lists, however deep: of types that are strict, nothing else is a tuple."""
    if isinstance(content, Mapping):
        return {key: _replace_lists(value) for key, value in content.items()}
    return tuple(map(_replace_lists, content)) if isinstance(content, list) else content


class Study(tables.TomlFile):
    """A checked study; ``folder`` is where it lives, ``notes`` what its user should know."""

    study: tables.StudyTable
    image: tables.ImageTable | None = None
    segmentation: tables.SegmentationTable = tables.SegmentationTable()
    surfaces: tables.SurfacesTable | None = None
    geometry: tables.GeometryTable = tables.GeometryTable()
    mesh: MeshTable = MeshTable()
    indenter: tables.IndenterTable = tables.IndenterTable()
    indenters: dict[str, tables.IndenterTable] = Field(default={})
    clamps: tables.ClampsTable | None = None
    traces: tables.TracesTable = tables.TracesTable()
    markups: tables.MarkupsTable | None = None
    sites: tuple[Site, ...] = ()
    records: tuple[RecordTable, ...] = ()
    material: MaterialTable = MaterialTable()
    calibration: tables.CalibrationTable = tables.CalibrationTable()
    uncertainty: tables.UncertaintyTable = tables.UncertaintyTable()
    solver: tables.SolverTable = tables.SolverTable()
    febio: tables.FebioTable = tables.FebioTable()
    execution: tables.ExecutionTable = tables.ExecutionTable()
    acquire: tables.AcquireTable = tables.AcquireTable()
    socket: SocketTable = SocketTable()
    file: Path = Field(default=Path("study.toml"), exclude=True)
    notes: tuple[str, ...] = Field(default=(), exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _fill_mesh_edges(cls, content: dict[str, Any]) -> dict[str, Any]:
        edges = replace_edges(content.get("mesh", {}), list_indenter_widths(content))
        return {**_replace_lists(content), "mesh": edges}

    @property
    def fitted(self) -> tuple[Site, ...]:
        return tuple(site for site in self.sites if site.fitted)

    def records_at(self, *sites: Site) -> tuple[Record, ...]:
        """The records of some sites, site by site."""
        return tuple(record for site in sites for record in list_records(site, self.records))

    @property
    def recorded(self) -> tuple[Record, ...]:
        """The records of all sites, site by site."""
        return self.records_at(*self.sites)

    @property
    def indentations(self) -> tuple[Indentation, ...]:
        """Every record, and every site that plans an indentation instead, site by site."""
        found: list[Indentation] = []
        for site in self.sites:
            found += self.records_at(site) or (site,)
        return tuple(found)

    @property
    def tissues(self) -> tuple[str, ...]:
        """Names of the materials and of the mesh's regions: layers, outermost first, regions, the core."""
        layers, regions = self.geometry.model_layers, self.geometry.regions
        return (*(one.name for one in layers), *(one.name for one in regions), self.geometry.core)

    @property
    def law(self) -> laws.TissueLaw:
        """The law of all tissues, with the study's relaxation times, where it has some."""
        law = laws.LAWS[self.material.law]
        if law.name != laws.POWER:
            return law
        times = choose_relaxation_times(*self.material.relaxation_span_s)
        return replace(law, relaxation_times_s=tuple(times.tolist()))

    @property
    def fibres(self) -> dict[str, Literal["axis", "flow"] | tables.Vector]:
        """Direction of the fibres in the tissues that have some: the limb's axis in the core by default."""
        if not laws.has_fibres(self.material.law):
            return {}
        return self.material.fibres or {self.geometry.core: "axis"}

    @property
    def fixed(self) -> tuple[str, ...]:
        """The parameters that stay at their start: those stated, and of fibres that a tissue has not."""
        if not laws.has_fibres(self.material.law):
            return self.calibration.fixed
        bare = [tissue for tissue in self.tissues if tissue not in self.fibres]
        without = (f"{tissue}.{key}" for tissue in bare for key in laws.FIBRE_KEYS if key in self.law.keys)
        return tuple(dict.fromkeys((*self.calibration.fixed, *without)))

    @property
    def extensions(self) -> tuple[Path, ...]:
        """The files of `StudyTable.extensions`, as paths of this machine."""
        return tuple(self.path(file) for file in self.study.extensions)

    @property
    def all_indenters(self) -> dict[str | None, tables.IndenterTable]:
        """The study's indenters by name; that of ``[indenter]`` under None."""
        named: dict[str | None, tables.IndenterTable] = {None: self.indenter}
        return named | dict(self.indenters)

    def indenter_of(self, indentation: Indentation) -> tables.IndenterTable:
        """The indenter of a record or of a planned indentation, its file as a path of this machine."""
        found = self.all_indenters[indentation.indenter]
        return found.model_copy(update={"file": None if found.file is None else self.path(found.file)})

    @property
    def used_indenters(self) -> dict[str | None, tables.IndenterTable]:
        """Those of `all_indenters` that touch somewhere."""
        used = {one.indenter for one in self.indentations}
        return {name: one for name, one in self.all_indenters.items() if name in used}

    def indenters_at(self, site: Site) -> tuple[tables.IndenterTable, ...]:
        """The indenters that touch at a site."""
        return tuple(self.all_indenters[one.indenter] for one in self.records_at(site) or (site,))

    def width_at(self, site: Site) -> float:
        """Width of the widest indenter that touches at a site, mm."""
        return max(indenter.width_mm for indenter in self.indenters_at(site))

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """(tissue, parameter) in the order of every flat vector."""
        return laws.list_flat_names(self.tissues, self.material.law)

    def by_tissue(self, vector: Iterable[float]) -> laws.Parameters:
        """A flat vector as ``{tissue: {name: value}}``."""
        return laws.to_parameters(vector, self.tissues, self.material.law)

    def vector(self, parameters: laws.Parameters) -> NDArray[np.float64]:
        """The flat vector of ``{tissue: {name: value}}``."""
        return laws.to_vector(parameters, self.tissues, self.material.law)

    @property
    def priors(self) -> dict[str, tables.PriorTable]:
        """The priors of parameters by name: those stated, else those of people."""
        table, people = self.calibration, {}
        if table.priors is not None:
            known = of_tissues(self.tissues, table.prior_tissues)
            people = {
                name: tables.PriorTable(median=median, factor=factor)
                for name, (median, factor) in known.items()
                if name not in table.fixed
            }
        return people | table.prior

    @property
    def within_mm(self) -> float | None:
        """Radius, mm, of the mesh around a site on which parameters are searched; None: the whole mesh."""
        whole = self.clamps is not None or self.material.prestretch  # of which parts do not keep what it is
        return None if whole else self.calibration.search_radius_mm or None

    @property
    def is_searched_apart(self) -> bool:
        """True if parameters are searched on coarser or smaller meshes than the final answer's."""
        return self.mesh.coarse is not None or self.within_mm is not None

    @property
    def inputs(self) -> dict[str, Path]:
        """Every file and folder that the study names, by its key."""
        named: dict[str, Path | None] = {
            "segmentation.labels": self.segmentation.labels,
            "segmentation.contours": self.segmentation.contours,
            "indenter.file": self.indenter.file,
            "socket.file": self.socket.file,
            **{f"socket.measured.{one.name}.file": one.file for one in self.socket.measured},
            **{f"socket.measured.{one.name}.markups": one.markups for one in self.socket.measured},
            **{f"geometry.regions.{one.name}.surface": one.surface for one in self.geometry.regions},
            **{f"indenters.{name}.file": one.file for name, one in self.indenters.items()},
            **{f"study.extensions.{i}": path for i, path in enumerate(self.study.extensions)},
            **{f"{one.key}.{key}": getattr(one, key) for one in self.recorded for key in RECORDED},
        }
        if self.image is not None:
            named |= {"image.path": self.image.path, "image.markers": self.image.marked}
        if self.surfaces is not None:
            named["surfaces.skin"] = self.surfaces.skin
            named |= {f"surfaces.bones.{name}": path for name, path in self.surfaces.bones.items()}
        if self.markups is not None:
            named["markups.file"] = self.markups.file
        return {key: path for key, path in named.items() if path is not None}

    def is_recorded(self, indentation: Indentation) -> bool:
        """True if the record of an indentation has been made."""
        return indentation.trace is not None and self.path(indentation.trace).is_file()

    def site(self, name: str) -> Site:
        self.refuse_no_site()
        known = {site.name: site for site in self.sites}
        if name in known:
            return known[name]
        remedy = f"the study has {', '.join(known)}"
        raise StudyError(f"no site is named {name!r}", file=self.file, place="sites", remedy=remedy)

    def refuse_no_site(self) -> None:
        """Raise `StudyError` where no site is stated yet: the study then goes as far as its surfaces."""
        if not self.sites:
            remedy = "add [[sites]], or place sites in limbfit studio"
            raise StudyError("the study has no site yet", file=self.file, place="sites", remedy=remedy)

    def indentation(self, name: str) -> Indentation:
        """Return the record, or the planned indentation, of a name; a site with one record stands for it."""
        for one in self.indentations:
            if one.name == name:
                return one
        site = self.site(name)
        records = self.records_at(site)
        if len(records) == 1:
            return records[0]
        what, remedy = f"site {name} has several records", ", ".join(record.name for record in records)
        raise StudyError(what, file=self.file, place="records", remedy=f"name one of {remedy}")

    @field_validator("sites")
    @classmethod
    def _check_sites(cls, sites: tuple[Site, ...]) -> tuple[Site, ...]:
        if doubled := tables.find_repeated(site.name for site in sites):
            raise ValueError(f"site names must differ; given twice: {', '.join(doubled)}")
        return sites

    def check_keys(self) -> None:
        self._check_records()
        self._check_measurements()
        self._check_material()
        self._check_geometry()

    def _check_records(self) -> None:
        names = [site.name for site in self.sites]
        for table in self.records:
            if table.site not in names:
                what = f"records.{table.name}: no site is named {table.site!r}"
                raise ValueError(f"{what}; they are {', '.join(names)}")
        names += [table.full_name for table in self.records]
        if doubled := tables.find_repeated(names):
            raise ValueError(f"two records, or a record and a site, have the name {doubled[0]!r}")
        for other, ending in (name.rsplit("-", 1) for name in names if "-" in name):
            if other in names and ending in STORED_ENDINGS:
                raise ValueError(f"{other}-{ending} is a file of {other!r} in results; give another name")
        for site in self.sites:
            records = self.records_at(site)
            if site.fitted and not records:
                raise ValueError(f"{site.key}: a fitted site needs a trace, or [[records]]")
            if (not records) == (site.depth_mm is None):
                remedy = "give either trace (a record; several: [[records]]) or depth_mm (to be simulated)"
                raise ValueError(f"{site.key}: {remedy}")
        stated: list[Site | RecordTable] = [*self.sites, *self.records]
        for one in stated:
            if one.indenter is not None and one.indenter not in self.indenters:
                known = ", ".join(self.indenters) or "none"
                what = f"{one.key}: no indenter is named {one.indenter!r}"
                raise ValueError(f"{what}; those of [indenters] are {known}")

    def _check_measurements(self) -> None:
        """Refuse what is measured where something else in the study rules it out."""
        taut, tense = self.material.prestretch, self.material.course
        states = {"clamps": self.clamps, "contraction": tense, "pre-stretch": taut}
        why = [name for name, stated in states.items() if stated]
        for one in self.recorded:
            kind = 'control = "force"' if one.forced else one.observed
            if self.calibration.objective == "paper" and kind:
                what = f'{one.name}: {kind} is no force, and objective = "paper" adds squares of forces'
                raise ValueError(f'{what}; use "pointwise"')
            if why and one.forced:
                what = f'{one.name} has control = "force", which goes without {why[0]}'
                raise ValueError(f"{what}; leave one out")
            if (taut and one.observed) or (tense and one.shear_waves):
                key, what = ("prestretch", "pre-stretch") if taut else ("activation", "contraction")
                seen = one.observed if taut else "shear waves"
                raise ValueError(f"material.{key}: {one.name} has {seen}, which sees no {what}; leave it out")

    def _check_material(self) -> None:
        layers = [layer.name for layer in self.geometry.model_layers]
        self.material.check_tissues(self.tissues, tuple(dict.fromkeys((*layers, *self.fibres))))
        known = [f"{tissue}.{name}" for tissue, name in self.parameters]
        tied = [name for group in self.calibration.tied for name in group]
        for name in (*self.calibration.fixed, *tied, *self.calibration.prior):
            if name not in known:
                raise ValueError(f"calibration: no parameter is named {name!r}; they are {', '.join(known)}")
        if bare := [name for name in tied if name in self.fixed]:
            raise ValueError(f"calibration.tied: the tissue of {bare[0]} has no fibres; leave it out")
        if self.calibration.priors is None:
            return
        if not laws.is_ogden(self.material.law):
            what = f'calibration.priors: people are described by the law "{laws.OGDEN}"'
            raise ValueError(f"{what}, the study has another; leave it out, or state calibration.prior")
        with tables.refuse_value("calibration.prior_tissues: "):
            of_tissues(self.tissues, self.calibration.prior_tissues)

    def _check_geometry(self) -> None:
        if self.geometry.regions and self.mesh.engine != "mmg":
            what = f'mesh.engine = "{self.mesh.engine}" cannot mesh geometry.regions'
            raise ValueError(f'{what}; choose "mmg", or leave the regions out')
        if (self.image is None) == (self.surfaces is None):
            raise ValueError("give either [image] or [surfaces]")
        if self.surfaces is not None:
            if any(layer.thickness for layer in self.geometry.layers):
                raise ValueError('a layer with thickness = "map" needs the fat of an [image], not [surfaces]')
            labelled = [one.name for one in self.geometry.regions if one.label is not None]
            if labelled:
                what = f"geometry.regions.{labelled[0]}: [surfaces] has no labels"
                raise ValueError(f"{what}; give surface, a closed surface file")
        blind = [site.name for site in self.sites if site.position is None]
        if blind and (self.image is None or self.image.markers is None):
            raise ValueError(f"site {blind[0]}: 'near' needs image.markers; without, give 'position'")
