"""``population.toml``: whose limbs, which tissues, weights, liners and sockets, how many people."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ..errors import StudyError, add_location
from ..study.loading import check_content, read_toml
from ..study.socket import NAME
from ..study.tables import ExecutionTable, Positive, TomlFile, TomlTable, find_repeated

FILE = "population.toml"
Factor = Annotated[float, Field(ge=1, le=5)]
Key = Annotated[str, Field(pattern=r"^(reduction_percent|[A-Za-z0-9 ().,_-]+ depth_mm)$")]
OWN_KEYS = {"body_weight_N", "liner", "file"}  # of [socket]: the first two are drawn for each person


class PopulationTable(TomlTable):
    """How many people there are, and the seed that they are drawn with."""

    name: str = Field(default="trial", pattern=NAME)
    people: Annotated[int, Field(ge=2, le=100_000)] = 50
    seed: Annotated[int, Field(ge=0)] = 0


class ShapesTable(TomlTable):
    """Whose limbs: of the phantom, of a shape model with its first ``modes``, or those of a folder.

    ``folder`` has a file, or a folder of bodies, for each limb.
    """

    phantom: Literal["transtibial", "transfemoral"] | None = None
    model: Path | None = None
    modes: Annotated[int, Field(ge=1, le=200)] | None = None
    folder: Path | None = None
    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    least_tissue_mm: Annotated[float, Field(ge=0, le=20)] = 1.0

    def check_keys(self) -> None:
        if (self.phantom is not None) + (self.model is not None) + (self.folder is not None) != 1:
            raise ValueError("give one of phantom, model and folder")
        if self.modes is not None and self.model is None:
            raise ValueError("modes belongs to model")


class TissuesTable(TomlTable):
    """Tissues of people, or of the identified ``study``: as its parameters are known."""

    study: Path | None = None


class WeightTable(TomlTable):
    """Body weight: lognormal; the factor is one standard deviation either way."""

    median_N: Annotated[float, Field(ge=50, le=3000)] = 800.0
    factor: Factor = 1.2


class DrawnLinerTable(TomlTable):
    """The liner: one thickness, or uniform between two; other keys are those of ``[socket.liner]``."""

    thickness_mm: Annotated[float, Field(ge=0, le=20)] | tuple[float, float] = 6.0
    material: Literal["silicone", "gel"] = "silicone"

    def check_keys(self) -> None:
        stated = self.thickness_mm
        if isinstance(stated, tuple) and not 0 <= stated[0] < stated[1] <= 20:
            raise ValueError("thickness_mm: give two thicknesses from 0 to 20, the smaller one first")


class RuleTable(TomlTable):
    """One way of making a socket: keys of ``[socket]`` by which it differs from the trial's."""

    name: str = Field(pattern=NAME)
    socket: dict[str, Any] = Field(default_factory=dict)


class LimitTable(TomlTable):
    """A pressure that people should stay below, in a region (the limb) under a load (any)."""

    kPa: Positive
    quantity: Literal["peak_kPa", "mean_kPa", "shear_kPa"] = "peak_kPa"
    region: str = "the limb"
    load: str | None = None

    @property
    def words(self) -> str:
        """The limit in words."""
        what = self.quantity.removesuffix("_kPa")
        return f"{what} over {self.kPa:g} kPa, {self.region}, {self.load or 'any load'}"


class RobustTable(TomlTable):
    """What a robust rule may change of the first rule: ``reduction_percent``, or ``<area> depth_mm``."""

    ranges: dict[Key, tuple[float, float]] = Field(min_length=1)

    def check_keys(self) -> None:
        if any(low >= high for low, high in self.ranges.values()):
            raise ValueError("ranges: give two numbers for each key, the smaller one first")


class Trial(TomlFile):
    """A checked ``population.toml``."""

    population: PopulationTable = PopulationTable()
    shapes: ShapesTable
    tissues: TissuesTable = TissuesTable()
    weight: WeightTable = WeightTable()
    liner: DrawnLinerTable = DrawnLinerTable()
    rules: tuple[RuleTable, ...] = (RuleTable(name="3 percent"),)
    limits: tuple[LimitTable, ...] = ()
    robust: RobustTable | None = None
    execution: ExecutionTable = ExecutionTable()
    person: dict[str, dict[str, Any]] = Field(default_factory=dict)

    def check_keys(self) -> None:
        if not self.rules:
            raise ValueError("rules is empty; give one way of making a socket or more")
        if doubled := find_repeated(rule.name for rule in self.rules):
            raise ValueError(f"rules: names must differ; given twice: {doubled[0]}")
        sockets = [(rule.name, rule.socket) for rule in self.rules]
        for place, table in (("person.socket", self.person.get("socket", {})), *sockets):
            if own := sorted(OWN_KEYS.intersection(table)):
                what = f"{place}: {own[0]} is not for a rule"
                raise ValueError(f"{what}: weight and liner have tables of their own")
        if own := sorted({"study", "surfaces", "image", "sites", "execution"}.intersection(self.person)):
            raise ValueError(f"person: the table {own[0]} is written for each person; leave it out")


def load_trial(path: str | Path) -> Trial:
    """Read and check a trial; ``path`` is its file or folder.

    Raises `StudyError` with the file, the key and the remedy.
    """
    file = Path(path)
    file = file / FILE if file.is_dir() else file
    if not file.is_file():
        raise StudyError("no such trial", file=file, remedy="limbfit population init makes one")
    content = read_toml(file)
    with add_location(file=file):
        trial = check_content(Trial, content, "docs/population.md", file=str(file.absolute()))
        for key, named in (("model", trial.shapes.model), ("folder", trial.shapes.folder)):
            if named is not None and not trial.path(named).exists():
                raise StudyError(f"{named} does not exist", place=f"shapes.{key}")
    return trial
