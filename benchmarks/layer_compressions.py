"""How much each layer of soft tissue is compressed under a rigid probe: linear, incompressible, on bone.

In the Hankel domain a layer's displacement along the axis is w = (a + b kz) e^-kz + (c + d kz) e^kz, and
div u = 0 gives the radial one, v = -w'/k. So a layer of thickness h and shear modulus mu has a stiffness
mu k K(kh), (4, 4), between the displacements (v, w) and the tractions of its two faces, and layers are put
together from the bone upwards (Kausel and Roesset 1981, doi 10.1785/BSSA0710061743). On the probe's axis only
the mean over the directions of the transform of its pressure counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0

Array = NDArray[np.float64]

_NODES, _ANGLES = 40, 96  # of the transform, and of the directions in a quarter
_ROUNDING_MM = 1.5  # edges and gel: the pressure is blurred by this standard deviation
_END = 4.5  # of the transform, over the rounding
_THICKEST = 30.0  # k times a thickness: what is thicker is a half-space, to rounding


@dataclass(frozen=True)
class Footprint:
    """A flat rigid rectangle of ``length_mm`` by ``width_mm``.

    Its pressure is taken as a product of two of infinite strips, (1 - x^2/a^2)^-1/2 (1 - y^2/b^2)^-1/2, with
    rounded edges.
    """

    length_mm: float
    width_mm: float

    def spectrum(self, k: Array) -> Array:
        """The transform of its pressure over that at k = 0, mean over all directions."""
        angle = (np.arange(_ANGLES) + 0.5) * np.pi / (2 * _ANGLES)
        along = j0(np.multiply.outer(k, np.cos(angle)) * self.length_mm / 2)
        across = j0(np.multiply.outer(k, np.sin(angle)) * self.width_mm / 2)
        return np.asarray((along * across).mean(axis=-1) * np.exp(-((_ROUNDING_MM * k) ** 2) / 2))

    def under(self, thickness_mm: Array, force_N: Array) -> Layers:
        """Layers (n, l) under it: the same at every force."""
        return Layers.under(self, thickness_mm)


@dataclass(frozen=True)
class Layers:
    """Layers of ``thickness_mm`` (n, l), outermost first, at n places under one probe."""

    weights: Array  # (q,) of the transform's nodes
    k: Array  # (q,) in 1/mm
    stiffness: Array  # (n, l, q, 4, 4) over the shear modulus

    @classmethod
    def under(cls, footprint: Footprint, thickness_mm: Array) -> Layers:
        x, w = np.polynomial.legendre.leggauss(_NODES)
        root = (
            np.sqrt(_END / _ROUNDING_MM) * (x + 1) / 2
        )  # of k: nodes are dense where displacements are large
        k, weights = root**2, w * np.sqrt(_END / _ROUNDING_MM) * root
        return cls(
            weights * footprint.spectrum(k) / (2 * np.pi),
            k,
            k[:, None, None] * _stiffness(np.multiply.outer(thickness_mm, k)),
        )

    def compressions(self, shear_moduli: Array) -> Array:
        """Compression of each layer on the axis, in mm per N, (n, l), for moduli (n, l) in MPa."""
        count = self.stiffness.shape[1]
        below, passed = np.zeros((*self.stiffness.shape[:1], len(self.k), 2, 2)), []
        for i in reversed(range(count)):
            K = shear_moduli[:, i, None, None, None] * self.stiffness[:, i]
            if i == count - 1:  # on bone
                below = K[..., :2, :2]
                continue
            down = -_inverse(K[..., 2:, 2:] + below) @ K[..., 2:, :2]
            below = K[..., :2, :2] + K[..., :2, 2:] @ down
            passed.append(down)
        u = _inverse(below)[..., 1]  # under a unit pressure without shear
        found = [u[..., 1]]
        for down in reversed(passed):
            u = (down @ u[..., None])[..., 0]
            found.append(u[..., 1])
        found.append(np.zeros_like(found[0]))
        w = np.stack(found, axis=1) * self.k
        return np.asarray((w[:, :-1] - w[:, 1:]) @ self.weights)


def _inverse(a: Array) -> Array:
    """Of (..., 2, 2)."""
    swapped = np.stack(
        [np.stack([a[..., 1, 1], -a[..., 0, 1]], -1), np.stack([-a[..., 1, 0], a[..., 0, 0]], -1)], -2
    )
    return swapped / (a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 1, 0])[..., None, None]


def _stiffness(kh: Array) -> Array:
    """K (..., 4, 4) of layers of k times thickness ``kh``: tractions of (v, w) above and below, over mu k.

    Columns of ``U`` and ``T`` are the four solutions, each 1 or less within the layer.
    """
    h = np.minimum(kh, _THICKEST)
    e = np.exp(-h)
    zero, one = np.zeros_like(h), np.ones_like(h)
    # w and its first three derivatives by kz, of e^-s, s e^-s, e^-(h-s), (h-s) e^-(h-s), at s = 0 and s = h.
    top = [
        [one, zero, e, h * e],
        [-one, one, e, (h - 1) * e],
        [one, -2 * one, e, (h - 2) * e],
        [-one, 3 * one, e, (h - 3) * e],
    ]
    bottom = [
        [e, h * e, one, zero],
        [-e, (1 - h) * e, one, -one],
        [e, (h - 2) * e, one, -2 * one],
        [-e, (3 - h) * e, one, -3 * one],
    ]

    def rows(derivatives: list[list[Array]]) -> tuple[Array, Array]:
        w, w1, w2, w3 = (np.stack(one, axis=-1) for one in derivatives)
        displacement = np.stack([-w1, w], axis=-2)
        # Over mu k: shear -w'' - w; normal stress -q + 2 w', q = w''' - w'.
        return displacement, np.stack([-w2 - w, 3 * w1 - w3], axis=-2)

    (u0, t0), (u1, t1) = rows(top), rows(bottom)
    U, T = np.concatenate([u0, u1], axis=-2), np.concatenate([-t0, t1], axis=-2)
    return np.asarray(np.swapaxes(np.linalg.solve(np.swapaxes(U, -1, -2), np.swapaxes(T, -1, -2)), -1, -2))
