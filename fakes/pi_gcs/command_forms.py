"""What commands have in common: the call, the forms of arguments and of queries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.parameters import read_decimal, read_switch
from microdrivers.fakes.pi_gcs.state import ControllerState

Lines = list[str]


class Call(NamedTuple):
    """One command: its arguments and the instant at which its last byte arrived."""

    state: ControllerState
    arguments: Sequence[str]
    t_ns: int


Run = Callable[[Call], Lines]


class Command(NamedTuple):
    """What a mnemonic does; a query returns the lines of its reply, anything else returns none."""

    run: Run
    text: str


# ---------------------------------------------------------------------- arguments


def require_no_arguments(call: Call) -> None:
    """The command takes none.

    Raises:
        CommandError: WRONG_NUMBER_OF_PARAMETERS.
    """
    if call.arguments:
        raise CommandError(ErrorCode.WRONG_NUMBER_OF_PARAMETERS)


def groups(call: Call, size: int) -> list[Sequence[str]]:
    """The arguments in groups of a size, at least one; only one if the controller takes no more in a line.

    Raises:
        CommandError: PARAMETER_MISSING or WRONG_NUMBER_OF_PARAMETERS.
    """
    arguments = call.arguments
    if len(arguments) < size:
        raise CommandError(ErrorCode.PARAMETER_MISSING)
    if len(arguments) % size or (call.state.one_element_per_line and len(arguments) > size):
        raise CommandError(ErrorCode.WRONG_NUMBER_OF_PARAMETERS)
    return [arguments[i : i + size] for i in range(0, len(arguments), size)]


def axes_or_all(call: Call) -> list[AxisChannel]:
    """The axes that the arguments name, or all of them if there are no arguments.

    Raises:
        CommandError: WRONG_NUMBER_OF_PARAMETERS, INVALID_AXIS_IDENTIFIER or AXIS_LISTED_TWICE.
    """
    if not call.arguments:
        return list(call.state.channels.values())
    return call.state.axes_named([axis for (axis,) in groups(call, 1)])


def axes_with_texts(call: Call) -> list[tuple[AxisChannel, str]]:
    """Axes, each with an argument."""
    pairs = groups(call, 2)
    channels = call.state.axes_named([axis for axis, _ in pairs])
    return list(zip(channels, [text for _, text in pairs], strict=True))


def axes_with_numbers(call: Call) -> list[tuple[AxisChannel, float]]:
    """Axes, each with a decimal number."""
    return [(channel, read_decimal(text)) for channel, text in axes_with_texts(call)]


def axes_with_switches(call: Call) -> list[tuple[AxisChannel, bool]]:
    """Axes, each with 0 or 1."""
    return [(channel, read_switch(text)) for channel, text in axes_with_texts(call)]


# ---------------------------------------------------------------------- queries


def fixed(reply: Callable[[ControllerState], Lines]) -> Run:
    """A query without arguments."""

    def run(call: Call) -> Lines:
        require_no_arguments(call)
        return reply(call.state)

    return run


def per_axis(value: Callable[[AxisChannel, int], str]) -> Run:
    """A query of some or all axes."""

    def run(call: Call) -> Lines:
        return [f"{channel.identifier}={value(channel, call.t_ns)}" for channel in axes_or_all(call)]

    return run


def flag(is_set: object) -> str:
    """1 or 0."""
    return "1" if is_set else "0"
