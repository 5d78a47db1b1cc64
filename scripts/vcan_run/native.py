"""This machine's own kernel."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterable
from pathlib import Path

from .job import RAN_TOO_LONG, Job, NotUsable

_INTERFACES = ("vcan0", "vcan1")
_UP = 0x1  # IFF_UP, linux/if.h
_GRACE_S = 10.0


def bring_up() -> bool:
    """Whether both interfaces are up, now or after root's or sudo's help."""
    if all(_is_up(interface) for interface in _INTERFACES):
        return True
    root = _as_root()
    if root is None or shutil.which("ip") is None:
        return False
    _succeeds([*root, "modprobe", "-a", "vcan", "can_raw"])  # fails where they are built in
    for interface in _INTERFACES:
        if not _flags(interface).exists() and not _succeeds([*root, "ip", "link", "add", interface, "type", "vcan"]):
            return False
        _succeeds([*root, "ip", "link", "set", interface, "mtu", "72"])  # CAN FD too; refused while it is up
        if not _succeeds([*root, "ip", "link", "set", interface, "up"]):
            return False
    return True


def run(job: Job) -> int:
    """Run the command; its exit status.

    Raises:
        NotUsable: a kernel module cannot be loaded, or the command cannot be started.
    """
    _load(job.modules)
    environment = {**os.environ, "VCAN_RUN": "native"}
    try:
        process = subprocess.Popen(job.command, stdin=subprocess.DEVNULL, env=environment, process_group=0)
    except OSError as error:
        raise NotUsable(f"cannot run {job.command[0]}: {error.strerror}") from error
    try:
        status = process.wait(job.limit_s)
    except subprocess.TimeoutExpired:
        return RAN_TOO_LONG
    finally:
        _end_group(process)
    return status if status >= 0 else 128 - status


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """End a command that still runs, with what it started: it is in a process group of its own."""
    for signal_number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            os.killpg(process.pid, signal_number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_GRACE_S)


def _load(modules: Iterable[str]) -> None:
    root = _as_root()
    for module in modules:
        if root is None or not _succeeds([*root, "modprobe", module]):
            raise NotUsable(f"cannot load the kernel module '{module}' (as root: modprobe {module})")


def _as_root() -> list[str] | None:
    """What to put before a command so that root runs it; None if that needs a password."""
    if os.geteuid() == 0:
        return []
    sudo = ["sudo", "-n"]
    return sudo if shutil.which("sudo") and _succeeds([*sudo, "true"]) else None


def _flags(interface: str) -> Path:
    return Path("/sys/class/net") / interface / "flags"


def _is_up(interface: str) -> bool:
    flags = _flags(interface)
    return flags.exists() and bool(int(flags.read_text(), 16) & _UP)


def _succeeds(command: list[str]) -> bool:
    try:
        return subprocess.run(command, capture_output=True).returncode == 0
    except FileNotFoundError:
        return False
