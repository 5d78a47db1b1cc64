"""What all virtual machines share: the folder that the guest runs from, the command's output, and the end."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from .job import GuestFailed, Job
from .setup import Cache

_FIRST_PROCESS = Path(__file__).parent / "guest" / "first_process.sh"
_BOOT_LIMIT_S = 120
"""Allowed on top of the command's own limit, for start and end."""
_LAST_OUTPUT_S = 2.0
_HIDDEN = ("/dev", "/proc", "/run", "/sys")
"""Where the guest has folders of its own in place of the host's."""
_STDOUT, _STDERR = 1, 2
_TROUBLE = re.compile(r"panic|errno|error|fail|cannot|unable", re.IGNORECASE)


class Session:
    """A folder for one run of a guest, which sees it at the same path, and removes it at the end.

    Attributes:
        first_process: the program with which the guest is to start.
        outputs: descriptors to which the machine must send the command's stdout and stderr.
        console: where the machine may write what the guest's kernel says, if not to its own stdout.
    """

    def __init__(self, job: Job, backend: str, cache: Cache, modules: Sequence[str]) -> None:
        self._job = job
        self._backend = backend
        hidden = any(Path(tempfile.gettempdir()).resolve().is_relative_to(folder) for folder in _HIDDEN)
        self._temporary = tempfile.TemporaryDirectory(
            prefix="vcan-run-", dir="/tmp" if hidden else None, ignore_cleanup_errors=True
        )
        self.folder = Path(self._temporary.name).resolve()
        self.first_process = self.folder / _FIRST_PROCESS.name
        self.console = self.folder / "console.log"
        self._machine_log = self.folder / "machine.log"
        shutil.copy(_FIRST_PROCESS, self.first_process)
        self.first_process.chmod(0o755)
        (self.folder / "busybox").symlink_to(cache.busybox)
        (self.folder / "backend").write_text(f"{backend}\n")
        (self.folder / "modules").write_text("".join(f"{line}\n" for line in modules))
        (self.folder / "tmp").mkdir()
        (self.folder / "command").write_bytes(os.fsencode(self._command_script()))
        pipes = [os.pipe(), os.pipe()]
        self.outputs = [write_end for _, write_end in pipes]
        self._relays = [
            _Relay(read_end, stream) for (read_end, _), stream in zip(pipes, (_STDOUT, _STDERR), strict=True)
        ]

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._temporary.cleanup()

    def run(self, machine: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> int:
        """Run the machine, pass the command's output on, and return the command's exit status.

        Any exception, such as a signal's, ends the machine first.

        Raises:
            GuestFailed: there is no such status.
        """
        # `timeout` ends the machine even if this process is killed, and with it the machine's own children. It puts
        # them in a process group of their own: a Ctrl-C at the terminal reaches this process only.
        limit = ["timeout", "-k", "5", str(self._job.limit_s + _BOOT_LIMIT_S)]
        settings = ["env", *(f"{name}={value}" for name, value in (environment or {}).items())]  # not for `timeout`
        with self._machine_log.open("wb") as log:
            process = subprocess.Popen(
                [*limit, *settings, *machine], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                pass_fds=self.outputs, cwd=self.folder,
            )  # fmt: skip
        try:
            for descriptor in self.outputs:
                os.close(descriptor)
            for relay in self._relays:
                relay.start()
            machine_status = self._wait(process)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        for relay in self._relays:
            relay.join(_LAST_OUTPUT_S)
        return self._command_status(machine_status)

    def _wait(self, process: subprocess.Popen[bytes]) -> int:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(_BOOT_LIMIT_S)
        if (self.folder / "started").exists():
            return process.wait()
        raise GuestFailed(self._explain(f"the {self._backend} guest has not started within {_BOOT_LIMIT_S} s"))

    def _command_script(self) -> str:
        """The command with the caller's environment, mask and directory, for the guest's shell."""
        environment = dict(os.environ) | {"TMPDIR": str(self.folder / "tmp"), "VCAN_RUN": self._backend}
        mask = os.umask(0)
        os.umask(mask)
        words = [
            "env", "-i", *(f"{name}={value}" for name, value in environment.items()),
            "timeout", "-k", "10", str(self._job.limit_s), *self._job.command,
        ]  # fmt: skip
        return f"umask {mask:03o}\ncd {shlex.quote(str(Path.cwd()))} || exit 125\nexec {shlex.join(words)}\n"

    def _command_status(self, machine_status: int) -> int:
        if self._job.show_boot_log:
            print(*self._log_lines(), sep="\n", file=sys.stderr)
        status = self.folder / "status"
        if status.exists() and (text := status.read_text().strip()):
            return int(text)
        what = f"the {self._backend} guest ended without the command's exit status (its own: {machine_status})"
        raise GuestFailed(self._explain(what))

    def _log_lines(self) -> list[str]:
        logs = [file.read_text(errors="replace") for file in (self.console, self._machine_log) if file.exists()]
        return "\n".join(logs).splitlines()

    def _explain(self, what: str) -> str:
        failure = self.folder / "failure"
        told = failure.read_text().splitlines() if failure.exists() else []
        lines = [line for line in self._log_lines() if line.strip()]
        trouble = [line for line in lines if _TROUBLE.search(line)][:15]
        return "\n  ".join([what, *told, *(trouble or lines[-5:])])


class _Relay(threading.Thread):
    """Copies what comes out of a pipe to a stream of this process.

    The machine does not get that stream itself: it would change settings that other programs share, such as those of
    a terminal.
    """

    def __init__(self, source: int, target: int) -> None:
        super().__init__(daemon=True)
        self._source = source
        self._target = target

    def run(self) -> None:
        """Copy until the pipe's other end is closed."""
        while data := os.read(self._source, 65536):
            # A reader that has had enough, such as `head`, does not end the guest.
            with contextlib.suppress(BrokenPipeError):
                while data:
                    data = data[os.write(self._target, data) :]
        os.close(self._source)
