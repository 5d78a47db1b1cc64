"""The figures of an indentation by a live probe."""

from __future__ import annotations

import math
from typing import NamedTuple

from microdrivers.core.errors import OutOfRange
from microdrivers.core.units import Range, check_range

SPEEDS_UM_S, DEPTHS_UM, HOLDS_S = Range(0.1, 100.0), Range(5.0, 1000.0), Range(0.0, 3600.0)
"""What may be asked of a press, whatever the rig."""

_SHARE_OF_LIMIT = 0.8
"""Of the largest push that guard and sensor allow."""


class PressSettings(NamedTuple):
    """The experiment's figures; the speed is the paper's. All are finite and none is negative.

    Attributes:
        speed_um_s: of the tip on the approach, in and out, 0.1 to 100.
        depth_um: how far to press beyond the contact, 5 to 1000.
        max_force_uN: where pressing ends before that, above 0 and below what guard and sensor allow; None: 80 % of it.
        hold_s: how long to stay at the deepest point, up to 3600.
        tare_s: how long a tare takes, 0.05 to 60.
        free_travel_um: how far the probe travels in sight, touching nothing, to measure the scale.
        free_steps: frames are taken at the ends of so many steps of that travel.
        free_speed_um_s: of the stage through free space; a guard or the axes may allow less.
        most_approach_um: how far to look for the specimen beyond the starting point.
        back_off_um: how far before the contact an indentation begins.
        rest_s: how long the specimen may recover from the contact.
    """

    speed_um_s: float = 5.0
    depth_um: float = 110.0
    max_force_uN: float | None = None
    hold_s: float = 0.0
    tare_s: float = 0.5
    free_travel_um: float = 160.0
    free_steps: int = 8
    free_speed_um_s: float = 200.0
    most_approach_um: float = 200.0
    back_off_um: float = 15.0
    rest_s: float = 5.0

    def check(self) -> None:
        """Refuse figures that no experiment can have; what a rig allows besides is the experiment's to check.

        Raises:
            OutOfRange: one is not finite, is negative, or lies outside its range.
        """
        check_range(self.speed_um_s, SPEEDS_UM_S, what="speed of the probe", unit="µm/s", in_file="")
        check_range(self.depth_um, DEPTHS_UM, what="depth of the indentation", unit="µm", in_file="")
        check_range(self.hold_s, HOLDS_S, what="time at the deepest point", unit="s")
        for name, value in self._asdict().items():
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise OutOfRange(f"{name} is {value:g}", remedy="give a finite number that is not negative")
        if self.max_force_uN == 0.0:
            raise OutOfRange("max_force_uN is 0", remedy="give a largest force above 0 µN")

    def approach_um(self, longest_um: float) -> float:
        """How far to look for the specimen where the way is so long: the depth must still fit in."""
        return min(self.most_approach_um, longest_um - self.depth_um)

    def limit_uN(self, range_uN: Range, *, guard_uN: float | None, tare_uN: float = 0.0) -> float:
        """The tared force at which pressing ends by itself, before a guard must act or the sensor is saturated.

        Args:
            range_uN: of the sensor, without a tare; a push reads positive.
            guard_uN: tared limit of its guard; None if it has none.
            tare_uN: the sensor's zero.

        Raises:
            OutOfRange: more is asked for than sensor or guard allow, or they allow nothing.
        """
        whose, ceiling_uN = "the sensor's range", range_uN.max - tare_uN
        if guard_uN is not None and guard_uN <= ceiling_uN:
            whose, ceiling_uN = "the guard's limit", guard_uN
        whose += f" at a zero of {tare_uN:.4g} µN" if tare_uN else ""
        if ceiling_uN <= 0.0:
            raise OutOfRange(
                f"{whose} leaves no force to press with: a push reads positive, and may be {ceiling_uN:.4g} µN at most",
                remedy="correct range_uN and axis of the sensor in the rig file, or the amplifier's zero",
            )
        asked = self.max_force_uN
        if asked is None:
            return _SHARE_OF_LIMIT * ceiling_uN
        if not 0.0 < asked < ceiling_uN:
            raise OutOfRange(
                f"a largest force of {asked:g} µN is not between 0 and {whose}, {ceiling_uN:.4g} µN",
                remedy="press less, or change the safety section of the rig file",
            )
        return asked
