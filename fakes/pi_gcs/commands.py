"""The command language: each mnemonic with its help text and what it does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel, ReferenceMove
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.parameters import (
    DESCRIPTIONS,
    Parameter,
    check_parameter,
    check_rate,
    format_decimal,
    format_value,
    one_count,
    read_decimal,
    read_parameter,
    read_switch,
)
from microdrivers.fakes.pi_gcs.state import ControllerState

Lines = list[str]


class Call(NamedTuple):
    """One command: its arguments and the instant at which its last byte arrived."""

    state: ControllerState
    arguments: Sequence[str]
    t_ns: int


class Command(NamedTuple):
    """What a mnemonic does; a query returns the lines of its reply, anything else returns none."""

    run: Callable[[Call], Lines]
    text: str


def run_command(name: str, call: Call) -> Lines:
    """Run a command line; the lines of its reply.

    Raises:
        CommandError: it cannot run, and nothing of it has run.
    """
    command = COMMANDS.get(name)
    if command is None:
        raise CommandError(ErrorCode.UNKNOWN_COMMAND)
    return command.run(call)


# ---------------------------------------------------------------------- forms of commands


def _fixed(reply: Callable[[ControllerState], Lines]) -> Callable[[Call], Lines]:
    """A query without arguments."""

    def run(call: Call) -> Lines:
        _require_no_arguments(call)
        return reply(call.state)

    return run


def _per_axis(value: Callable[[AxisChannel, int], str]) -> Callable[[Call], Lines]:
    """A query of some or all axes."""

    def run(call: Call) -> Lines:
        channels = call.state.axes_or_all(call.arguments)
        return [f"{channel.spec.identifier}={value(channel, call.t_ns)}" for channel in channels]

    return run


def _require_no_arguments(call: Call) -> None:
    if call.arguments:
        raise CommandError(ErrorCode.WRONG_NUMBER_OF_PARAMETERS)


def _groups(arguments: Sequence[str], size: int) -> list[Sequence[str]]:
    if len(arguments) < size:
        raise CommandError(ErrorCode.PARAMETER_MISSING)
    if len(arguments) % size:
        raise CommandError(ErrorCode.WRONG_NUMBER_OF_PARAMETERS)
    return [arguments[i : i + size] for i in range(0, len(arguments), size)]


def _axes_with_texts(call: Call) -> list[tuple[AxisChannel, str]]:
    pairs = _groups(call.arguments, 2)
    channels = call.state.axes_named([axis for axis, _ in pairs])
    return list(zip(channels, [text for _, text in pairs], strict=True))


def _axes_with_numbers(call: Call) -> list[tuple[AxisChannel, float]]:
    return [(channel, read_decimal(text)) for channel, text in _axes_with_texts(call)]


def _axes_with_switches(call: Call) -> list[tuple[AxisChannel, bool]]:
    return [(channel, read_switch(text)) for channel, text in _axes_with_texts(call)]


def _flag(is_set: object) -> str:
    return "1" if is_set else "0"


def _parameter_of_axis(parameter: Parameter) -> Callable[[Call], Lines]:
    return _per_axis(lambda channel, _: format_value(channel.parameters[parameter]))


# ---------------------------------------------------------------------- the controller


def _read_error(state: ControllerState) -> Lines:
    error, state.error = state.error, ErrorCode.NONE
    return [str(int(error))]


def _list_axes(call: Call) -> Lines:
    if [word.upper() for word in call.arguments] not in ([], ["ALL"]):
        raise CommandError(ErrorCode.PARAMETER_SYNTAX)
    return list(call.state.channels)


def _help(_: ControllerState) -> Lines:
    rows = [f"{name} {text}" for name, text in SINGLE_BYTE_HELP.items()]
    rows += [f"{name} {command.text}" for name, command in COMMANDS.items()]
    return ["The following commands are valid:", *sorted(rows), "end of help"]


def _reboot(call: Call) -> Lines:
    _require_no_arguments(call)
    call.state.power_cycle(call.t_ns)
    return []


# ---------------------------------------------------------------------- servo and reference


def _set_servo(call: Call) -> Lines:
    for channel, on in _axes_with_switches(call):
        if on != channel.servo:
            call.state.note(call.t_ns, f"servo {channel.spec.key} {'on' if on else 'off'}")
        channel.set_servo(on, call.t_ns)
    return []


def _set_reference_mode(call: Call) -> Lines:
    for channel, on in _axes_with_switches(call):
        channel.reference_mode = on
    return []


def _find_reference(mode: ReferenceMove) -> Callable[[Call], Lines]:
    def run(call: Call) -> Lines:
        channels = call.state.axes_or_all(call.arguments)
        for channel in channels:
            channel.check_reference_move(mode)
        for channel in channels:
            channel.find_reference(mode, call.t_ns)
            call.state.note(call.t_ns, f"reference {channel.spec.key} {mode}")
        return []

    return run


def _define_position(call: Call) -> Lines:
    pairs = _axes_with_numbers(call)
    for channel, position in pairs:
        channel.check_define_position(position, call.t_ns)
    for channel, position in pairs:
        channel.define_position(position, call.t_ns)
        call.state.note(call.t_ns, f"define {channel.spec.key} {position:.7g}")
    return []


# ---------------------------------------------------------------------- motion


def _move_to(call: Call, targets: Sequence[tuple[AxisChannel, float]]) -> Lines:
    for channel, target in targets:
        channel.check_move(target)
    for channel, target in targets:
        channel.move(target, call.t_ns)
        call.state.note(call.t_ns, f"move {channel.spec.key} {target:.7g}")
    return []


def _move(call: Call) -> Lines:
    return _move_to(call, _axes_with_numbers(call))


def _move_relative(call: Call) -> Lines:
    return _move_to(call, [(channel, channel.target + distance) for channel, distance in _axes_with_numbers(call)])


def _halt(call: Call) -> Lines:
    for channel in call.state.axes_or_all(call.arguments):
        channel.stop(call.t_ns, abrupt=False)
        call.state.note(call.t_ns, f"halt {channel.spec.key}")
    call.state.error = ErrorCode.STOPPED_BY_COMMAND
    return []


def _stop(call: Call) -> Lines:
    _require_no_arguments(call)
    call.state.stop_all(call.t_ns, "STP")
    return []


def _positions(call: Call) -> Lines:
    latch_ns = call.t_ns + call.state.pose_latch_delay_ns
    return _per_axis(lambda channel, _: format_decimal(channel.reading_at(latch_ns)))(call)


def _set_rate(parameter: Parameter, maximum: Parameter, code: ErrorCode) -> Callable[[Call], Lines]:
    def run(call: Call) -> Lines:
        pairs = _axes_with_numbers(call)
        for channel, rate in pairs:
            known = channel.parameters
            check_rate(rate, float(known[maximum]), one_count(known), code=code)
        for channel, rate in pairs:
            channel.parameters[parameter] = rate
        return []

    return run


# ---------------------------------------------------------------------- parameters


def _set_parameters(call: Call) -> Lines:
    triples = _groups(call.arguments, 3)
    drafts = {axis: dict(call.state.axes_named([axis])[0].parameters) for axis, _, _ in triples}
    for axis, name, text in triples:
        parameter = read_parameter(name)
        travel = call.state.channels[axis].physical_travel
        drafts[axis][parameter] = check_parameter(parameter, text, drafts[axis], travel)
    for axis, draft in drafts.items():
        call.state.channels[axis].parameters = draft
    return []


def _get_parameters(call: Call) -> Lines:
    channels = call.state.channels
    asked = (
        [(axis, name) for axis, name in _groups(call.arguments, 2)]
        if call.arguments
        else [(axis, f"0x{parameter:X}") for axis in channels for parameter in Parameter]
    )
    return [
        f"{axis} {name}={format_value(call.state.axes_named([axis])[0].parameters[read_parameter(name)])}"
        for axis, name in asked
    ]


def _describe_parameters(_: ControllerState) -> Lines:
    kinds = {int: "INT", float: "FLOAT", str: "CHAR"}
    rows = [
        f"0x{parameter:X}=\t{int(row.protected)}\t1\t{kinds[row.kind]}\t{row.group}\t{row.text}"
        for parameter, row in DESCRIPTIONS.items()
    ]
    return [*rows, "end of help"]


SINGLE_BYTE_HELP = {
    "#4": "request status register",
    "#5": "request motion status",
    "#7": "request controller ready status",
    "#8": "query if macro is running",
    "#24": "stop all axes",
}

COMMANDS = {
    "*IDN?": Command(_fixed(lambda state: [state.identification]), "get device identification"),
    "ACC": Command(
        _set_rate(Parameter.ACCELERATION, Parameter.MAX_ACCELERATION, ErrorCode.PARAMETER_OUT_OF_RANGE),
        "{<AxisID> <Acceleration>} set closed-loop acceleration",
    ),
    "ACC?": Command(_parameter_of_axis(Parameter.ACCELERATION), "[{<AxisID>}] get closed-loop acceleration"),
    "CST?": Command(_parameter_of_axis(Parameter.STAGE_NAME), "[{<AxisID>}] get assignment of stages to axes"),
    "CSV?": Command(_fixed(lambda _: ["2.0"]), "get current syntax version"),
    "DEC": Command(
        _set_rate(Parameter.DECELERATION, Parameter.MAX_DECELERATION, ErrorCode.PARAMETER_OUT_OF_RANGE),
        "{<AxisID> <Deceleration>} set closed-loop deceleration",
    ),
    "DEC?": Command(_parameter_of_axis(Parameter.DECELERATION), "[{<AxisID>}] get closed-loop deceleration"),
    "ERR?": Command(_fixed(_read_error), "get error number"),
    "FNL": Command(_find_reference("FNL"), "[{<AxisID>}] fast reference move to negative limit"),
    "FPL": Command(_find_reference("FPL"), "[{<AxisID>}] fast reference move to positive limit"),
    "FRF": Command(_find_reference("FRF"), "[{<AxisID>}] fast reference move to reference switch"),
    "FRF?": Command(_per_axis(lambda axis, _: _flag(axis.referenced)), "[{<AxisID>}] get referencing result"),
    "HLP?": Command(_fixed(_help), "get list of available commands"),
    "HLT": Command(_halt, "[{<AxisID>}] halt motion smoothly"),
    "HPA?": Command(_fixed(_describe_parameters), "get list of available parameters"),
    "LIM?": Command(
        _per_axis(lambda axis, _: _flag(not axis.parameters[Parameter.HAS_NO_LIMITS])),
        "[{<AxisID>}] indicate limit switches",
    ),
    "MOV": Command(_move, "{<AxisID> <Position>} set target position"),
    "MOV?": Command(_per_axis(lambda axis, _: format_decimal(axis.target)), "[{<AxisID>}] get target position"),
    "MVR": Command(_move_relative, "{<AxisID> <Distance>} set target relative to last target"),
    "ONT?": Command(_per_axis(lambda axis, t_ns: _flag(axis.on_target_at(t_ns))), "[{<AxisID>}] get on-target state"),
    "POS": Command(_define_position, "{<AxisID> <Position>} set real position"),
    "POS?": Command(_positions, "[{<AxisID>}] get real position"),
    "RBT": Command(_reboot, "reboot system"),
    "RON": Command(_set_reference_mode, "{<AxisID> <ReferenceOn>} set reference mode"),
    "RON?": Command(_per_axis(lambda axis, _: _flag(axis.reference_mode)), "[{<AxisID>}] get reference mode"),
    "SAI?": Command(_list_axes, "[ALL] get list of axis identifiers"),
    "SPA": Command(_set_parameters, "{<AxisID> <ParameterID> <Value>} set volatile memory parameters"),
    "SPA?": Command(_get_parameters, "[{<AxisID> <ParameterID>}] get volatile memory parameters"),
    "STP": Command(_stop, "stop all axes"),
    "SVO": Command(_set_servo, "{<AxisID> <ServoState>} set servo mode"),
    "SVO?": Command(_per_axis(lambda axis, _: _flag(axis.servo)), "[{<AxisID>}] get servo mode"),
    "TMN?": Command(_parameter_of_axis(Parameter.MIN_TRAVEL), "[{<AxisID>}] get minimum commandable position"),
    "TMX?": Command(_parameter_of_axis(Parameter.MAX_TRAVEL), "[{<AxisID>}] get maximum commandable position"),
    "TRS?": Command(
        _per_axis(lambda axis, _: _flag(axis.parameters[Parameter.HAS_REFERENCE])),
        "[{<AxisID>}] indicate reference switch",
    ),
    "VEL": Command(
        _set_rate(Parameter.VELOCITY, Parameter.MAX_VELOCITY, ErrorCode.VELOCITY_OUT_OF_LIMITS),
        "{<AxisID> <Velocity>} set closed-loop velocity",
    ),
    "VEL?": Command(_parameter_of_axis(Parameter.VELOCITY), "[{<AxisID>}] get closed-loop velocity"),
    "VER?": Command(_fixed(lambda _: ["FW_DSP: 01.002"]), "get versions of firmware"),
}
