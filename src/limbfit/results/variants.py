"""What force depends on: the experiments `sensitivity-*` and `cube`."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import Parameters, ResultPart, StoredResult


class VariedSite(ResultPart):
    """An indentation that is varied."""

    site: str = Field(description="Name of the record or site.")
    region: str | None = Field(description="Region of the limb.")
    role: str = Field(description="`thin` or `thick` tissue over bone; empty where the site was named.")
    tissue_mm: float = Field(description="Distance to the nearest bone.")
    indentation_mm: float = Field(description="Depth of the indentation.")


class VariantRun(ResultPart):
    """A simulation with one thing changed."""

    site: str = Field(description="Name of the record or site.")
    label: str = Field(description="What is changed, in words.")
    base: bool = Field(description="Whether nothing is changed.")
    peak_force_N: float | None = Field(description="Largest force; null where it did not come to its end.")
    peak_change_percent: float | None = Field(description="Change of it from the base.")
    mean_change_percent: float | None = Field(description="Mean change over the curve, of the largest force.")
    penetration_mm: float = Field(description="How deep the indenter is in the skin at most.")
    steps: int | None = Field(description="Number of steps.")
    newton_iterations: int | None = Field(description="Number of Newton's iterations.")
    cuts: int | None = Field(description="Number of steps that were halved.")
    completed: bool = Field(description="Whether the simulation came to its end.")
    reason: str = Field(description="Why it did not.")
    warnings: Sequence[str] = Field(description="What is doubtful, in words.")


class VariedResult(StoredResult):
    """Sites simulated with one thing changed."""

    sites: Sequence[VariedSite] = Field(description="Each varied site.")
    runs: Sequence[VariantRun] = Field(description="Each simulation.")
    parameters: Parameters = Field(description="The identified parameters.")


class StiffnessRun(VariantRun):
    """A simulation with other moduli of a tissue."""

    tissue: str | None = Field(description="The tissue; null for the base.")
    factor: float = Field(description="Factor of its moduli.")


class ForceDerivative(ResultPart):
    """How the largest force of a record depends on the moduli."""

    site: str = Field(description="Name of the record.")
    region: str | None = Field(description="Region of the limb.")
    tissue_mm: float = Field(description="Distance to the nearest bone.")
    completed: bool = Field(description="Whether the simulation came to its end.")
    peak_percent_per_percent: Mapping[str, float | None] = Field(description="Percent of force, by tissue.")


class StiffnessResult(VariedResult):
    """Force against the moduli of each tissue."""

    FILE: ClassVar = "sensitivity-c/sensitivity-c.json"
    COMMAND: ClassVar = "limbfit sensitivity --only c"

    runs: Sequence[StiffnessRun] = Field(description="Each simulation.")
    equal_m: float | None = Field(description="The exponent that all tissues share here; null: none.")
    factors: Sequence[float] = Field(description="Factors of the moduli.")
    local: Sequence[ForceDerivative] = Field(description="Derivatives at all records.")


class VolumeRun(VariantRun):
    """A simulation with another bulk modulus, and what became of volumes near the indenter."""

    kappa_ratio: float = Field(description="Bulk modulus over the shear modulus.")
    J_min: float | None = Field(description="Smallest ratio of volumes.")
    J_low: float | None = Field(description="Ratio that 1 % of the volume is below.")
    J_high: float | None = Field(description="Ratio that 1 % of the volume is above.")
    J_max: float | None = Field(description="Largest ratio of volumes.")
    beyond_percent: float | None = Field(description="Share of the volume that changes by more than 1 %.")


class VolumeResult(VariedResult):
    """Force and change of volume against the bulk modulus."""

    FILE: ClassVar = "sensitivity-kappa/sensitivity-kappa.json"
    COMMAND: ClassVar = "limbfit sensitivity --only kappa"

    runs: Sequence[VolumeRun] = Field(description="Each simulation.")
    kappa_ratio: float = Field(description="The study's bulk modulus over the shear modulus.")


class FrictionRun(VariantRun):
    """A simulation with another friction."""

    friction: float | str = Field(description="Coefficient of friction, `frictionless` or `sticky`.")


class FrictionResult(VariedResult):
    """Force against the friction of the indenter."""

    FILE: ClassVar = "sensitivity-contact/sensitivity-contact.json"
    COMMAND: ClassVar = "limbfit sensitivity --only contact"

    runs: Sequence[FrictionRun] = Field(description="Each simulation.")
    friction: float | str = Field(description="The study's friction.")


class IndenterRun(VariantRun):
    """A simulation with another indenter."""

    shape: str = Field(description="Shape of the indenter.")
    width_mm: float = Field(description="Its width.")
    edge_radius_mm: float = Field(description="Radius of its edge.")


class IndenterResult(VariedResult):
    """Force against the shape of the indenter."""

    FILE: ClassVar = "sensitivity-indenter/sensitivity-indenter.json"
    COMMAND: ClassVar = "limbfit sensitivity --only indenter"

    runs: Sequence[IndenterRun] = Field(description="Each simulation.")


class RefinedSite(VariedSite):
    """What the force of a site tends to; null where it does not tend to anything yet."""

    limit_N: float | None = Field(description="Largest force on an infinitely fine mesh.")
    order: float | None = Field(description="Order of convergence.")
    order_measured: bool | None = Field(description="Whether three meshes show that order.")
    error_percent: float | None = Field(description="Error of the study's mesh.")


class RefinementRun(VariantRun):
    """A simulation on another mesh."""

    factor: float = Field(description="Factor of the edge lengths.")
    edge_near_mm: float = Field(description="Edge length at the site.")
    element: str = Field(description="Type of the cells.")
    nodes: int = Field(description="Number of nodes.")
    cells: int = Field(description="Number of cells.")


class RefinementResult(VariedResult):
    """Force against the mesh."""

    FILE: ClassVar = "sensitivity-mesh/sensitivity-mesh.json"
    COMMAND: ClassVar = "limbfit sensitivity --only mesh"

    sites: Sequence[RefinedSite] = Field(description="Each varied site.")
    runs: Sequence[RefinementRun] = Field(description="Each simulation.")


class CubeTissue(ResultPart):
    """A tissue compressed as a cube."""

    tissue: str = Field(description="Name of the tissue.")
    kind: str = Field(description="`skin` or `muscle`.")
    shear_modulus_kPa: float = Field(description="Long-term shear modulus.")
    instantaneous_modulus_kPa: float = Field(description="Instantaneous shear modulus.")
    bulk_modulus_kPa: float = Field(description="Bulk modulus.")
    prony: Sequence[tuple[float, float]] = Field(description="Amplitude and time (s) of each relaxation.")
    law: str = Field(description="The law, in words.")
    terms: Sequence[tuple[float, float]] = Field(description="Modulus (kPa) and exponent of each term.")
    values: str = Field(description="The parameters as printed.")
    conversion: str = Field(description="What was done to them, in words.")
    source: str = Field(description="The citation, or `this study`.")
    peak_kPa: float = Field(description="Largest stress.")
    back_kPa: float = Field(description="Stress when the cube is back at its height.")
    end_kPa: float = Field(description="Stress at the end.")
    J_min: float = Field(description="Smallest ratio of volumes.")
    J_max: float = Field(description="Largest ratio of volumes.")


class CubeResult(StoredResult):
    """Tissues compared by their stress in compression."""

    FILE: ClassVar = "cube/cube.json"
    COMMAND: ClassVar = "limbfit cube"

    side_mm: float = Field(description="Side of the cube.")
    compression_percent: float = Field(description="Compression, of the side.")
    ramp_s: float = Field(description="Duration of each ramp.")
    hold_s: float = Field(description="Duration of the hold.")
    element: str = Field(description="Type of the cell.")
    tissues: Sequence[CubeTissue] = Field(description="Each tissue.")
    time_s: Sequence[float] = Field(description="Times.")
    stress_kPa: Mapping[str, Sequence[float]] = Field(description="Stress of each tissue at these times.")
