"""What a site mesh is like: counts, angles, layers, volumes, and what was trimmed."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import igl
import numpy as np

from ...arrays import Array, Indices
from ...mesh import Mesh, MeshQuality, compute_dihedral_angles, measure_quality
from ...results.limb import BoneLoss, InterfaceError, MeshMeasures, RegionError, ThicknessMeasures
from ..surfaces.surfaces import Anatomy
from ..surfaces.triangles import Surface, cross_edges
from .extrusion import find_bone_faces, find_inner_faces
from .layers import LimbFields
from .regions import build_region_level, find_interfaces

# Smallest angle near the indenter, and anywhere: far off, layers are thin beside the edges and strain little.
GOOD_DIHEDRAL_DEG, SOUND_DIHEDRAL_DEG = 8.0, 3.0
LOST_MM = 4.0  # bone that the mesh misses by more than that on a tenth of its surface is lost in part
TRIMMED_MM = 0.5  # from the bone as trimmed
SEEN_RADII = 1.5  # of the zone whose elements have to be good: bone that bears an indentation
GOOD_VOLUME = 0.02  # long edges far from the indenter cut across a round limb by up to a hundredth


def measure_mesh(
    mesh: Mesh,
    fields: LimbFields,
    trimmed: Mapping[str, BoneLoss],
    enclosed_mm3: float,
    regions_mm3: Mapping[str, float],
    near: tuple[Array, float] | None = None,
    **stated: Any,
) -> MeshMeasures:
    """Measure a mesh in the limb frame: what is stored of it.

    The thickness of all layers together is measured from points all over their meshed inner face to the
    meshed skin.

    Parameters
    ----------
    enclosed_mm3, regions_mm3 : volume that the mesh, and each region inside its core, should have.
    near : the place (3,) and radius (mm) within which elements have to be good.
    stated : what the mesh does not tell: ``seconds``, ``engine``, ``element``, ``repairs``.
    """
    quality = measure_quality(mesh)
    volume_error = quality.volume_mm3 / enclosed_mm3 - 1.0
    layers = len(fields.depths)
    faces = [
        _split_into_facets(mesh.face_sets["skin"]),
        *(_split_into_facets(find_inner_faces(mesh, i)) for i in range(layers)),
    ]
    whole = _measure_thickness(mesh, faces[-1], faces[0])
    between = [_measure_thickness(mesh, inner, outer) for outer, inner in pairwise(faces)]
    each = {
        name: ThicknessMeasures(mean=mm.mean(), std=mm.std(), min=mm.min(), max=mm.max())
        for name, mm in zip(mesh.region_names, between)
    }
    error = np.abs(fields.layer(mesh.points[faces[-1]].mean(axis=1))[0])
    return MeshMeasures(
        nodes=len(mesh.points),
        cells=len(mesh.cells),
        region_cells={name: int((mesh.regions == i).sum()) for i, name in enumerate(mesh.region_names)},
        min_dihedral_deg=quality.min_dihedral_deg,
        dihedral_percentiles_deg=quality.dihedral_percentiles_deg,
        min_scaled_jacobian=quality.min_scaled_jacobian,
        volume_mm3=quality.volume_mm3,
        region_volumes_mm3=quality.region_volumes_mm3,
        volume_error=volume_error,
        layer_mean_mm=whole.mean(),
        layer_std_mm=whole.std(),
        layer_thickness_mm=each,
        interface_error_mm=InterfaceError(mean=error.mean(), max=error.max()),
        regions=_measure_regions(mesh, fields, regions_mm3),
        trimmed_bone=trimmed,
        thinned_skin=fields.thinned,
        warnings=check_quality(mesh, quality, volume_error, near) + warn_of_lost_bone(mesh, fields, near),
        **stated,
    )


def _measure_regions(
    mesh: Mesh, fields: LimbFields, regions_mm3: Mapping[str, float]
) -> dict[str, RegionError]:
    found = {}
    for number, faces in enumerate(find_interfaces(mesh, len(fields.depths))):
        error = np.abs(build_region_level(fields, number)(mesh.points[faces[:, :3]].mean(axis=1))[0])
        name = mesh.region_names[len(fields.depths) + number]
        found[name] = RegionError(
            enclosed_mm3=regions_mm3[name],
            mean_mm=error.mean() if len(error) else 0.0,
            max_mm=error.max(initial=0.0),
        )
    return found


def check_quality(
    mesh: Mesh, quality: MeshQuality, volume_error: float, near: tuple[Array, float] | None = None
) -> tuple[str, ...]:
    """What is wrong with a mesh of this quality for its purpose; ``near`` is as for `measure_mesh`."""
    warnings = []
    smallest, least, where = quality.min_dihedral_deg, SOUND_DIHEDRAL_DEG, ""
    if near is not None and smallest >= SOUND_DIHEDRAL_DEG:
        place, radius = near
        inside = np.linalg.norm(mesh.points[mesh.corners].mean(axis=1) - place, axis=1) < radius
        angles = compute_dihedral_angles(mesh.points, mesh.corners[inside])
        smallest, least = float(angles.min(initial=180.0)), GOOD_DIHEDRAL_DEG
        where = f" within {radius:g} mm of the site"
    if smallest < least:
        warnings.append(f"smallest dihedral angle{where} {smallest:.1f} degrees; choose smaller edges")
    if abs(volume_error) > GOOD_VOLUME:
        warnings.append(
            f"volume differs by {100 * volume_error:.1f} % from the surfaces'; choose smaller edges"
        )
    return tuple(warnings)


def warn_of_lost_bone(mesh: Mesh, fields: LimbFields, near: tuple[Array, float] | None) -> tuple[str, ...]:
    """Which bones about a site a mesh in the limb frame lacks in part; ``near``: the place (3,) and radius
    (mm) within which elements have to be good, None for all of the limb."""
    faces = find_bone_faces(mesh)[:, :3]
    warnings = []
    for name, bone in fields.bones.items():
        places = bone.points[bone.points[:, 2] < -LOST_MM]
        if near is not None:
            place, radius = near
            places = places[np.linalg.norm(places - place, axis=1) < SEEN_RADII * radius]
        places = places[np.abs(fields.void(places)[0]) < TRIMMED_MM]  # what was not left out on purpose
        if not len(places):
            continue
        squared = igl.point_mesh_squared_distance(places, mesh.points, faces)[0] if len(faces) else np.inf
        off = float(np.quantile(np.sqrt(squared), 0.9))
        if off > LOST_MM:
            warnings.append(
                f"the mesh loses part of the {name}: a tenth of its surface is off by {off:.0f} mm or more; "
                "choose a smaller mesh.edge_far_mm"
            )
    return tuple(warnings)


def _measure_thickness(mesh: Mesh, inner: Indices, outer: Indices) -> Array:
    """Distance (n,) from the middles of inner facets to the surface of outer ones, mm."""
    squared = igl.point_mesh_squared_distance(mesh.points[inner].mean(axis=1), mesh.points, outer)[0]
    return np.asarray(np.sqrt(squared))


def _split_into_facets(faces: Indices) -> Indices:
    """Flat triangles of 3-node faces (themselves) or 6-node faces (four each)."""
    if faces.shape[1] == 3:
        return faces
    return faces[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)


def compute_enclosed_volume(anatomy: Anatomy, fields: LimbFields, trimmed: Mapping[str, BoneLoss]) -> float:
    """Volume (mm3) below the cut that the skin encloses, less the bones as trimmed."""
    skin, *bones = [
        compute_volume_below_cut(Surface(fields.frame.to_limb(part.points), part.faces))
        for part in (anatomy.skin, *anatomy.bones.values())
    ]
    return skin - sum(bones) + sum(part.volume_mm3 for part in trimmed.values())


def compute_volume_below_cut(surface: Surface) -> float:
    """Volume (mm3) of a closed surface below z = 0, by the divergence theorem with (0, 0, min(z, 0))."""
    low, middle, high = np.sort(surface.triangles[..., 2], axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        tip_below = low**3 / ((low - middle) * (low - high)) / 3.0
        tip_above = high**3 / ((high - low) * (high - middle)) / 3.0
    mean = (low + middle + high) / 3.0
    below = np.select([low >= 0, high <= 0, middle >= 0], [0.0 * mean, mean, tip_below], mean - tip_above)
    return float(cross_edges(surface.triangles)[:, 2] / 2.0 @ below)
