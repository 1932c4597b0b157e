"""The limb in its socket: the stage `sensors`, and the experiments `socket` and `socket_design`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Interval, Parameters, ResultPart, StoredResult, Vector
from .identification import OutsideRecords, QuantityRange
from .limb import MeshMeasures
from .shapes import ShopPackage


class LoadedRegion(ResultPart):
    """Pressure and shear over a region of the skin."""

    region: str = Field(description="Name of the region.")
    mean_kPa: float = Field(description="Mean pressure: normal force over area.")
    peak_kPa: float = Field(description="Largest mean pressure over a face.")
    shear_kPa: float = Field(description="Mean shear.")
    shear_peak_kPa: float = Field(description="Largest mean shear over a face.")
    interval_kPa: Interval | None = Field(description="95 % interval of the mean pressure.")
    interval_from: Mapping[str, float] | None = Field(
        description="Percent of its squared width that each parameter, or `relaxation`, is the cause of."
    )
    change_kPa: Mapping[str, float] | None = Field(description="Change of the mean, a parameter 10 % larger.")
    relaxation_kPa: tuple[float, float, float] | None = Field(
        description="By relaxation beyond the records: shift, standard deviation, largest fall."
    )
    missed_kPa: Interval | None = Field(
        default=None, description="Mean and standard deviation of what the derivatives miss of the samples."
    )


class TissueStrainInside(ResultPart):
    """Strain of a tissue inside the socket."""

    tissue: str = Field(description="Name of the tissue.")
    volume_mm3: float = Field(description="Volume at rest.")
    shear: float = Field(description="Largest shear strain of a cell.")
    shear_rare: float = Field(description="Shear strain that 1 % of the volume exceeds.")
    compression: float = Field(description="Largest compressive strain of a cell.")
    compression_rare: float = Field(description="Compressive strain that 1 % of the volume exceeds.")
    energy_kPa: float = Field(description="Largest energy density of a cell.")
    sheared_mm3: Mapping[str, float] = Field(description="Volume sheared by more than each level.")
    place_mm: Vector = Field(description="Place of the largest shear at rest, LPS.")
    near: str | None = Field(description="Region of the skin nearest to that.")


class SocketState(ResultPart):
    """The limb at a time in the socket."""

    time_s: float = Field(description="Time from the first touch.")
    contact_area_mm2: float = Field(description="Area in contact.")
    peak_kPa: float = Field(description="Largest pressure.")
    mean_kPa: float = Field(description="Mean pressure.")
    shear_peak_kPa: float = Field(description="Largest shear.")
    regions: Sequence[LoadedRegion] = Field(description="Each region.")
    inside: Sequence[TissueStrainInside] = Field(description="Strain of each tissue.")
    loading: Sequence[QuantityRange] | None = Field(default=None, description="What it does to the tissue.")
    outside_records: Sequence[OutsideRecords] | None = Field(
        default=None, description="What of it no fitted record did."
    )


class SocketLoad(SocketState):
    """The limb under a load."""

    name: str = Field(description="Name of the load.")
    force_N: Vector = Field(description="Force on the socket, LPS.")
    moment_Nmm: Vector = Field(description="Moment on the socket, LPS.")
    settling_mm: float = Field(description="How far the limb goes into the socket.")
    settling_interval_mm: Interval | None = Field(description="95 % interval of the settling.")
    settling_interval_from: Mapping[str, float] | None = Field(
        description="Percent of its squared width that each parameter, or `relaxation`, is the cause of."
    )
    settling_change_mm: Mapping[str, float] | None = Field(
        description="Change of the settling where a parameter is 10 % larger."
    )
    settling_relaxation_mm: tuple[float, float, float] | None = Field(
        description="By relaxation beyond the records: shift, standard deviation, largest fall."
    )
    settling_missed_mm: Interval | None = Field(
        default=None, description="Mean and standard deviation of what the derivatives miss of the samples."
    )


class SocketStepRow(ResultPart):
    """A step of the simulation."""

    time_s: float = Field(description="Time from the first touch.")
    force_N: Vector = Field(description="Force on the socket, LPS.")
    moment_Nmm: Vector = Field(description="Moment on the socket, LPS.")
    move_mm: Vector = Field(description="Move of the socket anteriorly, sideways and proximally.")
    turn_deg: Vector = Field(description="Rotation of the socket about these axes.")
    contact_area_mm2: float = Field(description="Area in contact.")
    peak_kPa: float = Field(description="Largest pressure.")
    mean_kPa: float = Field(description="Mean pressure.")
    imbalance_percent: float = Field(description="Force that is not balanced, of the load.")


class SolverStatistics(ResultPart):
    """What the solver did."""

    steps: int = Field(description="Number of steps.")
    cuts: int = Field(description="Number of steps that were halved.")
    newton_iterations: int = Field(description="Number of Newton's iterations.")
    unknowns: int = Field(description="Number of unknowns.")


class SocketSimulation(ResultPart):
    """A socket put on the limb and loaded."""

    seconds: float = Field(description="Time that the simulation took, in s.")
    penetration_mm: float = Field(description="How deep the socket is in the skin at most.")
    balance_percent: float = Field(description="Largest force that is not balanced, of the load.")
    friction: float | str = Field(description="Coefficient of friction, `frictionless` or `sticky`.")
    donning: SocketState = Field(description="The limb after donning.")
    loads: Sequence[SocketLoad] = Field(description="The limb under each load.")
    steps: Sequence[SocketStepRow] = Field(description="Each step.")
    warnings: Sequence[str] = Field(description="What is doubtful, in words.")
    statistics: SolverStatistics = Field(description="What the solver did.")

    @property
    def states(self) -> dict[str, SocketState]:
        """Donning and each load, by their names."""
        return {"donning": self.donning, **{load.name: load for load in self.loads}}


class LinerFacts(ResultPart):
    """The liner."""

    thickness_mm: float = Field(description="Thickness; 0: none.")
    material: str = Field(description="Its material.")
    c_kPa: float = Field(description="Its modulus.")
    m: float = Field(description="Its exponent.")
    gamma: float = Field(description="Its relaxation amplitude.")
    tau_s: float = Field(description="Its relaxation time.")


class SocketShape(ResultPart):
    """The shape of the socket."""

    source: str = Field(description="`rectified`, or the name of its file.")
    reduction_percent: float | None = Field(description="Reduction of every circumference; null for a file.")
    areas: Sequence[str] = Field(description="Names of the rectified areas.")
    volume_cm3: float = Field(description="Volume inside.")
    deepest_mm: float = Field(description="How far it is inside the limb's surface at most.")
    notes: Sequence[str] = Field(description="What was done to its file, in words.")
    liner: LinerFacts = Field(description="The liner.")


class PublishedFindings(ResultPart):
    """What others found over some regions."""

    regions: Sequence[str] = Field(description="Names of the regions.")
    found: str = Field(description="What was found.")
    method: str = Field(description="How.")
    source: str = Field(description="The citation.")


class SocketSamples(ResultPart):
    """Draws of the parameters that were simulated too."""

    simulated: int = Field(description="Number of draws that came to their end.")
    failed: Sequence[str] = Field(description="Why others did not.")


class PlacedCell(ResultPart):
    """A cell of a sensor in the socket, and what it read."""

    cell: str = Field(description="Its name; of a sheet, row and column.")
    state: str = Field(description="`compared`, or why it is not, such as `dead` or `saturated`.")
    position_mm: Vector = Field(description="Its place on the donned socket, LPS.")
    area_mm2: float = Field(description="Its area.")
    measured_kPa: float | None = Field(description="Mean of its readings; null: it has none.")


class SensorRecord(ResultPart):
    """A recording of sensors in the socket."""

    name: str = Field(description="Name of the recording.")
    load: str = Field(description="The load that it belongs to.")
    stretch_percent: float | None = Field(description="How a sheet stretches over the face; null: no sheet.")


class PlacedSensor(SensorRecord):
    """A recording of sensors whose cells are placed on the socket."""

    error_kPa: float = Field(description="What 95 % of readings are within, beside the percentage.")
    error_percent: float = Field(description="The part of a reading that 95 % of readings are within.")
    cells: Sequence[PlacedCell] = Field(description="Each cell.")

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of cells in each state."""
        return Counter(cell.state for cell in self.cells)

    @property
    def words(self) -> str:
        """How many cells are in each state, and how far a sheet stretches."""
        words = ", ".join(f"{count} {state}" for state, count in sorted(self.counts.items()))
        return f"{words}; stretched by {self.stretch_percent:.1f} %" if self.stretch_percent else words


class SensorsResult(StoredResult):
    """Sensors in the socket whose pressures count in the calibration, and the limb's mesh in it."""

    FILE: ClassVar = "sensors/sensors.json"

    edge_mm: float = Field(description="Edge length of the limb's mesh under the socket.")
    mesh: MeshMeasures = Field(description="The mesh of the whole limb.")
    sensors: Sequence[PlacedSensor] = Field(description="Each recording.")


class MeasuredCell(PlacedCell):
    """What a cell of a sensor read, and what the model has there."""

    regions: Sequence[str] = Field(description="Regions of the limb that it lies on, the smallest first.")
    level_mm: float = Field(description="Its distance from the limb's distal end, along the limb.")
    angle_deg: float = Field(description="Its direction about the limb.")
    error_kPa: float = Field(description="What 95 % of readings are within.")
    model_kPa: float = Field(description="Mean pressure of the model over its area.")
    interval_kPa: Interval | None = Field(description="95 % interval of that; null: not known.")


class SensorComparison(SensorRecord):
    """A recording of sensors beside the model."""

    counts: Mapping[str, int] = Field(description="Number of cells in each state.")
    cells: Sequence[MeasuredCell] = Field(description="Each cell.")


class PressureAgreement(ResultPart):
    """How the model agrees with the cells that are compared, under a load."""

    load: str = Field(description="Name of the load.")
    region: str = Field(description="Region of the limb, or `all`.")
    cells: int = Field(description="Number of cells.")
    measured_kPa: float = Field(description="Mean of the measured pressures.")
    model_kPa: float = Field(description="Mean of the model's.")
    bias_kPa: float = Field(description="Mean of model minus measured.")
    limits_kPa: Interval | None = Field(description="95 % of differences lie between; null: of one cell.")
    within_percent: float = Field(description="Cells within the sensor's error and the model's interval.")


class SocketResult(SocketSimulation, StoredResult):
    """The study's socket on the limb."""

    FILE: ClassVar = "socket/socket.json"
    COMMAND: ClassVar = "limbfit socket"

    parameters: Parameters = Field(description="The parameters of the tissues.")
    parameters_from: str = Field(description="Where these are from.")
    socket: SocketShape = Field(description="The shape of the socket.")
    mesh: MeshMeasures = Field(description="The mesh of the whole limb.")
    published: Sequence[PublishedFindings] = Field(description="What others found there.")
    samples: SocketSamples | None = Field(description="Draws that were simulated too; null: none.")
    worn_s: float | None = Field(description="How long the socket has been worn in the intervals.")
    outside_text: Sequence[str] = Field(description="What it does that no fitted record did.")
    sensors: Sequence[SensorComparison] = Field(default=(), description="Measured pressures beside it.")
    agreement: Sequence[PressureAgreement] = Field(default=(), description="How they agree, by region.")


class TargetPressure(ResultPart):
    """The pressure that a socket is designed for."""

    pressure: str = Field(description="How it is distributed.")
    pressure_kPa: float = Field(description="The pressure.")
    regions: Mapping[str, float] = Field(description="The pressure over regions, in kPa.")


class SocketDesigned(ResultPart):
    """A design on the limb."""

    name: str = Field(description="Name of the design.")
    volume_cm3: float = Field(description="Volume inside.")
    offset_mm: Interval = Field(description="Least and greatest distance of its face from the limb.")
    peaks_kPa: Mapping[str, float] = Field(description="Largest pressure of each region over all loads.")
    depths_mm: Mapping[str, float] = Field(default={}, description="Depth of its face over regions.")
    reduction_percent: float | None = Field(default=None, description="Reduction of every circumference.")
    simulation: SocketSimulation = Field(description="What happens on the limb.")


class RegionGain(ResultPart):
    """What the optimisation changes at a region."""

    region: str = Field(description="Name of the region.")
    control_kPa: float = Field(description="Largest pressure with the control.")
    design_kPa: float = Field(description="Largest pressure with the design.")
    optimised_kPa: float = Field(description="Largest pressure with the optimised design.")
    change_percent: float | None = Field(description="Change from the control; null: that does not touch.")


class DesignTrial(ResultPart):
    """A trial of the optimisation."""

    depths_mm: Mapping[str, float] = Field(description="Depth over each region.")
    peaks_kPa: Mapping[str, float] | None = Field(description="Largest pressure of each; null: it failed.")
    merit: float | None = Field(description="What is lowered; null where it failed.")
    reason: str = Field(description="Why it failed.")


class SocketOptimisation(ResultPart):
    """The search for a design with lower pressures."""

    regions: Sequence[str] = Field(description="Regions whose pressure is to be lowered.")
    gains: Sequence[RegionGain] = Field(description="What it changes at each.")
    limits_kPa: Mapping[str, float] = Field(description="Largest pressure that a region may bear.")
    beyond_limits: Sequence[str] = Field(description="Regions that bear more.")
    simulations: int = Field(description="Number of simulations that were allowed.")
    trials: Sequence[DesignTrial] = Field(description="Each trial.")


class SocketWall(ResultPart):
    """The wall of the socket for printing."""

    of: str = Field(description="Name of the design.")
    stated_mm: float = Field(description="Thickness that was asked for.")
    least_mm: float = Field(description="Least thickness.")
    median_mm: float = Field(description="Median thickness.")
    volume_cm3: float = Field(description="Volume of the wall.")


class SocketDesignResult(StoredResult):
    """Designs for a target pressure."""

    FILE: ClassVar = "socket_design/socket_design.json"
    COMMAND: ClassVar = "limbfit socket design"

    target: TargetPressure = Field(description="The target pressure.")
    designs: Sequence[SocketDesigned] = Field(description="Each design.")
    optimisation: SocketOptimisation | None = Field(description="The search for lower pressures; null: none.")
    wall: SocketWall = Field(description="The wall of the last design.")
    shop: ShopPackage | None = Field(default=None, description="Its package for the shop.")
    parameters: Parameters = Field(description="The parameters of the tissues.")
    parameters_from: str = Field(description="Where these are from.")
    liner: LinerFacts = Field(description="The liner.")
    balance_percent: float = Field(description="Largest force that is not balanced, of the load.")
    mesh: MeshMeasures = Field(description="The mesh of the whole limb.")
