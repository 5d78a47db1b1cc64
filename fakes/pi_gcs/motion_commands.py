"""Servo, reference moves, motion, and what the controller says about them."""

from __future__ import annotations

from collections.abc import Sequence

from microdrivers.fakes.pi_gcs.axis_channel import AxisChannel, ReferenceMove
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.command_forms import (
    Call,
    Command,
    Lines,
    Run,
    axes_or_all,
    axes_with_numbers,
    axes_with_switches,
    flag,
    groups,
    per_axis,
    require_no_arguments,
)
from microdrivers.fakes.pi_gcs.parameters import Parameter, check_rate, format_decimal, format_value, one_count

_STATUS_REGISTER = "1"


def _parameter(parameter: Parameter) -> Run:
    return per_axis(lambda channel, _: format_value(channel.parameters[parameter]))


# ---------------------------------------------------------------------- servo and reference


def _set_servo(call: Call) -> Lines:
    for channel, on in axes_with_switches(call):
        if on != channel.servo:
            call.state.note(call.t_ns, f"servo {channel.spec.key} {'on' if on else 'off'}")
        channel.set_servo(on, call.t_ns)
    return []


def _set_reference_mode(call: Call) -> Lines:
    for channel, on in axes_with_switches(call):
        channel.reference_mode = on
    return []


def _find_reference(mode: ReferenceMove) -> Run:
    def run(call: Call) -> Lines:
        channels = axes_or_all(call)
        for channel in channels:
            channel.check_reference_move(mode)
        for channel in channels:
            channel.find_reference(mode, call.t_ns)
            call.state.note(call.t_ns, f"reference {channel.spec.key} {mode}")
        return []

    return run


def _define_position(call: Call) -> Lines:
    pairs = axes_with_numbers(call)
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
    return _move_to(call, axes_with_numbers(call))


def _move_relative(call: Call) -> Lines:
    return _move_to(call, [(channel, channel.target + distance) for channel, distance in axes_with_numbers(call)])


def _halt(call: Call) -> Lines:
    for channel in axes_or_all(call):
        channel.stop(call.t_ns, abrupt=False)
        call.state.note(call.t_ns, f"halt {channel.spec.key}")
    call.state.error = ErrorCode.STOPPED_BY_COMMAND
    return []


def _stop(call: Call) -> Lines:
    require_no_arguments(call)
    call.state.stop_all(call.t_ns, "STP")
    return []


def _set_rate(parameter: Parameter, maximum: Parameter, code: ErrorCode) -> Run:
    def run(call: Call) -> Lines:
        pairs = axes_with_numbers(call)
        for channel, rate in pairs:
            known = channel.parameters
            check_rate(rate, float(known[maximum]), one_count(known), code=code)
        for channel, rate in pairs:
            channel.parameters[parameter] = rate
        return []

    return run


# ---------------------------------------------------------------------- what it says


def _positions(call: Call) -> Lines:
    latch_ns = call.t_ns + call.state.pose_latch_delay_ns
    return per_axis(lambda channel, _: format_decimal(channel.reading_at(latch_ns)))(call)


def _registers(call: Call) -> Lines:
    asked = groups(call, 2) if call.arguments else [(axis, _STATUS_REGISTER) for axis in call.state.channels]
    channels = call.state.axes_named([axis for axis, _ in asked])
    if any(register != _STATUS_REGISTER for _, register in asked):
        raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)
    error = call.state.error is not ErrorCode.NONE
    return [
        f"{channel.identifier} {_STATUS_REGISTER}=0x{channel.status_at(call.t_ns, error=error):04X}"
        for channel in channels
    ]


MOTION_COMMANDS = {
    "ACC": Command(
        _set_rate(Parameter.ACCELERATION, Parameter.MAX_ACCELERATION, ErrorCode.PARAMETER_OUT_OF_RANGE),
        "{<AxisID> <Acceleration>} set closed-loop acceleration",
    ),
    "ACC?": Command(_parameter(Parameter.ACCELERATION), "[{<AxisID>}] get closed-loop acceleration"),
    "DEC": Command(
        _set_rate(Parameter.DECELERATION, Parameter.MAX_DECELERATION, ErrorCode.PARAMETER_OUT_OF_RANGE),
        "{<AxisID> <Deceleration>} set closed-loop deceleration",
    ),
    "DEC?": Command(_parameter(Parameter.DECELERATION), "[{<AxisID>}] get closed-loop deceleration"),
    "FNL": Command(_find_reference("FNL"), "[{<AxisID>}] fast reference move to negative limit"),
    "FPL": Command(_find_reference("FPL"), "[{<AxisID>}] fast reference move to positive limit"),
    "FRF": Command(_find_reference("FRF"), "[{<AxisID>}] fast reference move to reference switch"),
    "FRF?": Command(per_axis(lambda axis, _: flag(axis.referenced)), "[{<AxisID>}] get referencing result"),
    "HLT": Command(_halt, "[{<AxisID>}] halt motion smoothly"),
    "LIM?": Command(
        per_axis(lambda axis, _: flag(not axis.parameters[Parameter.HAS_NO_LIMITS])),
        "[{<AxisID>}] indicate limit switches",
    ),
    "MOV": Command(_move, "{<AxisID> <Position>} set target position"),
    "MOV?": Command(per_axis(lambda axis, _: format_decimal(axis.target)), "[{<AxisID>}] get target position"),
    "MVR": Command(_move_relative, "{<AxisID> <Distance>} set target relative to last target"),
    "ONT?": Command(per_axis(lambda axis, t_ns: flag(axis.on_target_at(t_ns))), "[{<AxisID>}] get on-target state"),
    "POS": Command(_define_position, "{<AxisID> <Position>} set real position"),
    "POS?": Command(_positions, "[{<AxisID>}] get real position"),
    "RON": Command(_set_reference_mode, "{<AxisID> <ReferenceOn>} set reference mode"),
    "RON?": Command(per_axis(lambda axis, _: flag(axis.reference_mode)), "[{<AxisID>}] get reference mode"),
    "SRG?": Command(_registers, "[{<AxisID> <RegisterID>}] get status register value"),
    "STP": Command(_stop, "stop all axes"),
    "SVO": Command(_set_servo, "{<AxisID> <ServoState>} set servo mode"),
    "SVO?": Command(per_axis(lambda axis, _: flag(axis.servo)), "[{<AxisID>}] get servo mode"),
    "TMN?": Command(_parameter(Parameter.MIN_TRAVEL), "[{<AxisID>}] get minimum commandable position"),
    "TMX?": Command(_parameter(Parameter.MAX_TRAVEL), "[{<AxisID>}] get maximum commandable position"),
    "TRS?": Command(
        per_axis(lambda axis, _: flag(axis.parameters[Parameter.HAS_REFERENCE])),
        "[{<AxisID>}] indicate reference switch",
    ),
    "VEL": Command(
        _set_rate(Parameter.VELOCITY, Parameter.MAX_VELOCITY, ErrorCode.VELOCITY_OUT_OF_LIMITS),
        "{<AxisID> <Velocity>} set closed-loop velocity",
    ),
    "VEL?": Command(_parameter(Parameter.VELOCITY), "[{<AxisID>}] get closed-loop velocity"),
}
