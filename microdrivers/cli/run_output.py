"""Where a calibration goes: a folder with its result and its recording, and the terminal."""

from __future__ import annotations

import contextlib
import functools
import json
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import click

from microdrivers.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK
from microdrivers.cli.options import COMPRESSION_HELP
from microdrivers.cli.output import write_results
from microdrivers.cli.progress import TerminalProgress

if TYPE_CHECKING:
    from microdrivers.core.bus import Bus
    from microdrivers.core.clock import Clock
    from microdrivers.core.inbox import Inbox
    from microdrivers.recording.recorder import Recorder
    from microdrivers.results.record import Provenance

RECORDING = "run.mcap"
RESULT = "result.json"


class RecordingChoice(NamedTuple):
    """How a run is recorded; `calibration` is that of the optics, for a run that uses one."""

    compress_images: bool
    calibration: Path | None = None


def recording_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options by which a run is recorded; the command gets them as `recording`, None if it is not."""

    @click.option("--record/--no-record", default=True, show_default=True, help="Record all samples in run.mcap.")
    @click.option("--compress-images", is_flag=True, help=f"In run.mcap; {COMPRESSION_HELP}")
    @functools.wraps(command)
    def with_choice(*, record: bool, compress_images: bool, **others: Any) -> None:
        command(recording=RecordingChoice(compress_images) if record else None, **others)

    return with_choice


class Source(Protocol):
    """What a routine draws on."""

    @property
    def bus(self) -> Bus:
        """Where its samples are."""

    @property
    def clock(self) -> Clock:
        """Its time."""


class Shown(Protocol):
    """A result."""

    def as_json(self) -> str:
        """The whole of it."""


class RunOutput:
    """Where one run goes.

    Args:
        kind: of the calibration.
        out: folder; None: `runs/<time>-<kind>/`.
        as_json: the result goes to standard output as JSON, and nothing else does.
        recording: None: it is not recorded.

    Attributes:
        folder: known once the run is `recorded`.
        progress: for the routine.
    """

    folder: Path

    def __init__(self, kind: str, out: Path | None, *, as_json: bool, recording: RecordingChoice | None = None) -> None:
        self.progress = TerminalProgress(quiet=as_json)
        self._kind = kind
        self._out = out
        self._as_json = as_json
        self._choice = recording
        self._recorder: Recorder | None = None

    @contextlib.contextmanager
    def recorded(self, source: Source, known: Mapping[str, Any]) -> Iterator[None]:
        """See that there will be room for a result, and record all that passes.

        If the disk fails meanwhile, the run goes on, and its result tells.

        Args:
            source: of the run's samples.
            known: its provenance, from `describe_rig` or `describe_recorded`.

        Raises:
            ConfigError: the folder cannot be written, or holds a result or a recording already.
        """
        from microdrivers.core.clock import utc_now

        self.folder = self._out if self._out is not None else Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-{self._kind}"
        _check_folder(self.folder)
        if self._choice is None:
            yield
            return
        self._recorder = start_recording(self.folder, self._choice, bus=source.bus, clock=source.clock, known=known)
        with self._recorder:
            yield

    def follow(self, name: str, inbox: Inbox) -> None:
        """Record in which order the samples of an estimator's host arrive, too."""
        if self._recorder is not None:
            self._recorder.follow_arrivals(name, inbox.arrivals)

    def provenance(self, known: Mapping[str, Any]) -> Provenance:
        """Of a result that is made now, by the present command."""
        from microdrivers.core.clock import utc_now
        from microdrivers.routines.provenance import describe_run

        return describe_run(known, command=shlex.join(["microdrivers", *sys.argv[1:]]), now=utc_now())

    @property
    def recording_notes(self) -> list[str]:
        """What a result has to tell of its recording: nothing if that is whole, or if there is none."""
        recorder = self._recorder
        if recorder is None:
            return []
        if recorder.disturbance:
            return [f"The recording {RECORDING} is {recorder.disturbance}."]
        if not (recorder.dropped or recorder.failure):
            return []
        why = f" ({recorder.failure.strerror or recorder.failure})" if recorder.failure is not None else ""
        lacks = f"lacks {recorder.dropped} samples" if recorder.dropped else "lacks its end or an attachment"
        return [
            f"The recording {RECORDING} {lacks} that could not be written{why}; this result was made from all samples."
        ]

    def finish(
        self,
        result: Shown,
        summary: Callable[[], str],
        files: Mapping[str, Callable[[Path], object]],
        *,
        complete: bool,
    ) -> int:
        """Write and show a result.

        Args:
            result: for --json.
            summary: makes what is shown otherwise.
            files: by name, what writes it.
            complete: the run was not interrupted.

        Returns:
            the exit status: also whether the result is written, and all of the run recorded.
        """
        try:
            written = write_results(self.folder, files)
        except KeyboardInterrupt:
            self.close()
            if not self._as_json:
                click.echo(summary())
            raise
        self.close()
        if self._as_json:
            click.echo(result.as_json(), nl=False)
        else:
            click.echo(summary())
            if written:
                click.echo(f"\nwritten to {self.folder}/: {', '.join([*files, *self._recorded_as()])}")
        if not complete:
            return EXIT_INTERRUPTED
        return EXIT_ERROR if self.recording_notes or not written else EXIT_OK

    def close(self) -> None:
        """Leave the terminal to others."""
        self.progress.close()

    def _recorded_as(self) -> list[str]:
        recorder = self._recorder
        if recorder is None:
            return []
        why = "" if recorder.disturbance else " that could not be written"
        lacks = f"; it lacks {recorder.dropped} samples{why}" if recorder.dropped else ""
        return [f"{RECORDING} ({recorder.size / 1e6:.1f} MB{lacks})"]


def start_recording(
    folder: Path, choice: RecordingChoice, *, bus: Bus, clock: Clock, known: Mapping[str, Any]
) -> Recorder:
    """Record all that is published beside a result, with the rig file, the calibration and the provenance.

    Raises:
        ConfigError: the folder holds a recording already, or cannot be written.
    """
    import yaml

    from microdrivers.recording.header import describe_recording
    from microdrivers.recording.recorder import Recorder

    folder.mkdir(parents=True, exist_ok=True)
    header = describe_recording(source="fake" if known["fake"] else "live", seed=known["seed"], rig=known["rig_name"])
    recorder = Recorder(folder / RECORDING, bus=bus, clock=clock, header=header, compress_images=choice.compress_images)
    recorder.attach(
        "rig.yaml", yaml.safe_dump(known["rig"], sort_keys=False, allow_unicode=True).encode(), "application/yaml"
    )
    if choice.calibration is not None:
        recorder.attach("calibration.json", choice.calibration.read_bytes(), "application/json")
    recorder.attach("provenance.json", json.dumps(dict(known), default=str).encode(), "application/json")
    return recorder


def _check_folder(folder: Path) -> None:
    """Find out before the experiment whether its result can be written, there or where the folder can be made."""
    from microdrivers.core.errors import ConfigError

    if (folder / RESULT).exists():
        raise ConfigError(
            f"a {RESULT} is already there, and a result is never overwritten", file=str(folder),
            remedy="choose another --out folder",
        )  # fmt: skip
    existed = folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if not existed:
            folder.rmdir()  # a failed run leaves nothing behind
    except OSError as error:
        raise ConfigError(
            f"nothing can be written there: {error.strerror}", file=str(folder), remedy="choose another --out folder"
        ) from error
