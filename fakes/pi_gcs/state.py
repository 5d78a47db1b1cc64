"""What all commands of the controller share: axes, error register, log of events."""

from __future__ import annotations

import re
from collections.abc import Sequence

from microdrivers.core.units import seconds_to_ns
from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode

_AXIS_IDENTIFIER = re.compile(r"\w{1,16}", re.ASCII)


class ControllerState:
    """The controller without its serial port.

    Args:
        channels: its axes; the controller orders them by their identifiers.
        identification: reply to *IDN?.
        pose_latch_delay_s: when POS? samples the encoders, after the last byte of the request.

    Attributes:
        error: the error register.
        events: what concerned motion, as (t_ns, text): "move x 7.1", "stop #24", "halt x", "reference x FRF",
            "referenced x", "servo x on", "define y 2.5", "power cycle". Texts are in controller units.
    """

    def __init__(self, channels: Sequence[AxisChannel], *, identification: str, pose_latch_delay_s: float) -> None:
        self.channels = {
            channel.spec.identifier: channel
            for channel in sorted(channels, key=lambda channel: channel.spec.identifier)
        }
        self.identification = identification
        self.pose_latch_delay_ns = seconds_to_ns(pose_latch_delay_s)
        self.error = ErrorCode.NONE
        self.events: list[tuple[int, str]] = []

    def update(self, t_ns: int) -> None:
        """Note what has ended by itself."""
        for channel in self.channels.values():
            found_ns = channel.update(t_ns)
            if found_ns is not None:
                self.note(found_ns, f"referenced {channel.spec.key}")

    def note(self, t_ns: int, text: str) -> None:
        """Add an event."""
        self.events.append((t_ns, text))

    def axes_named(self, identifiers: Sequence[str]) -> list[AxisChannel]:
        """The axes of a list of identifiers.

        Raises:
            CommandError: INVALID_AXIS_IDENTIFIER if one is malformed, ILLEGAL_AXIS if there is no such axis,
                AXIS_LISTED_TWICE.
        """
        for identifier in identifiers:
            if not _AXIS_IDENTIFIER.fullmatch(identifier):
                raise CommandError(ErrorCode.INVALID_AXIS_IDENTIFIER)
            if identifier not in self.channels:
                raise CommandError(ErrorCode.ILLEGAL_AXIS)
        if len(set(identifiers)) != len(identifiers):
            raise CommandError(ErrorCode.AXIS_LISTED_TWICE)
        return [self.channels[identifier] for identifier in identifiers]

    def axes_or_all(self, identifiers: Sequence[str]) -> list[AxisChannel]:
        """The axes of a list of identifiers, or all of them if it is empty."""
        return self.axes_named(identifiers) if identifiers else list(self.channels.values())

    def stop_all(self, t_ns: int, by: str) -> None:
        """Stop abruptly."""
        for channel in self.channels.values():
            channel.stop(t_ns, abrupt=True)
        self.error = ErrorCode.STOPPED_BY_COMMAND
        self.note(t_ns, f"stop {by}")

    def power_cycle(self, t_ns: int) -> None:
        """Switch off and on."""
        for channel in self.channels.values():
            channel.power_cycle(t_ns)
        self.error = ErrorCode.NONE
        self.note(t_ns, "power cycle")
