"""The search for the specimen: slowly on until a force rises, and back, which must take that force away again."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from microdrivers.core.clock import Clock
from microdrivers.core.errors import ConfigError, DataError, NoContact, OutOfRange
from microdrivers.devices.force_sensor import ForceSensor, Tare
from microdrivers.routines.force.press_settings import PressSettings
from microdrivers.routines.force.probe_drive import ProbeDrive
from microdrivers.routines.force.watches import Touch
from microdrivers.routines.progress import Progress

_PROGRESS_UM = 1.0
"""Farther than the last false alarm must the next one be: a drift that is faster hides the specimen."""

_APPROACH_GENTLY = (
    "the limit was exceeded before the touch was recognised, or by the sensor's zero: approach more slowly "
    "(--speed-um-s), check the sensor's zero, or allow more in the rig file's safety section (max_force_uN)"
)

_AWAY_S, _AWAY_READINGS = 0.15, 2
"""So long, and for so many readings, the force is looked at when the tool has gone back."""

_DRIFT_UN_S, _DRIFT_SIGMAS = 1.0, 6.0
"""A zero is taken so long that this drift is so many standard deviations of a slope: a tare refuses from four on."""


class Contact(NamedTuple):
    """Where the approach has met the specimen.

    Attributes:
        place_um: of the tip on its way, when it stood.
        touch_uN: rise of the force that is a touch. pressed_s: how long it was felt at most.
    """

    place_um: float
    touch_uN: float
    pressed_s: float


def find_specimen(
    drive: ProbeDrive,
    sensor: ForceSensor,
    settings: PressSettings,
    *,
    limit_uN: float,
    retare: Callable[[], None],
    clock: Clock,
    progress: Progress,
) -> Contact:
    """Go on at the experiment's speed until the sensor feels the specimen, then back by `back_off_um`.

    A force that stays when the tool has gone back is the sensor's drift: tared anew, and on.

    Args:
        drive: the tool on its way.
        sensor: tared.
        settings: of the experiment.
        limit_uN: the tared force at which pressing would end; a touch must be clear of it.
        retare: takes a new zero.
        clock: that the rig lives by.
        progress: hears of what was no contact.

    Raises:
        OutOfRange: noise hides a touch up to half of the limit. NoContact: nothing is there. ConfigError: the sensor's
            axis is the wrong way round. SaturatedData: the sensor is at the end of its range. DataError: its zero
            drifts too fast to tell.
    """
    end_um, farthest_um = settings.approach_um(drive.way.longest_um()), -math.inf
    while True:
        touch = _touch_below(limit_uN, sensor)
        with drive.readings(touch):
            reached_um = _until_felt(drive, sensor, touch, end_um, settings)
            drive.go(reached_um - settings.back_off_um)
            clock.sleep(max(_AWAY_S, _AWAY_READINGS / sensor.stream_rate_hz))
        if touch.is_over:
            break
        if reached_um < farthest_um + _PROGRESS_UM:
            raise DataError(
                f"the force had changed by {touch.force_uN:.3g} µN after {reached_um:.0f} µm and did not return when "
                "the tool went back: the sensor's zero drifts too fast to find the specimen",
                device=sensor.name,
                remedy="let the amplifier warm up, see that nothing hangs on the tip, and start again nearer to the "
                "specimen or with a faster --speed-um-s",
                moved="yes",
            )
        farthest_um = reached_um
        progress.step(
            f"no contact after {reached_um:.1f} µm: the force did not return when the tool went back, so it is the "
            "sensor's drift; tare, and on"
        )
        retare()
    if touch.force_uN < 0.0:
        raise ConfigError(
            f"{sensor.name} read {touch.force_uN:.3g} µN on contact, which must be positive",
            remedy="turn its axis round in the rig file, or take the probe out of what it sticks to",
        )
    return Contact(reached_um, touch.touch_uN, touch.pressed_s)


def _touch_below(limit_uN: float, sensor: ForceSensor) -> Touch:
    touch = Touch(sensor)
    # Half: until it is found out, a drift may have hidden as much as a touch.
    if touch.touch_uN > 0.5 * limit_uN:
        raise OutOfRange(
            f"a touch shows from {touch.touch_uN:.3g} µN on in the noise of {sensor.name}, which is not clear of the "
            f"{limit_uN:.4g} µN that may be pressed with",
            device=sensor.name,
            remedy="allow twice that force or more: --max-force-uN, and the guard's limit in the rig file's safety "
            "section; or lessen the sensor's noise",
        )
    return touch


def _until_felt(drive: ProbeDrive, sensor: ForceSensor, touch: Touch, end_um: float, settings: PressSettings) -> float:
    reached_um = drive.run(end_um, lambda: touch.enough, below_limit=_APPROACH_GENTLY)
    touch.raise_if_saturated("on the approach", sensor=sensor.name)
    if not touch.enough:
        by_travel = end_um < settings.most_approach_um
        left = f", where the stage's travel leaves just the {settings.depth_um:g} µm to be pressed" if by_travel else ""
        raise NoContact(
            f"no contact within {end_um:.0f} µm{left}: the force stayed within ±{touch.touch_uN:.2g} µN",
            device=sensor.name,
            remedy="align the probe with the specimen, nearer to it; check the sensor's axis in the rig file"
            + ("; or press less deeply" if by_travel else ""),
            moved="yes",
        )
    return reached_um


def tare_s(sensor: ForceSensor, tare: Tare) -> float:
    """How long a zero must be taken so that the noise of this one would let a drift of 1 µN/s be seen."""
    rate_hz = min(sensor.stream_rate_hz, 2.0 * sensor.bandwidth_hz)  # of readings that are independent
    spread_s = _DRIFT_SIGMAS * math.sqrt(12.0 / rate_hz) * tare.sigma_uN / _DRIFT_UN_S
    return float(spread_s ** (2.0 / 3.0))
