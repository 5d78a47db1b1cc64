"""What all commands of the controller share: axes, error register, digital lines, log of events."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import IntEnum

from microdrivers.core.units import seconds_to_ns
from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.parameters import Value

LINES = range(1, 5)
"""Numbers of the digital inputs and of the digital outputs."""

_NEW_AXIS_IDENTIFIER = re.compile(r"\w{1,8}", re.ASCII)


class TriggerParameter(IntEnum):
    """What CTO sets for an output line (PI manual MS249E, CTO)."""

    STEP = 1
    AXIS = 2
    MODE = 3
    POLARITY = 7
    START_THRESHOLD = 8
    STOP_THRESHOLD = 9
    POSITION = 10


class DigitalLines:
    """Settings of the digital outputs; `axis` is what triggers follow by default."""

    def __init__(self, axis: str) -> None:
        self.outputs = dict.fromkeys(LINES, False)
        self.triggering = dict.fromkeys(LINES, False)
        self.triggers: dict[int, dict[TriggerParameter, Value]] = {
            line: {
                TriggerParameter.STEP: 0.1,
                TriggerParameter.AXIS: axis,
                TriggerParameter.MODE: 0,
                TriggerParameter.POLARITY: 1,
                TriggerParameter.START_THRESHOLD: 0.0,
                TriggerParameter.STOP_THRESHOLD: 0.0,
                TriggerParameter.POSITION: 0.0,
            }
            for line in LINES
        }


class ControllerState:
    """The controller without its serial port.

    Args:
        channels: its axes; the controller orders them by their identifiers.
        identification: reply to *IDN?.
        pose_latch_delay_s: when POS? samples the encoders, after the last byte of the request.
        one_element_per_line: whether a command line names one axis or parameter at most, as with the C-863.

    Attributes:
        error: the error register.
        digital: settings of the digital lines.
        events: what concerned motion, as (t_ns, text): "move x 7.1", "stop #24", "halt x", "reference x FRF",
            "referenced x", "servo x on", "motion error x", "define y 2.5", "power cycle". Texts are in controller
            units.
    """

    def __init__(
        self,
        channels: Sequence[AxisChannel],
        *,
        identification: str,
        pose_latch_delay_s: float,
        one_element_per_line: bool = False,
    ) -> None:
        self._axes = sorted(channels, key=lambda channel: channel.identifier)
        self.identification = identification
        self.pose_latch_delay_ns = seconds_to_ns(pose_latch_delay_s)
        self.one_element_per_line = one_element_per_line
        self.events: list[tuple[int, str]] = []
        self._power_on()

    def _power_on(self) -> None:
        self.error = ErrorCode.NONE
        self.channels = {channel.identifier: channel for channel in self._axes}
        self.digital = DigitalLines(self._axes[0].identifier)

    def update(self, t_ns: int) -> None:
        """Note what has ended by itself."""
        for channel in self._axes:
            found_ns = channel.update(t_ns)
            if found_ns is not None:
                self.note(found_ns, f"referenced {channel.spec.key}")

    def note(self, t_ns: int, text: str) -> None:
        """Add an event."""
        self.events.append((t_ns, text))

    # ------------------------------------------------------------------ axes by name

    def axes_named(self, identifiers: Sequence[str]) -> list[AxisChannel]:
        """The axes of a list of identifiers.

        Raises:
            CommandError: INVALID_AXIS_IDENTIFIER if there is no such axis, AXIS_LISTED_TWICE.
        """
        for identifier in identifiers:
            if identifier not in self.channels:
                raise CommandError(ErrorCode.INVALID_AXIS_IDENTIFIER)
        if len(set(identifiers)) != len(identifiers):
            raise CommandError(ErrorCode.AXIS_LISTED_TWICE)
        return [self.channels[identifier] for identifier in identifiers]

    def rename_axes(self, pairs: Sequence[tuple[str, str]]) -> None:
        """Give axes new identifiers until the next power-on, or for good once they are stored.

        Raises:
            CommandError: INVALID_AXIS_IDENTIFIER if there is no such axis or the new identifier cannot be one,
                AXIS_LISTED_TWICE.
        """
        axes = self.axes_named([old for old, _ in pairs])
        renamed = {id(axis): new for axis, (_, new) in zip(axes, pairs, strict=True)}
        if not all(_NEW_AXIS_IDENTIFIER.fullmatch(new) for new in renamed.values()):
            raise CommandError(ErrorCode.INVALID_AXIS_IDENTIFIER)
        names = [renamed.get(id(axis), axis.identifier) for axis in self._axes]
        if len(set(names)) != len(names):
            raise CommandError(ErrorCode.AXIS_LISTED_TWICE)
        for axis, name in zip(self._axes, names, strict=True):
            axis.identifier = name
        self.channels = dict(zip(names, self._axes, strict=True))

    def store_identifiers(self) -> None:
        """Let the axes keep their present identifiers through a power cycle."""
        for channel in self._axes:
            channel.stored_identifier = channel.identifier

    # ------------------------------------------------------------------ what concerns all axes

    def stop_all(self, t_ns: int, by: str) -> None:
        """Stop abruptly."""
        for channel in self._axes:
            channel.stop(t_ns, abrupt=True)
        self.error = ErrorCode.STOPPED_BY_COMMAND
        self.note(t_ns, f"stop {by}")

    def motion_error(self, key: str, t_ns: int) -> None:
        """An axis does not follow its set-point: its servo switches itself off."""
        for channel in self._axes:
            if channel.spec.key == key and channel.servo:
                channel.set_servo(False, t_ns)
                self.error = ErrorCode.MOTION_ERROR
                self.note(t_ns, f"motion error {key}")

    def power_cycle(self, t_ns: int) -> None:
        """Switch off and on."""
        for channel in self._axes:
            channel.power_cycle(t_ns)
        self._power_on()
        self.note(t_ns, "power cycle")
