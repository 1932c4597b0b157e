"""The tables of ``study.toml``: their keys, types, defaults and limits; units are in the names."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field
from pydantic.functional_validators import AfterValidator, BeforeValidator, field_validator, model_validator
from pydantic_core import InitErrorDetails, ValidationError

from ..errors import InputError
from ..shapes import SHAPES, Size

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
BoneName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ().+_-]{0,39}$")]
TISSUE_NAME = r"^[A-Za-z][A-Za-z0-9_]{0,29}$"
RING_PINS = 14  # pins of the device of the source paper (section 2.1), the test pin among them
FREE_NEIGHBOURS = 1  # on either side of the test pin, off the skin, so that tissue can bulge
Angle = Annotated[float, Field(ge=-180.0, le=180.0)]


def _check_friction(value: Any) -> Any:
    """Refuse a value in one line, instead of one for each type that it might have."""
    number = isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value < math.inf
    if not number and value not in ("frictionless", "sticky"):
        raise ValueError(f'{value!r} is not "frictionless", "sticky" or a coefficient from 0 on')
    return value


def _check_length(vector: Vector) -> Vector:
    if not any(vector):
        raise ValueError("a direction of no length; give [x, y, z], not all zero")
    return vector


Direction = Annotated[Vector, AfterValidator(_check_length)]
Friction = Annotated[Literal["frictionless", "sticky"] | float, BeforeValidator(_check_friction)]


@contextmanager
def refuse_value(place: str = "") -> Iterator[None]:
    """Turn an `InputError` into the `ValueError` of which pydantic makes an error of the table."""
    try:
        yield
    except InputError as error:
        raise ValueError(f"{place}{error}") from None


class TomlTable(BaseModel):
    """A frozen table without unknown keys, numbers that are not finite, or contradictions."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        self.check_keys()
        return self

    def check_keys(self) -> None:
        """Raise `ValueError` where keys, each of the right type, contradict one another."""


class TomlFile(TomlTable):
    """The table of a whole ``file``: relative paths in it are from its folder, where its results lie too."""

    file: Path = Field(exclude=True)

    @property
    def folder(self) -> Path:
        """Where the file lies."""
        return self.file.parent

    @property
    def results(self) -> Path:
        """Where its results lie."""
        return self.folder / "results"

    def path(self, relative: Path) -> Path:
        """A path of the file as a path of this machine."""
        return self.folder / relative


def find_repeated(names: Iterable[str]) -> list[str]:
    """Return the names that are there more than once, in their order."""
    return [name for name, count in Counter(names).items() if count > 1]


class StudyTable(TomlTable):
    """The study's name; ``extensions`` are Python files that register laws and shapes of its own."""

    name: str
    description: str = ""
    extensions: tuple[Path, ...] = ()


class ImageTable(TomlTable):
    """The image: a DICOM folder, NIfTI, NRRD or MHA.

    ``markers`` is another one of the same limb with skin markers on, or ``"same"``: they are on in this one.
    """

    path: Path
    series: str | None = None
    markers: Literal["same"] | Path | None = None
    markers_series: str | None = None

    def check_keys(self) -> None:
        if self.markers_series is not None and self.marked is None:
            raise ValueError("markers_series belongs to a second image: give its folder as markers")

    @property
    def marked(self) -> Path | None:
        """The second image, with markers on."""
        return None if self.markers == "same" else self.markers


class SegmentationTable(TomlTable):
    """``labels``: a label map (``.seg.nrrd``, image, DICOM-SEG, RTSTRUCT); it wins over the automatic one.

    ``contours`` is a file of contours that does so; ``seeds`` are points (LPS mm) in each bone to be found.
    """

    labels: Path | None = None
    contours: Path | None = None
    contrast: Literal["auto", "T1", "UTE", "CT"] = "auto"
    seeds: dict[BoneName, tuple[Vector, ...]] = Field(default_factory=dict)
    bias_correction: bool = True
    min_bone_volume_mm3: Positive = 1000.0

    def check_keys(self) -> None:
        if self.labels is not None and self.contours is not None:
            raise ValueError("give either labels or contours")
        empty = [name for name, points in self.seeds.items() if not points]
        if empty:
            raise ValueError(f"seeds.{empty[0]}: give at least one point")

    @property
    def is_given(self) -> bool:
        """True if the study brings its own labels."""
        return self.labels is not None or self.contours is not None


class SurfacesTable(TomlTable):
    """Closed surfaces as the way in, instead of an image.

    ``coordinates`` is by default what the files say themselves, or LPS where they do not.
    """

    skin: Path
    bones: dict[BoneName, Path] = Field(default_factory=dict)
    coordinates: Literal["LPS", "RAS"] | None = None
    unit: Literal["mm", "cm", "m", "inch"] = "mm"


class MarkupsTable(TomlTable):
    """Control points of 3D Slicer (``.mrk.json``): ``position`` or ``near`` of the sites of their names."""

    file: Path
    gives: Literal["position", "near"] = "position"


class Plane(TomlTable):
    """A plane by a point and the normal that points proximally."""

    point: Vector
    normal: Direction = (0.0, 0.0, 1.0)


class Layer(TomlTable):
    """A layer of tissue under the skin's surface, of one thickness or as thick as the segmented fat says.

    With ``thickness = "map"`` its inner face is that of the image's fat, but at least ``min_thickness_mm``
    below its outer face.
    """

    name: str = Field(pattern=TISSUE_NAME)
    thickness_mm: Positive | None = None
    thickness: Literal["map"] | None = None
    min_thickness_mm: Positive = 1.0

    def check_keys(self) -> None:
        if (self.thickness_mm is None) == (self.thickness is None):
            raise ValueError('give either thickness_mm or thickness = "map"')
        if self.thickness is None and "min_thickness_mm" in self.model_fields_set:
            raise ValueError('min_thickness_mm belongs to thickness = "map"')


class RegionTable(TomlTable):
    """A body of its own inside the core, as a tendon or a scar: a label of the map, or a closed surface.

    A ``surface`` is in the coordinates and the unit of ``[surfaces]``; beside an image in LPS and mm, unless
    it says otherwise itself.
    """

    name: str = Field(pattern=TISSUE_NAME)
    label: str | None = None
    surface: Path | None = None

    def check_keys(self) -> None:
        if (self.label is None) == (self.surface is None):
            raise ValueError("give either label (of the label map) or surface (a file)")


class GeometryTable(TomlTable):
    """How surfaces become a model: one ``skin_layer_mm``, or ``layers`` (outermost first) over ``core``.

    ``regions`` are bodies inside the core; of two that overlap the first has what they share.
    """

    skin_layer_mm: Positive = 3.0
    layers: tuple[Layer, ...] = ()
    core: str = Field(default="muscle", pattern=TISSUE_NAME)
    regions: tuple[RegionTable, ...] = ()
    bone_policy: Literal["trim-bone", "thin-skin"] = "trim-bone"
    bone_clearance_mm: Positive = 1.5
    proximal_cut: Plane | None = None
    amputation: Plane | None = None
    amputation_pad_mm: Positive = 15.0
    surface_edge_mm: Positive = 3.0

    def check_keys(self) -> None:
        if "layers" in self.model_fields_set and not self.layers:
            raise ValueError("layers is empty; a model has one layer of tissue or more over its core")
        if self.layers and "skin_layer_mm" in self.model_fields_set:
            raise ValueError("give either skin_layer_mm or layers")
        if not self.layers and "core" in self.model_fields_set:
            raise ValueError("core belongs to layers; give layers too")
        names = [*(one.name for one in self.model_layers), *(one.name for one in self.regions), self.core]
        if len(set(names)) < len(names):
            raise ValueError(f"layers, core and regions need different names, not {', '.join(names)}")
        if sum(layer.thickness == "map" for layer in self.layers) > 1:
            raise ValueError('only one layer can have thickness = "map": that of the fat')

    @property
    def model_layers(self) -> tuple[Layer, ...]:
        """The layers, outermost first; the one of ``skin_layer_mm`` where none are given."""
        return self.layers or (Layer(name="skin", thickness_mm=self.skin_layer_mm),)


class IndenterTable(TomlTable):
    """The rigid indenter; the paper's is a square of 20 mm.  ``file`` is the surface of shape ``stl``.

    Other keys are measures of the shape.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float] = Field(init=False)

    shape: str = "square"
    file: Path | None = None
    width_mm: Positive = 20.0
    edge_radius_mm: Annotated[float, Field(ge=0)] = 0.0
    friction: Friction = "frictionless"

    @property
    def measures(self) -> dict[str, float]:
        """The shape's own numbers, by key."""
        return self.__pydantic_extra__

    @field_validator("shape")
    @classmethod
    def _check_shape(cls, name: str) -> str:
        with refuse_value():
            return SHAPES[name].name

    @model_validator(mode="before")
    @classmethod
    def _fill_measures(cls, content: Any) -> Any:
        """Fill in the measures that are left out; refuse a key that is none of the shape's."""
        name = content.get("shape", cls.model_fields["shape"].default) if isinstance(content, dict) else None
        if name not in SHAPES.names:
            return content
        usual = {measure.key: measure.value for measure in SHAPES[name].measures}
        unknown = [key for key in content if key not in usual and key not in cls.model_fields]
        if unknown:
            errors = [InitErrorDetails(type="extra_forbidden", loc=(key,), input=0) for key in unknown]
            raise ValidationError.from_exception_data(cls.__name__, errors)
        return usual | content

    def check_keys(self) -> None:
        shape = SHAPES[self.shape]
        if (self.file is not None) != shape.needs_file:
            those = " or ".join(f'"{one.name}"' for one in SHAPES if one.needs_file)
            raise ValueError(f"shape = {those} needs a file, and no other shape has one")
        if self.edge_radius_mm >= self.width_mm / 2:
            raise ValueError("edge_radius_mm must be smaller than half of width_mm")
        if self.file is None:
            with refuse_value():
                shape.of(Size(self.width_mm, self.edge_radius_mm, self.measures))


class TracesTable(TomlTable):
    """Column names of the records, where they differ from the defaults; units are in the names."""

    time_s: str = "time_s"
    displacement_mm: str = "displacement_mm"
    force_N: str = "force_N"
    smoothing: Annotated[float, Field(ge=0)] | None = None


class PriorTable(TomlTable):
    """The lognormal prior of a parameter; ``factor`` is one standard deviation either way."""

    median: Positive
    factor: Annotated[float, Field(gt=1)]


class CalibrationTable(TomlTable):
    """How the parameters are found; ``paper`` is equation 8, ``pointwise`` the force residuals.

    ``fixed``, ``tied`` and ``prior`` name parameters as ``skin.c_kPa``; ``starts`` after one are random.
    ``priors`` are those of people, where ``prior`` names none; ``prior_tissues`` says what tissue of people
    one of the model is.
    ``surface_error_mm``: how far skin and bone may be off; without it a share of the image's voxels.
    Parameters are searched on what of each mesh is within ``search_radius_mm`` of its site (0: on all of it),
    and on coarse meshes where the study has them (``mesh.coarse``); forces of the whole meshes correct that,
    at most ``corrections`` times per stage. The ``answer`` is that of the least squares, which predicts
    forces best, or what noise, misfit and the errors of meshes and sites make most probable; none stated:
    the first for one record of force per site, the second for more. With ``use_socket_pressures`` what
    ``socket.measured`` states counts beside the records; the socket is then simulated some times.
    """

    answer: Literal["least squares", "most probable"] | None = None
    objective: Literal["pointwise", "paper"] = "pointwise"
    stopping: Literal["relative", "paper"] = "relative"
    relative_tolerance: Positive = 0.01
    max_iterations: Annotated[int, Field(ge=1, le=200)] = 25
    fixed: tuple[str, ...] = ()
    tied: tuple[tuple[str, ...], ...] = ()
    prior: dict[str, PriorTable] = {}
    priors: Literal["population"] | None = None
    prior_tissues: dict[str, str] = {}
    force_error_percent: Positive = 1.0
    surface_error_mm: Positive | None = None
    starts: Annotated[int, Field(ge=1, le=1000)] = 1
    seed: Annotated[int, Field(ge=0)] = 0
    search_radius_mm: Annotated[float, Field(ge=0)] = 65.0
    use_socket_pressures: bool = False
    corrections: Annotated[int, Field(ge=1, le=10)] = 6
    correction_tolerance_percent: Positive = 0.1

    def check_keys(self) -> None:
        if self.answer == "most probable" and "paper" in (self.objective, self.stopping):
            raise ValueError('answer = "most probable" is not the paper\'s; leave objective and stopping out')
        names = [name for group in self.tied for name in group]
        doubled = [name for name in names if names.count(name) > 1 or name in self.fixed]
        if doubled:
            raise ValueError(f"{doubled[0]} is tied twice, or fixed too; name it once")
        for group in self.tied:
            if len(group) < 2 or len({name.rpartition(".")[2] for name in group}) > 1:
                raise ValueError(f"tied = {list(group)}: tie two or more parameters of one kind")
        if (self.prior or self.priors) and self.objective == "paper":
            raise ValueError('objective = "paper" has no place for priors; use "pointwise"')
        if self.use_socket_pressures and "paper" in (self.objective, self.stopping):
            raise ValueError("use_socket_pressures is not the paper's; leave objective and stopping out")
        if self.use_socket_pressures and self.answer == "least squares":
            raise ValueError("use_socket_pressures goes with the most probable answer; leave answer out")


class UncertaintyTable(TomlTable):
    """What ``limbfit uncertainty`` may spend, and how well geometry and contact are known (one deviation).

    ``runs`` are simulations of all fitted sites beyond those of the calibration; of the ``checked``
    narrowest profiles, and of the widest beside them, the ends are simulated. ``sources`` = false leaves
    geometry, contact and discretisation out.
    """

    runs: Annotated[int, Field(ge=4, le=1000)] = 24
    checked: Annotated[int, Field(ge=0, le=100)] = 2
    seed: Annotated[int, Field(ge=0)] = 0
    sources: bool = True
    layer_mm: Positive = 0.5
    position_mm: Positive = 2.0
    axis_degrees: Positive = 3.0
    edge_radius_mm: Annotated[float, Field(ge=0)] = 1.0


class SolverTable(TomlTable):
    """Steps over loading and unloading before the solver adapts them, and how hard the contact is.

    ``penalty_per_mm`` is the contact's stiffness over the mean instantaneous shear modulus of the tissues, as
    it stays; without it each site holds what a reference tissue needs there.

    ``solver`` is what ``limbfit simulate`` runs; identification and prediction are always limbfit's own.
    """

    solver: Literal["limbfit", "febio"] = Field(default="limbfit", exclude=True)  # of no stage, so of no key
    load_steps: Annotated[int, Field(ge=2, le=500)] = 8
    unload_steps: Annotated[int, Field(ge=2, le=500)] = 10
    penalty_per_mm: Positive | None = None


class FebioTable(TomlTable):
    """FEBio beside limbfit: where it is, what it may take; ``penalty`` is times its automatic one.

    Without ``penalty`` it is given an explicit one, as stiff as limbfit's contact.
    """

    program: Path | None = None
    threads: Annotated[int, Field(ge=1, le=256)] = 1
    time_limit_s: Positive = 3600.0
    penalty: Positive | None = None


class ExecutionTable(TomlTable):
    """Workers that simulate side by side, one thread each; 0 means one per core.

    What a simulation may take in a worker: wall time in s and memory in GB; 0 means no limit.
    """

    workers: Annotated[int, Field(ge=0, le=1024)] = 0
    time_limit_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3600.0
    memory_limit_GB: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0


class AcquireTable(TomlTable):
    """Speeds, forces, pauses, repeats and limits of the experiment; defaults are the paper's (section 2.1.2).

    What the paper does not state (approach, retraction, limits) is what suits a seated person's limb.
    """

    pin: Annotated[int, Field(ge=1, le=14)] = 1
    clamp_N: Annotated[float, Field(ge=1, le=25)] = 15.0
    clamp_tolerance_N: Positive = 1.0
    clamp_speed_mm_s: Positive = 5.0
    settle_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0
    approach_speed_mm_s: Positive = 2.0
    touch_N: Annotated[float, Field(ge=0.1, le=2)] = 0.2
    start_gap_mm: Annotated[float, Field(ge=0, le=5)] = 0.5
    search_speed_mm_s: Positive = 5.0
    search_force_N: Positive = 18.0
    search_depth_mm: Positive = 15.0
    min_depth_mm: Positive = 1.0
    pause_s: Annotated[float, Field(ge=0, le=600)] = 5.0
    precondition: Annotated[int, Field(ge=0, le=50)] = 0
    repeats: Annotated[int, Field(ge=1, le=50)] = 1
    ramp_speed_mm_s: Positive = 0.96
    hold_s: Annotated[float, Field(ge=0, le=599)] = 0.0
    retract_speed_mm_s: Annotated[float, Field(gt=0, le=100)] = 20.0
    force_limit_N: Annotated[float, Field(gt=0, le=45)] = 25.0
    clamp_limit_N: Annotated[float, Field(gt=0, le=45)] = 25.0
    depth_limit_mm: Annotated[float, Field(gt=0, le=50)] = 20.0
    speed_limit_mm_s: Annotated[float, Field(gt=0, le=12)] = 8.0
    time_limit_s: Annotated[float, Field(ge=1, le=600)] = 90.0
    operator_limit_s: Annotated[float, Field(ge=1, le=3600)] = 600.0
    watchdog_ms: Annotated[float, Field(ge=10, le=500)] = 20.0
    key_gap_ms: Annotated[float, Field(ge=30, le=1000)] = 120.0

    def check_keys(self) -> None:
        for name in ("clamp", "approach", "search", "ramp"):
            if getattr(self, f"{name}_speed_mm_s") > self.speed_limit_mm_s:
                raise ValueError(f"{name}_speed_mm_s is over speed_limit_mm_s")
        for low, high, why in (
            ("hold_s", "time_limit_s", ": the hold would end in a stop"),
            ("pause_s", "time_limit_s", ": the pause would end in a stop"),
            ("settle_s", "time_limit_s", ": the settling would end in a stop"),
            ("search_force_N", "force_limit_N", ": the search would end in a stop"),
            ("search_depth_mm", "depth_limit_mm", ": the search would end in a stop"),
            ("min_depth_mm", "search_depth_mm", ""),
            ("clamp_tolerance_N", "clamp_N", ""),
        ):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"{low} is not below {high}{why}")
        if self.clamp_N + self.clamp_tolerance_N >= self.clamp_limit_N:
            raise ValueError("clamp_N with its tolerance is not below clamp_limit_N: it would end in a stop")


class ClampsTable(TomlTable):
    """Square pins that press by ``force_N`` each before the indenter touches; none where there is no table.

    ``angles_degrees`` are around the limb from the test pin, by default those of the paper's eleven;
    ``levels_mm`` how far proximally of its plane, one for each angle or one for all.
    """

    force_N: Annotated[float, Field(gt=0, le=100)] = 15.0
    angles_degrees: tuple[Angle, ...] = ()
    levels_mm: tuple[float, ...] = (0.0,)
    width_mm: Annotated[float, Field(ge=5, le=60)] = 20.0
    clamping_s: Positive = 2.0
    settling_s: Positive = 5.0

    @field_validator("angles_degrees")
    @classmethod
    def _check_angles(cls, angles: tuple[float, ...]) -> tuple[float, ...]:
        if len({angle % 360.0 for angle in angles}) < len(angles):
            raise ValueError("two pins are at one angle; give each angle once")
        if 0.0 in angles:
            raise ValueError("0 is where the test pin is; leave it out")
        return angles

    def check_keys(self) -> None:
        if len(self.levels_mm) not in (1, len(self.angles)):
            what = f"levels_mm has {len(self.levels_mm)} levels for {len(self.angles)} pins"
            raise ValueError(f"{what}; give one, or one for each angle")

    @property
    def angles(self) -> tuple[float, ...]:
        """Degrees of each pin, those stated or the paper's."""
        usual = tuple(360.0 * k / RING_PINS for k in range(FREE_NEIGHBOURS + 1, RING_PINS - FREE_NEIGHBOURS))
        return self.angles_degrees or usual

    @property
    def lead_s(self) -> float:
        """When the indenter touches, after clamping began, s."""
        return self.clamping_s + self.settling_s
