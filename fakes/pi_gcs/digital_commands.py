"""Digital lines and trigger outputs: the controller keeps and tells their settings, but nothing is wired to them.

Inputs read low, and no pulse leaves an output, whatever the trigger settings say.
"""

from __future__ import annotations

from collections.abc import Sequence

from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.command_forms import Call, Command, Lines, fixed, flag, groups
from microdrivers.fakes.pi_gcs.parameters import format_value, read_decimal, read_integer, read_switch
from microdrivers.fakes.pi_gcs.state import LINES, ControllerState, TriggerParameter

_TRIGGER_MODES = {0, 2, 5, 6, 7, 8}
_ALL_LINES = "0"


def _line(text: str) -> int:
    """An output's or input's number.

    Raises:
        CommandError: INVALID_NUMBER or PARAMETER_OUT_OF_RANGE.
    """
    line = read_integer(text)
    if line not in LINES:
        raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
    return line


def _lines_or_all(call: Call) -> list[int]:
    return [_line(text) for (text,) in groups(call, 1)] if call.arguments else list(LINES)


def _lines_with_switches(call: Call) -> list[tuple[int, bool]]:
    return [(_line(line), read_switch(text)) for line, text in groups(call, 2)]


def _trigger_parameter(text: str) -> TriggerParameter:
    try:
        return TriggerParameter(read_integer(text))
    except ValueError:
        raise CommandError(ErrorCode.UNKNOWN_PARAMETER) from None


def _trigger_value(state: ControllerState, parameter: TriggerParameter, text: str) -> float | int | str:
    if parameter is TriggerParameter.AXIS:
        return state.axes_named([text])[0].identifier
    if parameter is TriggerParameter.POLARITY:
        return int(read_switch(text))
    if parameter is TriggerParameter.MODE:
        mode = read_integer(text)
        if mode not in _TRIGGER_MODES:
            raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
        return mode
    return read_decimal(text)


def _set_outputs(call: Call) -> Lines:
    call.state.digital.outputs.update(_lines_with_switches(call))
    return []


def _read_inputs(call: Call) -> Lines:
    if list(call.arguments) == [_ALL_LINES]:
        return [f"{_ALL_LINES}=0"]
    return [f"{line}=0" for line in _lines_or_all(call)]


def _configure_trigger(call: Call) -> Lines:
    settings = []
    for line, name, text in groups(call, 3):
        number, parameter = _line(line), _trigger_parameter(name)
        settings.append((number, parameter, _trigger_value(call.state, parameter, text)))
    for number, parameter, value in settings:
        call.state.digital.triggers[number][parameter] = value
    return []


def _trigger_configuration(call: Call) -> Lines:
    asked: Sequence[tuple[int, TriggerParameter]] = (
        [(_line(line), _trigger_parameter(name)) for line, name in groups(call, 2)]
        if call.arguments
        else [(line, parameter) for line in LINES for parameter in TriggerParameter]
    )
    triggers = call.state.digital.triggers
    return [f"{line} {parameter:d}={format_value(triggers[line][parameter])}" for line, parameter in asked]


def _enable_triggers(call: Call) -> Lines:
    call.state.digital.triggering.update(_lines_with_switches(call))
    return []


def _enabled_triggers(call: Call) -> Lines:
    return [f"{line}={flag(call.state.digital.triggering[line])}" for line in _lines_or_all(call)]


DIGITAL_COMMANDS = {
    "CTO": Command(_configure_trigger, "{<TrigOutID> <CTOPam> <Value>} set configuration of trigger output"),
    "CTO?": Command(_trigger_configuration, "[{<TrigOutID> <CTOPam>}] get configuration of trigger output"),
    "DIO": Command(_set_outputs, "{<DIOID> <OutputOn>} set digital output lines"),
    "DIO?": Command(_read_inputs, "[{<DIOID>}] get digital input lines"),
    "TIO?": Command(fixed(lambda _: [f"I={len(LINES)}", f"O={len(LINES)}"]), "tell digital I/O lines"),
    "TRO": Command(_enable_triggers, "{<TrigOutID> <TrigMode>} set trigger output state"),
    "TRO?": Command(_enabled_triggers, "[{<TrigOutID>}] get trigger output state"),
}
