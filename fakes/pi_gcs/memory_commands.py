"""Parameters of the axes in volatile and non-volatile memory, and the names of the axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel, Memory
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.command_forms import Call, Command, Lines, Run, fixed, groups
from microdrivers.fakes.pi_gcs.parameters import (
    DESCRIPTIONS,
    Parameter,
    check_parameter,
    format_value,
    read_parameter,
)
from microdrivers.fakes.pi_gcs.state import ControllerState

_PASSWORD = "100"
_KINDS = {int: "INT", float: "FLOAT", str: "CHAR"}

_WhichMemory = Callable[[AxisChannel], Memory]


def _volatile(channel: AxisChannel) -> Memory:
    return channel.parameters


def _non_volatile(channel: AxisChannel) -> Memory:
    return channel.stored_parameters


def _without_password(call: Call) -> Call:
    """The call behind its password.

    Raises:
        CommandError: PARAMETER_MISSING or INVALID_PASSWORD.
    """
    if not call.arguments:
        raise CommandError(ErrorCode.PARAMETER_MISSING)
    if call.arguments[0] != _PASSWORD:
        raise CommandError(ErrorCode.INVALID_PASSWORD)
    return call._replace(arguments=call.arguments[1:])


def _axis(state: ControllerState, identifier: str) -> AxisChannel:
    return state.axes_named([identifier])[0]


def _set_in(memory: _WhichMemory, call: Call) -> Lines:
    triples = groups(call, 3)
    drafts = {axis: dict(memory(_axis(call.state, axis))) for axis, _, _ in triples}
    for axis, name, text in triples:
        parameter = read_parameter(name)
        travel = _axis(call.state, axis).physical_travel
        drafts[axis][parameter] = check_parameter(parameter, text, drafts[axis], travel)
    for axis, draft in drafts.items():
        memory(_axis(call.state, axis)).update(draft)
    return []


def _get_from(memory: _WhichMemory) -> Run:
    def run(call: Call) -> Lines:
        asked: Sequence[Sequence[str]] = (
            groups(call, 2)
            if call.arguments
            else [(axis, f"0x{parameter:X}") for axis in call.state.channels for parameter in Parameter]
        )
        return [
            f"{axis} {name}={format_value(memory(_axis(call.state, axis))[read_parameter(name)])}"
            for axis, name in asked
        ]

    return run


def _copy(call: Call, source: _WhichMemory, destination: _WhichMemory) -> Lines:
    """Copy the parameters that are named, or all of them."""
    if not call.arguments:
        for channel in call.state.channels.values():
            destination(channel).update(source(channel))
        return []
    named = [(_axis(call.state, axis), read_parameter(name)) for axis, name in groups(call, 2)]
    for channel, parameter in named:
        destination(channel)[parameter] = source(channel)[parameter]
    return []


def _set_volatile(call: Call) -> Lines:
    return _set_in(_volatile, call)


def _set_non_volatile(call: Call) -> Lines:
    return _set_in(_non_volatile, _without_password(call))


def _save(call: Call) -> Lines:
    bare = _without_password(call)
    if not bare.arguments:
        call.state.store_identifiers()
    return _copy(bare, _volatile, _non_volatile)


def _restore(call: Call) -> Lines:
    return _copy(call, _non_volatile, _volatile)


def _describe(_: ControllerState) -> Lines:
    rows = [
        f"0x{parameter:X}=\t{int(row.protected)}\t1\t{_KINDS[row.kind]}\t{row.group}\t{row.text}"
        for parameter, row in DESCRIPTIONS.items()
    ]
    return [*rows, "end of help"]


def _list_axes(call: Call) -> Lines:
    if [word.upper() for word in call.arguments] not in ([], ["ALL"]):
        raise CommandError(ErrorCode.PARAMETER_SYNTAX)
    return list(call.state.channels)


def _rename_axes(call: Call) -> Lines:
    call.state.rename_axes([(old, new) for old, new in groups(call, 2)])
    return []


MEMORY_COMMANDS = {
    "HPA?": Command(fixed(_describe), "get list of available parameters"),
    "RPA": Command(_restore, "[{<AxisID> <ParameterID>}] reset volatile memory parameters"),
    "SAI": Command(_rename_axes, "{<AxisID> <NewIdentifier>} set axis identifiers"),
    "SAI?": Command(_list_axes, "[ALL] get list of axis identifiers"),
    "SEP": Command(_set_non_volatile, "<Password> {<AxisID> <ParameterID> <Value>} set non-volatile memory parameters"),
    "SEP?": Command(_get_from(_non_volatile), "[{<AxisID> <ParameterID>}] get non-volatile memory parameters"),
    "SPA": Command(_set_volatile, "{<AxisID> <ParameterID> <Value>} set volatile memory parameters"),
    "SPA?": Command(_get_from(_volatile), "[{<AxisID> <ParameterID>}] get volatile memory parameters"),
    "WPA": Command(_save, "<Password> [{<AxisID> <ParameterID>}] save parameters to non-volatile memory"),
}
