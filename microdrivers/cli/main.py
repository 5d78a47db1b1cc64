"""`microdrivers`: the commands, and how errors reach the user. Imports nothing heavy, so that --help is instant."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import stat
import sys
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from microdrivers import __version__
from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED

if TYPE_CHECKING:
    from microdrivers.core.errors import MicrodriversError

SERVED = "microdrivers.served"
"""In a command's context: whether its devices are emulated by another program."""

AS_JSON = "microdrivers.as_json"
"""In a command's context: whether its standard output is read by another program."""

_INTERRUPTION_MODULE = "microdrivers.core.clock.interruption"

_SERVED_HINT = (
    "these devices are emulated: see that `microdrivers serve` runs, and that this computer is not too busy for it"
)


class CommandLine(click.Group):
    """Turns errors raised on purpose into one clear message; a traceback only with --debug."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        from microdrivers.core.errors import MicrodriversError

        try:
            return super().invoke(ctx)
        except MicrodriversError as error:
            if ctx.params.get("debug"):
                raise
            if ctx.meta.get(AS_JSON):
                from microdrivers.cli.output import error_as_json

                click.echo(error_as_json(error))
            click.secho("error: ", fg="red", bold=True, nl=False, err=True)
            click.echo(str(error), err=True)
            if ctx.meta.get(SERVED) and _may_be_the_servers(error):
                click.echo(f"  {_SERVED_HINT}", err=True)
            ctx.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            click.echo("\ninterrupted; whatever was open has been told to stop and was closed", err=True)
            ctx.exit(EXIT_INTERRUPTED)


@click.group(cls=CommandLine, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, "-V", "--version")
@click.option("--debug", is_flag=True, help="Show tracebacks and debug messages.")
def main(debug: bool) -> None:
    """Run, check and calibrate a micromanipulation rig described in one YAML file.

    \b
    Examples:
      microdrivers calibrate optics                      the paper's experiment on an emulated workstation
      microdrivers calibrate optics --rig lab.yaml --fake
      microdrivers calibrate optics --images DIR         from a recorded image sequence
      microdrivers calibrate force                       a specimen's springs and damper, emulated
      microdrivers check lab.yaml                        validate a rig file without hardware
      microdrivers doctor lab.yaml                       what is wrong with the rig, and what to try
      microdrivers reference lab.yaml --axes x,y         find the reference of a stage (moves!)
      microdrivers move lab.yaml sample_stage --x-um 7600
      microdrivers record lab.yaml --for 60              everything that the devices tell, frames included
    """
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, format="%(levelname)s: %(message)s")
    # Also where a shell has started us with SIGINT ignored: whoever drives stages must be stoppable.
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup asks to go on
        signal.signal(signal.SIGHUP, _hang_up)


def _may_be_the_servers(error: MicrodriversError) -> bool:
    """Whether the program that emulates the devices may be the cause: it has ended, or is starved."""
    from microdrivers.core.errors import LinkError

    return isinstance(error, LinkError) or "heartbeat" in error.what or "no reading" in error.what


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    """Ctrl-C and being terminated: stop the stages, at the next clean moment; a second signal does not wait for it."""
    # Not imported here: the signal may have come amid an import of the same modules.
    interruption = getattr(sys.modules.get(_INTERRUPTION_MODULE), "INTERRUPTION", None)
    if interruption is None:  # nobody has opened anything
        raise KeyboardInterrupt
    interruption.request()


def _hang_up(number: int, frame: FrameType | None) -> None:
    """The terminal is gone, or the ssh session dropped: as Ctrl-C, and what is still said must not fail."""
    signal.signal(number, lambda _number, _frame: None)  # shell and system may both tell: that is one request
    silent = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):
                os.dup2(silent, descriptor)
    os.close(silent)
    _interrupt(number, frame)


def _add(group: click.Group, name: str, module: str, attribute: str, short_help: str) -> None:
    """Add a command whose module is imported only when it is called or its help is asked for."""
    group.add_command(_LazyCommand(name, module, attribute, short_help))


class _LazyCommand(click.Command):
    def __init__(self, name: str, module: str, attribute: str, short_help: str) -> None:
        super().__init__(name, short_help=short_help)
        self._module = module
        self._attribute = attribute

    def _real(self) -> click.Command:
        import importlib

        command: click.Command = getattr(importlib.import_module(self._module), self._attribute)
        return command

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        context = self._real().make_context(info_name, args, parent, **extra)
        context.meta[AS_JSON] = bool(context.params.get("as_json"))
        return context

    def get_short_help_str(self, limit: int = 45) -> str:  # noqa: ARG002 - click's signature
        return self.short_help or ""


@main.group()
def calibrate() -> None:
    """Calibrate a part of the rig and write result, calibration and report."""


@main.group()
def recording() -> None:
    """Look after recordings."""


_add(calibrate, "optics", "microdrivers.cli.calibrate", "optics", "Camera to stage, through a zoom change.")
_add(calibrate, "force", "microdrivers.cli.calibrate_force", "force", "A specimen's springs and damper.")
_add(main, "check", "microdrivers.cli.check", "check", "Validate a rig file without touching hardware.")
_add(main, "status", "microdrivers.cli.status", "status", "Who answers, and in which state; nothing moves.")
_add(main, "doctor", "microdrivers.cli.doctor", "doctor", "Examine every device: what is wrong, what to try.")
_add(main, "reference", "microdrivers.cli.reference", "reference", "Find the reference of a stage or zoom (moves!).")
_add(main, "move", "microdrivers.cli.move", "move", "Move a stage or the zoom, and wait until settled.")
_add(main, "stop", "microdrivers.cli.stop", "stop", "Stop everything that moves, now.")
_add(main, "clear-fault", "microdrivers.cli.clear_fault", "clear_fault", "Clear a device's fault, its cause removed.")
_add(main, "serve", "microdrivers.cli.serve", "serve", "Put every emulator of a rig on a port for other programs.")
_add(main, "snap", "microdrivers.cli.snap", "snap", "Take one fresh frame and write it to a file.")
_add(main, "record", "microdrivers.cli.record", "record", "Record what every device tells, frames included.")
_add(main, "replay", "microdrivers.cli.replay", "replay", "Publish a recording again, in recorded order.")
_add(main, "info", "microdrivers.cli.info", "info", "What a recording holds, and what it has lost.")
_add(main, "export", "microdrivers.cli.export", "export", "A recording as CSV, Parquet, HDF5, images or video.")
_add(main, "analyse", "microdrivers.cli.analyse", "analyse", "Analyse many recordings into one table.")
_add(recording, "repair", "microdrivers.cli.recording", "repair", "Make a torn recording readable by any tool.")
