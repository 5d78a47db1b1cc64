"""Scale, angle, translation and tilt from a projection matrix (Bilen et al., eq. (20), aspect ratio 1).

The linear part A = P[:, :2] splits into two orthogonal pieces, each with a length and a direction:

- a rotation and scale, `c = (a11 + a22) / 2, s = (a21 − a12) / 2`, and
- a reflection and scale, `c' = (a11 − a22) / 2, s' = (a12 + a21) / 2`.

With m = |(c, s)| and m' = |(c', s')|: det A = m² − m'², and the singular values are m + m' and |m − m'|. The
longer piece is the least-squares similarity of its handedness; the shorter one is what a similarity cannot
explain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError, IllConditioned
from microdrivers.estimators.optics.intervals import ellipse_factor

FloatArray = npt.NDArray[np.float64]

View = Literal["along_plus_z", "along_minus_z_or_mirrored"]

# Each row is c, s, c', s' from (p11 p12 p13 p21 p22 p23).
_PIECES = np.array(
    [
        [0.5, 0.0, 0.0, 0.0, 0.5, 0.0],
        [0.0, -0.5, 0.0, 0.5, 0.0, 0.0],
        [0.5, 0.0, 0.0, 0.0, -0.5, 0.0],
        [0.0, 0.5, 0.0, 0.5, 0.0, 0.0],
    ]
)
_ELLIPSE_POINTS = 720


class OpticalParameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a projection says about the optics and the mounting of camera and stage.

    The similarity (scale, angle, translation) is the well-posed result. Tilt is not: a scale mismatch of 0.1
    % between the two axes reads as 2.6°, so it is given as an interval only.

    Attributes:
        scale_px_per_um: M of eq. (5) as the least-squares similarity, the mean of the singular values, px/µm.
        sigma_scale_px_per_um: its standard deviation; None if no covariance is known.
        angle_deg: in-plane angle in (−180, 180]: the image direction of the stage's +X axis, from +u towards
            +v. It is the angle of Rz in R = Rz·Ry·Rx. In the usual, mirrored view that R also holds a half
            turn about X.
        sigma_angle_deg: its standard deviation; None if no covariance is known.
        view: `along_plus_z` when det A > 0. det A < 0 (r33 ≈ −1) is normal for a camera that looks down, v
            down, on a right-handed stage with Z up; planar data cannot tell it from a mirror in the light
            path.
        translation_um: T of eq. (20), P's third column over M: where the origin of the stage coordinates lies
            from the optical axis, along u and v, µm.
        largest_scale_px_per_um: the larger singular value, which is M of eq. (20) if tilt explains all
            anisotropy.
        tilt_deg_interval: 95 % interval of the angle between the stage and image planes, acos of the ratio of
            the singular values, within [0, 90]; a lower end of 0 makes it an upper bound.
        tilt_label: what the interval may equally well describe.
        tilt_sign_ambiguous: planar data leave the sign of the tilt open, always.
        magnification: scale × pixel pitch, dimensionless, at the sensor; None if no pitch was given.
    """

    scale_px_per_um: float
    sigma_scale_px_per_um: float | None
    angle_deg: float
    sigma_angle_deg: float | None
    view: View
    translation_um: tuple[float, float]
    largest_scale_px_per_um: float
    tilt_deg_interval: tuple[float, float]
    tilt_label: str = "tilt or stage/pixel anisotropy"
    tilt_sign_ambiguous: bool = True
    magnification: float | None = None


def optical_parameters(
    projection: Sequence[float],
    covariance: FloatArray | None = None,
    *,
    degrees_of_freedom: float = math.inf,
    pixel_pitch_um: float | None = None,
) -> OpticalParameters:
    """Interpret a projection matrix (Bilen et al., eq. (20)).

    Args:
        projection: (p11 p12 p13 p21 p22 p23): px/µm, and px in the third column.
        covariance: 6 × 6 covariance of `projection` in the same order and units; None if not known.
        degrees_of_freedom: of the noise estimate in `covariance`; widens the tilt interval.
        pixel_pitch_um: distance of the camera's pixels, µm, after binning.

    Returns:
        The parameters; without a covariance the tilt interval is (0, 90).

    Raises:
        DataError: an entry of `projection` or `covariance` is not finite, or their sizes are wrong.
        IllConditioned: A is singular, so the handedness and with it the angle is not determined.
    """
    entries = np.asarray(projection, dtype=np.float64)
    if entries.shape != (6,) or not np.all(np.isfinite(entries)):
        raise DataError(f"the projection matrix {list(projection)} is not six finite numbers")
    if covariance is not None and (covariance.shape != (6, 6) or not np.all(np.isfinite(covariance))):
        raise DataError("the covariance of the projection matrix is not 6 × 6 finite numbers")
    pieces = _PIECES @ entries
    rotation, reflection = math.hypot(pieces[0], pieces[1]), math.hypot(pieces[2], pieces[3])
    if rotation == reflection:
        raise IllConditioned(
            "the projection matrix maps the stage plane to a line",
            remedy="move the stage along a path that covers both of its axes",
        )
    proper = rotation > reflection
    scale, order = (rotation, [0, 1, 2, 3]) if proper else (reflection, [2, 3, 0, 1])
    along, across = float(pieces[order[0]]), float(pieces[order[1]])

    sigma_scale = sigma_angle = None
    tilt = (0.0, 90.0)
    if covariance is not None:
        of_pieces = (_PIECES @ covariance @ _PIECES.T)[np.ix_(order, order)]
        gradients = np.array([[along, across, 0.0, 0.0], [-across / scale, along / scale, 0.0, 0.0]]) / scale
        variances = np.einsum("ij,jk,ik->i", gradients, of_pieces, gradients).clip(min=0.0)
        sigma_scale, sigma_angle = float(np.sqrt(variances[0])), math.degrees(math.sqrt(variances[1]))
        tilt = _tilt_interval(pieces[order], of_pieces, ellipse_factor(degrees_of_freedom))
    return OpticalParameters(
        scale_px_per_um=scale,
        sigma_scale_px_per_um=sigma_scale,
        angle_deg=wrap_deg(math.degrees(math.atan2(across, along))),
        sigma_angle_deg=sigma_angle,
        view="along_plus_z" if proper else "along_minus_z_or_mirrored",
        translation_um=(float(entries[2]) / scale, float(entries[5]) / scale),
        largest_scale_px_per_um=rotation + reflection,
        tilt_deg_interval=tilt,
        magnification=None if pixel_pitch_um is None else scale * pixel_pitch_um,
    )


def _tilt_interval(pieces: FloatArray, covariance: FloatArray, radius: float) -> tuple[float, float]:
    """95 % interval of acos(σ₂/σ₁), degrees, which is conservative.

    σ₂/σ₁ = (1 − |q|) / (1 + |q|) with q the anisotropy, a vector: the shorter piece over the length of the
    longer. Unlike σ₂/σ₁, which noise can only lower, q is Gaussian about its true value, also when that is
    zero. The interval holds every |q| inside the confidence ellipse of q: it covers in 95 % where q = 0 and
    in up to 99 % where |q| is many standard deviations.
    """
    if math.isinf(radius):
        return (0.0, 90.0)
    scale = math.hypot(pieces[0], pieces[1])
    q = pieces[2:] / scale
    jacobian = np.hstack([-np.outer(q, pieces[:2]) / scale**2, np.eye(2) / scale])
    of_q = jacobian @ covariance @ jacobian.T
    eigenvalues, axes = np.linalg.eigh((of_q + of_q.T) / 2.0)
    half_axes = radius * np.sqrt(eigenvalues.clip(min=0.0))
    turn = np.linspace(0.0, 2.0 * math.pi, _ELLIPSE_POINTS, endpoint=False)
    rim = (axes * half_axes) @ np.vstack([np.cos(turn), np.sin(turn)])
    lengths = np.hypot(q[0] + rim[0], q[1] + rim[1])
    centre = np.abs(axes.T @ q)
    holds_origin = bool(np.all(half_axes > 0.0)) and float(np.sum((centre / half_axes) ** 2)) <= 1.0
    low = 0.0 if holds_origin else float(lengths.min())
    return (_tilt_deg(low), _tilt_deg(float(lengths.max())))


def _tilt_deg(anisotropy: float) -> float:
    """acos((1 − |q|) / (1 + |q|)), written so that small angles keep their digits."""
    return math.degrees(2.0 * math.atan(math.sqrt(min(1.0, anisotropy))))


def wrap_deg(angle_deg: float) -> float:
    """The same direction in (−180, 180], degrees."""
    wrapped = math.remainder(angle_deg, 360.0)
    return 180.0 if wrapped == -180.0 else wrapped
