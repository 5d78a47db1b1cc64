"""What an indentation must notice while it goes on."""

from __future__ import annotations

import math

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import DataError, SaturatedData, TargetLost
from microdrivers.core.samples import ForceSample
from microdrivers.devices.force_sensor import SATURATED
from microdrivers.routines.force.press_settings import DEPTHS_UM

LOST_FRAMES = 15
"""In a row: half a second at 30 Hz, in which a probe goes on by 2.5 µm at the paper's speed."""


class Felt:
    """Whether the force has been beyond a threshold for some readings in a row, or once beyond the sensor's range.

    Attributes:
        force_uN: the last reading that was beyond the threshold; of a saturated sensor, where it stood.
        saturated: whether a reading was at the end of the sensor's range.
    """

    def __init__(self, threshold_uN: float, readings: int) -> None:
        self.force_uN = math.nan
        self.saturated = False
        self._threshold_uN = threshold_uN
        self._needed = readings
        self._beyond = 0

    @property
    def enough(self) -> bool:
        """It has."""
        return self.saturated or self._beyond >= self._needed

    def take(self, sample: ForceSample) -> None:
        """Take a reading; one without a number, and not saturated, is below any threshold."""
        if SATURATED in sample.flags and not self.saturated:
            self.saturated, self.force_uN = True, sample.raw_uN - sample.tare_uN
        if self.enough:
            return
        beyond = abs(sample.force_uN) > self._threshold_uN  # False for NaN
        self._beyond = self._beyond + 1 if beyond else 0
        if beyond:
            self.force_uN = sample.force_uN

    def raise_if_saturated(self, doing: str, *, sensor: str) -> None:
        """Raise if a reading was at the end of the sensor's range.

        Raises:
            SaturatedData: one was.
        """
        if self.saturated:
            raise SaturatedData(
                f"the sensor was at the end of its range {doing}, at {self.force_uN:.4g} µN",
                device=sensor,
                remedy="see that nothing touched the tip before, and check the sensor's zero, and its range_uN in the "
                "rig file; a stiff specimen asks for a slower press or a larger range",
                moved="yes",
            )

    def raise_if_too_soon(self, depth_um: float, *, speed_um_s: float, sensor: str) -> None:
        """Raise if the threshold, taken for the limit of a press, was reached before anything could be learnt.

        Raises:
            DataError: it was reached in less than the smallest depth that may be asked for.
        """
        if not self.enough or depth_um >= DEPTHS_UM.min:
            return
        self.raise_if_saturated(f"{max(depth_um, 0.0):.1f} µm from contact", sensor=sensor)
        raise DataError(
            f"turned back at {self.force_uN:.4g} µN, beyond the limit of {self._threshold_uN:.4g} µN, after "
            f"{max(depth_um, 0.0):.1f} µm from contact: too little to tell springs from a damper",
            device=sensor,
            remedy=f"press more slowly than {speed_um_s:g} µm/s (a damper's force b·v is there from the first µm on), "
            "or allow more force: --max-force-uN, and the guard's limit in the rig file's safety section",
            moved="yes",
        )


class Lost:
    """Whether the contact point has been lost for too many frames in a row."""

    def __init__(self) -> None:
        self._missing = 0
        self.too_long = False

    def take(self, sample: DeformationSample) -> None:
        """Take what was seen in a frame."""
        self._missing = 0 if sample.found else self._missing + 1
        self.too_long = self.too_long or self._missing >= LOST_FRAMES

    def raise_if_too_long(self, camera: str) -> None:
        """End the experiment if it has.

        Raises:
            TargetLost: it has.
        """
        if self.too_long:
            raise TargetLost(
                f"the contact point was not seen in {LOST_FRAMES} frames in a row",
                device=camera,
                remedy="check focus and light, and that nothing covers the contact point",
                moved="yes",
            )
