"""What an indentation must notice while it goes on."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import DataError, SaturatedData, TargetLost
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.force_sensor import SATURATED, ForceSensor
from microdrivers.routines.force.frames import TOUCHES_UN
from microdrivers.routines.force.press_settings import DEPTHS_UM

LOST_FRAMES = 15
"""In a row: half a second at 30 Hz, in which a probe goes on by 2.5 µm at the paper's speed."""

_TOUCH_SIGMAS, _TOUCH_READINGS = 8.0, 3
"""It is a touch if so many readings in a row exceed so many standard deviations of the tare, and TOUCHES_UN."""

_BLOCK_S, _BEFORE, _BETWEEN = 0.05, 10, 5
"""A rise is that of a block's mean over the mean of so many blocks, with so many between."""


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
            remedy="allow more force: --max-force-uN, and the guard's limit in the rig file's safety section; or, if "
            "it is a damper's, whose force b·v is there from the first µm on, press more slowly than "
            f"{speed_um_s:g} µm/s",
            moved="yes",
        )


class Touch(Felt):
    """Whether a tool has met something: the force exceeds a threshold, or has risen against what it was shortly before.

    Means rise clearly above the noise long before single readings do. A drift, too, leads to either in the end; what
    goes away with the tool (`is_over`, when it has gone back) is no drift.

    Args:
        sensor: tared.

    Attributes:
        touch_uN: the threshold by which it was felt, or would be.
    """

    def __init__(self, sensor: ForceSensor) -> None:
        sigma_uN = sensor.tared.sigma_uN if sensor.tared is not None else 0.0
        self.touch_uN = max(TOUCHES_UN, _TOUCH_SIGMAS * sigma_uN)
        super().__init__(self.touch_uN, _TOUCH_READINGS)
        self._size = max(1, round(_BLOCK_S * sensor.stream_rate_hz))
        # Noise within the bandwidth is the same in neighbouring readings: they count as fewer.
        independent = max(1.0, self._size * min(1.0, 2.0 * sensor.bandwidth_hz / sensor.stream_rate_hz))
        mean_uN = _TOUCH_SIGMAS * sigma_uN * math.sqrt((1.0 + 1.0 / _BEFORE) / independent)
        self._rise_uN = max(TOUCHES_UN, mean_uN)
        self._block: list[ForceSample] = []
        self._means_uN: deque[float] = deque(maxlen=_BEFORE + _BETWEEN + 1)
        self._from_uN = 0.0
        self._since_ns = self._until_ns = 0
        self._risen = False

    @property
    def enough(self) -> bool:
        """It has."""
        return self._risen or super().enough

    @property
    def is_over(self) -> bool:
        """Whether the force has gone back by more than half of the touch since."""
        left_uN = self._means_uN[-1] if self._means_uN else 0.0
        return abs(self.force_uN - left_uN) > 0.5 * self.touch_uN

    @property
    def pressed_s(self) -> float:
        """How long it was felt at most."""
        return (self._until_ns - self._since_ns) / NS_PER_S + _BLOCK_S

    def take(self, sample: ForceSample) -> None:
        """Take a reading."""
        if not self.enough and self._beyond == 0:
            self._since_ns = sample.t_ns
        super().take(sample)
        if math.isfinite(sample.force_uN):
            self._block.append(sample)
            if len(self._block) == self._size:
                self._take_mean(self._block)
                self._block = []

    def _take_mean(self, block: Sequence[ForceSample]) -> None:
        mean_uN = sum(sample.force_uN for sample in block) / len(block)
        self._means_uN.append(mean_uN)
        if not self.enough and len(self._means_uN) == self._means_uN.maxlen:
            before_uN = sum(list(self._means_uN)[:_BEFORE]) / _BEFORE
            if mean_uN - before_uN > self._rise_uN:
                self._risen, self.force_uN, self._from_uN = True, mean_uN, before_uN
                self.touch_uN, self._since_ns = self._rise_uN, block[0].t_ns
        if self.enough and abs(mean_uN - self._from_uN) > self.touch_uN:
            self._until_ns = block[-1].t_ns
        self._until_ns = max(self._until_ns, self._since_ns)


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
