"""What every point tracker shares: the check of the image, the origin of coordinates, the reporting of a point."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError
from microdrivers.core.samples import Frame, TrackedPoint

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

_NAN = float("nan")


def require_grey(image: npt.NDArray[Any]) -> GreyImage:
    """Return `image` as a contiguous grey image, rows × columns.

    Raises:
        DataError: it is not a two-dimensional uint8 or uint16 array.
    """
    if image.ndim != 2:
        raise DataError(
            f"the image has the shape {image.shape}; a grey image (rows × columns) is needed",
            remedy="set the camera to a monochrome pixel format, or convert colour images before tracking",
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise DataError(
            f"the image has the type {image.dtype}; uint8 or uint16 is needed",
            remedy="convert the grey levels to 8 or 16 bits",
        )
    return np.ascontiguousarray(image)


class PointReporter:
    """Makes the `TrackedPoint` of a frame: origin at the frame's principal point, own sequence counter.

    Args:
        device: name of the publishing estimator.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._seq = 0

    def found(
        self,
        frame: Frame,
        *,
        position_px: tuple[float, float],
        sigma_px: float,
        flags: frozenset[str] = frozenset(),
    ) -> TrackedPoint:
        """A located point; `position_px` is (u, v) from the centre of the top-left pixel of `frame`."""
        u0, v0 = frame.principal_point_px
        return self._make(frame, position_px[0] - u0, position_px[1] - v0, sigma_px, True, flags)

    def lost(self, frame: Frame, flag: str) -> TrackedPoint:
        """A frame without a point; `flag` says why."""
        return self._make(frame, _NAN, _NAN, _NAN, False, frozenset({flag}))

    def _make(
        self, frame: Frame, u_px: float, v_px: float, sigma_px: float, found: bool, flags: frozenset[str]
    ) -> TrackedPoint:
        point = TrackedPoint(
            t_ns=frame.t_ns,
            dt_ns=frame.dt_ns,
            t_source="computed",
            device=self._device,
            seq=self._seq,
            flags=flags,
            u_px=u_px,
            v_px=v_px,
            sigma_px=sigma_px,
            found=found,
            frame_seq=frame.seq,
        )
        self._seq += 1
        return point
