"""The limb and its records: what the stages `segment`, `surfaces`, `sites`, `mesh` and `traces` store."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from .base import ResultPart, StoredResult, Vector


class MarkerImageMotion(ResultPart):
    """How the limb moved between the image and that with markers."""

    shift_mm: float = Field(description="Translation of the limb.")
    turn_deg: float = Field(description="Rotation of the limb.")
    correlation: float = Field(description="Correlation of the two images after the motion, 1 at most.")


class SegmentResult(StoredResult):
    """The label map of the image."""

    FILE: ClassVar = "segment/segment.json"

    method: str = Field(description="`automatic`, or `corrected by hand`.")
    volumes_cm3: Mapping[str, float] = Field(description="Volume of each label.")
    repairs: Sequence[str] = Field(description="What was repaired in a given label map, in words.")
    warnings: Sequence[str] = Field(description="What the image warns of, in words.")
    labels_sha256: str = Field(description="SHA-256 of the label map as the stage wrote it.")
    markers_removed: int | None = Field(default=None, description="Markers taken off the skin in this image.")
    motion: MarkerImageMotion | None = Field(default=None, description="Motion to the image with markers.")


class LabelMeasures(ResultPart):
    """Measures of a label."""

    volume_cm3: float = Field(description="Volume.")
    pieces: int = Field(description="Number of pieces whose voxels share faces.")
    largest_piece: float = Field(description="Share of the volume in the largest piece.")
    holes: int = Field(description="Number of closed holes.")
    holes_cm3: float = Field(description="Volume of the closed holes.")
    slices: tuple[int, int] = Field(description="First and last slice.")
    slices_without: int = Field(description="Slices in between without the label.")


class SuspectSlice(ResultPart):
    """A slice that does not fit its neighbours."""

    label: str = Field(description="Name of the label.")
    slice: int = Field(description="Number of the slice, from 0.")
    what: str = Field(description="What looks wrong there, in words.")


class QualityResult(StoredResult):
    """The quality of the label map."""

    FILE: ClassVar = "segment/quality.json"

    axis: str = Field(description="Axis of the image along the limb: `i`, `j` or `k`.")
    labels: Mapping[str, LabelMeasures] = Field(description="Measures of each label, and of the `limb`.")
    suspects: Sequence[SuspectSlice] = Field(description="Slices to look at.")


class SurfaceMeasures(ResultPart):
    """Measures of a surface."""

    faces: int = Field(description="Number of triangles.")
    volume_mm3: float = Field(description="Enclosed volume.")
    area_mm2: float = Field(description="Area.")


class SurfacesResult(StoredResult):
    """The surfaces of the limb."""

    FILE: ClassVar = "surfaces/surfaces.json"

    coordinates: str = Field(description="Axes of all places: `LPS`.")
    unit: str = Field(description="Unit of all lengths: `mm`.")
    cut_point: Vector = Field(description="A point of the proximal cut, in mm.")
    cut_normal: Vector = Field(description="Unit normal of the proximal cut.")
    skin: SurfaceMeasures = Field(description="Measures of the skin.")
    bones: Mapping[str, SurfaceMeasures] = Field(description="Measures of each bone.")
    regions: Mapping[str, SurfaceMeasures] = Field(description="Measures of each region inside the core.")
    notes: Sequence[str] = Field(description="What was repaired to close the surfaces, in words.")


class MarkerEvidence(ResultPart):
    """The marker that a site was matched to."""

    height_mm: float = Field(description="Height of the marker over the skin.")
    distance_to_hint_mm: float = Field(description="Distance from where the study says the site is.")


class PlacedSite(ResultPart):
    """Where a site is on the skin."""

    site: str = Field(description="Name of the site.")
    region: str | None = Field(description="Region of the limb, as the study states it.")
    fitted: bool = Field(description="Whether parameters are identified from its records.")
    position_mm: Vector = Field(description="Place on the skin, LPS.")
    axis: Vector = Field(description="Unit vector along which the indenter goes in.")
    off_skin_mm: float = Field(description="Distance from the given place to the skin.")
    marker: MarkerEvidence | None = Field(description="The site's marker; null where it has none.")


class SitesResult(StoredResult):
    """The sites, in the order of the study."""

    FILE: ClassVar = "sites/sites.json"

    sites: Sequence[PlacedSite] = Field(description="Each site.")


class LayerSettings(ResultPart):
    """A layer of tissue as it was asked for."""

    name: str = Field(description="Name of the tissue.")
    thickness_mm: float | None = Field(description="Thickness; null where it is that of the segmented fat.")
    min_thickness_mm: float = Field(description="Least thickness of a mapped layer.")


class MeshingSettings(ResultPart):
    """How the meshes were made; see the study's table `mesh`."""

    element: str = Field(description="Type of the cells.")
    edge_near_mm: float = Field(description="Edge length at the site.")
    edge_far_mm: float = Field(description="Edge length far from the site.")
    near_radius_mm: float = Field(description="Radius around the site with the edge length of the site.")
    growth: float = Field(description="Growth of the edge length with the distance.")
    layers: Sequence[LayerSettings] = Field(description="Layers from the skin inwards.")
    core: str = Field(description="Name of the tissue inside the layers.")
    bone_policy: str = Field(description="What gives way where bone and layers meet.")
    bone_clearance_mm: float = Field(description="Least distance of bone and layers.")
    time_limit_s: float = Field(description="Time limit of the mesher.")
    curved: bool = Field(description="Whether quadratic cells follow the surfaces.")
    flatness: float = Field(description="How much flatter cells may be far from the site.")
    engine: str = Field(description="Name of the mesher.")


class ThicknessMeasures(ResultPart):
    """Thickness of a layer in mm."""

    mean: float = Field(description="Mean, in mm.")
    std: float = Field(description="Standard deviation, in mm.")
    min: float = Field(description="Least, in mm.")
    max: float = Field(description="Greatest, in mm.")


class InterfaceError(ResultPart):
    """Distance of the meshed inner face of the layers from where it was asked for."""

    mean: float = Field(description="Mean, in mm.")
    max: float = Field(description="Greatest, in mm.")


class RegionError(ResultPart):
    """A region inside the core, and how far its meshed surface is from the given one."""

    enclosed_mm3: float = Field(description="Volume that the given surface encloses.")
    mean_mm: float = Field(description="Mean distance.")
    max_mm: float = Field(description="Greatest distance.")


class BoneLoss(ResultPart):
    """What was taken from a bone to keep it below the layers."""

    volume_mm3: float = Field(description="Volume.")
    depth_mm: float = Field(description="Greatest depth.")


class SkinLoss(ResultPart):
    """What was taken from the layers to keep them above the bones."""

    volume_mm3: float = Field(description="Volume.")
    thinnest_mm: float = Field(description="Least thickness that is left.")


class MeshMeasures(ResultPart):
    """A mesh of a site, or of the whole limb."""

    nodes: int = Field(description="Number of nodes.")
    cells: int = Field(description="Number of cells.")
    region_cells: Mapping[str, int] = Field(description="Number of cells of each tissue.")
    min_dihedral_deg: float = Field(description="Smallest dihedral angle.")
    dihedral_percentiles_deg: Mapping[str, float] = Field(description="Percentiles of the dihedral angles.")
    min_scaled_jacobian: float = Field(description="Smallest scaled Jacobian.")
    volume_mm3: float = Field(description="Volume.")
    region_volumes_mm3: Mapping[str, float] = Field(description="Volume of each tissue.")
    volume_error: float = Field(description="Relative error of the volume that the surfaces enclose.")
    layer_mean_mm: float = Field(description="Mean thickness of all layers together.")
    layer_std_mm: float = Field(description="Standard deviation of that thickness.")
    layer_thickness_mm: Mapping[str, ThicknessMeasures] = Field(description="Thickness of each layer.")
    interface_error_mm: InterfaceError = Field(description="Error of the inner face of the layers.")
    regions: Mapping[str, RegionError] = Field(description="Error of each region inside the core.")
    trimmed_bone: Mapping[str, BoneLoss] = Field(description="What was taken from each bone.")
    thinned_skin: SkinLoss | None = Field(description="What was taken from the layers; null: nothing.")
    seconds: float = Field(description="Time that meshing took, in s.")
    engine: str = Field(description="Name of the mesher.")
    warnings: Sequence[str] = Field(description="What is wrong with the mesh, in words.")
    repairs: Sequence[str] = Field(description="Inverted cells that were repaired, in words.")
    element: str = Field(description="Type of the cells.")


class MeshSet(ResultPart):
    """One mesh for each site."""

    settings: MeshingSettings = Field(description="How the meshes were made.")
    sites: Mapping[str, MeshMeasures] = Field(description="The mesh of each site.")


class MeshResult(MeshSet, StoredResult):
    """The meshes of the sites."""

    FILE: ClassVar = "mesh/mesh.json"

    coarse: MeshSet | None = Field(default=None, description="Coarse meshes, where the study has them.")


class RecordPhase(ResultPart):
    """What the indenter does for a time."""

    kind: str = Field(description="`approach`, `load`, `hold` or `unload`.")
    start_s: float = Field(description="Start, in the time of the record.")
    end_s: float = Field(description="End, in the time of the record.")
    start_mm: float = Field(description="Displacement from touch-down at the start.")
    end_mm: float = Field(description="Displacement from touch-down at the end.")
    rate_mm_s: float = Field(description="Mean speed; negative on the way out.")


class RecordRemark(ResultPart):
    """What reading a record warns of."""

    kind: str = Field(description="Kind of the warning.")
    what: str = Field(description="What is wrong, in words.")
    cause: str = Field(description="Likely cause.")
    remedy: str = Field(description="What can be done about it.")
    evidence: Mapping[str, float] = Field(description="Numbers that show it, by name with unit.")


class RecordFlag(RecordRemark):
    """A warning about records."""

    sites: Sequence[str] = Field(description="The records that it is about; none: all.")
    text: str = Field(description="The whole warning in a sentence.")
    found: str = Field(description="`in the record`, or `against the model`.")


class LayerRecord(ResultPart):
    """A tissue as ultrasound showed it under the indenter."""

    thickness_mm: float = Field(description="Thickness before touch-down.")
    compression_mm: float = Field(description="Largest compression.")
    before: int = Field(description="Readings before touch-down.")
    sd_mm: float = Field(description="Standard deviation of a reading.")
    compared: bool = Field(description="Whether it moves enough to be compared.")


class SurfaceRecord(ResultPart):
    """The skin around the indenter as cameras showed it."""

    points: int = Field(description="Number of points.")
    frames: int = Field(description="Number of frames in contact.")
    displacement_mm: float = Field(description="Largest displacement.")
    sd_mm: float = Field(description="Standard deviation of a reading.")
    compared: bool = Field(description="Whether it moves enough to be compared.")


class WaveRecord(ResultPart):
    """Shear waves at a place under the indenter."""

    name: str = Field(description="Name of the place: tissue and depth.")
    tissue: str = Field(description="Name of the tissue.")
    depth_mm: float | None = Field(description="Depth under the skin.")
    readings: int = Field(description="Number of readings.")
    from_m_s: float = Field(description="Lowest speed.")
    to_m_s: float = Field(description="Highest speed.")


class TraceFacts(ResultPart):
    """A record as it is used; times are those of the file where nothing else is said."""

    site: str = Field(description="Name of the site.")
    control: str = Field(description="What the device was told: `displacement` or `force`.")
    touch_down_s: float = Field(description="Time of touch-down.")
    touch_down_mm: float = Field(description="Displacement in the file at touch-down.")
    touch_down_uncertainty_mm: float = Field(description="Standard deviation of the touch-down.")
    peak_s: float = Field(description="Time of the largest force.")
    peak_force_N: float = Field(description="Largest force.")
    depth_mm: float = Field(description="Largest displacement from touch-down.")
    noise_N: float = Field(description="Standard deviation of the force's noise.")
    speed_load_mm_s: float = Field(description="Speed of loading.")
    speed_unload_mm_s: float | None = Field(description="Speed of unloading; null where it does not unload.")
    phases: Sequence[RecordPhase] = Field(description="The phases of the record.")
    phases_in_words: str = Field(description="The phases in words.")
    knots_s: Sequence[float] = Field(description="Times from touch-down of the simulated history.")
    knots_mm: Sequence[float] = Field(description="Displacement from touch-down at these times.")
    knots_N: Sequence[float] | None = Field(description="Force at these times, where it is stated.")
    remarks: Sequence[RecordRemark] = Field(description="What reading the record warns of.")
    layers: Mapping[str, LayerRecord] = Field(default={}, description="Tissues seen by ultrasound.")
    surface: SurfaceRecord | None = Field(default=None, description="The skin seen by cameras.")
    waves: Sequence[WaveRecord] = Field(default=(), description="Shear waves under the indenter.")


class TracesResult(StoredResult):
    """The records, regularised and counted from touch-down."""

    FILE: ClassVar = "traces/traces.json"

    sites: Mapping[str, TraceFacts] = Field(description="Each record, by its name.")


class RecordVerdict(ResultPart):
    """Whether a record that a rig has just written can be used."""

    file: str = Field(description="Path of the file below the folder that is watched.")
    record: str | None = Field(description="Name of the study's record; null: the study names no such file.")
    verdict: str = Field(description="`good`, `look` (it can be used, with doubts) or `bad` (make it again).")
    reasons: Sequence[str] = Field(description="Why it is not good, each with its remedy.")
    facts: TraceFacts | None = Field(description="The record as it would be used; null: it cannot be.")
