"""The command language of the controller, as HLP? lists it.

Not emulated, and answered as unknown commands: macros, joystick, data recorder, open-loop motion, jogging, command
levels, and the assignment of stages by CST (a stage is renamed by its parameter 0x3C).
"""

from __future__ import annotations

from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.command_forms import Call, Command, Lines, fixed, per_axis, require_no_arguments
from microdrivers.fakes.pi_gcs.digital_commands import DIGITAL_COMMANDS
from microdrivers.fakes.pi_gcs.memory_commands import MEMORY_COMMANDS
from microdrivers.fakes.pi_gcs.motion_commands import MOTION_COMMANDS
from microdrivers.fakes.pi_gcs.parameters import Parameter, format_value
from microdrivers.fakes.pi_gcs.state import ControllerState

SINGLE_BYTE_HELP = {
    "#4": "request status register",
    "#5": "request motion status",
    "#7": "request controller ready status",
    "#8": "query if macro is running",
    "#24": "stop all axes",
}


def run_command(name: str, call: Call) -> Lines:
    """Run a command line; the lines of its reply.

    Raises:
        CommandError: it cannot run, and nothing of it has run.
    """
    command = COMMANDS.get(name)
    if command is None:
        raise CommandError(ErrorCode.UNKNOWN_COMMAND)
    return command.run(call)


def _read_error(state: ControllerState) -> Lines:
    error, state.error = state.error, ErrorCode.NONE
    return [str(int(error))]


def _help(_: ControllerState) -> Lines:
    rows = [f"{name} {text}" for name, text in SINGLE_BYTE_HELP.items()]
    rows += [f"{name} {command.text}" for name, command in COMMANDS.items()]
    return ["The following commands are valid:", *sorted(rows), "end of help"]


def _reboot(call: Call) -> Lines:
    require_no_arguments(call)
    call.state.power_cycle(call.t_ns)
    return []


COMMANDS = {
    "*IDN?": Command(fixed(lambda state: [state.identification]), "get device identification"),
    "CST?": Command(
        per_axis(lambda axis, _: format_value(axis.parameters[Parameter.STAGE_NAME])),
        "[{<AxisID>}] get assignment of stages to axes",
    ),
    "CSV?": Command(fixed(lambda _: ["2.0"]), "get current syntax version"),
    "ERR?": Command(fixed(_read_error), "get error number"),
    "HLP?": Command(fixed(_help), "get list of available commands"),
    "RBT": Command(_reboot, "reboot system"),
    "VER?": Command(fixed(lambda _: ["FW_DSP: 01.002"]), "get versions of firmware"),
    **MOTION_COMMANDS,
    **MEMORY_COMMANDS,
    **DIGITAL_COMMANDS,
}
