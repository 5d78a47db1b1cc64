"""A pose with little work: as long as nothing but positions changes, what followed from the last reading still holds.

Polled a hundred times a second, a controller mostly says the same again but for a few digits. What its status, servos
and references mean is worked out when they change, and not each time (docs/decisions/0006).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from microdrivers.backends.pi_gcs.axis_map import AxisMap
from microdrivers.core.samples import XYThetaSample
from microdrivers.devices.xytheta_stage import AXES

_NUMBER = rb"[+-]?\d{1,9}\.\d{1,12}"
_AT_NUMBERS = re.compile(rb"(?<==)" + _NUMBER)
_NAMES = re.compile(rb"([A-Za-z0-9_]+)=" + _NUMBER)


class SteadyPose:
    """Recognises replies that differ from an earlier one in nothing but positions.

    Args:
        mark: of the controller when the earlier one came.
        sample: what it meant.
        form: fits such replies, with a group for each number.
        groups: those of x, y, theta.
        rig_per_native: µm, µm and degrees in the controller's units of x, y, theta.

    Attributes:
        moving, on_target, referenced: hold as long as replies are recognised.
    """

    def __init__(
        self, mark: tuple[int, ...], sample: XYThetaSample, form: re.Pattern[bytes], groups: Sequence[int],
        rig_per_native: Sequence[float],
    ) -> None:  # fmt: skip
        self._mark = mark
        self.moving, self.on_target, self.referenced = sample.moving, sample.on_target, sample.referenced
        self._form = form
        self._groups = tuple(groups)
        self._x_um, self._y_um, self._theta_deg = rig_per_native

    @classmethod
    def after(
        cls, reply: bytes, sample: XYThetaSample, mark: tuple[int, ...], axes: Mapping[str, AxisMap]
    ) -> SteadyPose | None:
        """From a reply to `POS?` and `#4` and what it meant; None if its numbers are written in an unusual way."""
        names = [name.decode("ascii") for name in _NAMES.findall(reply)]
        if not all(axes[axis].id in names for axis in AXES):
            return None
        form = re.compile((b"(%b)" % _NUMBER).join(re.escape(part) for part in _AT_NUMBERS.split(reply)))
        groups = [names.index(axes[axis].id) + 1 for axis in AXES]
        return cls(mark, sample, form, groups, [axes[axis].position(1.0) for axis in AXES])

    def positions_in(self, reply: bytes, mark: tuple[int, ...]) -> tuple[float, float, float] | None:
        """X and y in µm, theta in degrees; None if the reply says anything else, or the mark has changed."""
        match = self._form.fullmatch(reply)
        if match is None or mark != self._mark:
            return None
        x, y, theta = match.group(*self._groups)
        return float(x) * self._x_um, float(y) * self._y_um, float(theta) * self._theta_deg
