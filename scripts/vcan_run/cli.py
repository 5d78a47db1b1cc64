"""Options, choice of the backend, exit statuses."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Sequence
from types import FrameType

from . import native, qemu, uml
from .job import GUEST_FAILED, WRONG_USE, GuestFailed, Job, NotUsable
from .setup import Cache, say, set_up_qemu, set_up_uml

_DESCRIPTION = "Run a command where the SocketCAN interfaces vcan0 and vcan1 are up."
_DETAILS = """\
backends:
  native  this kernel: modprobe vcan, ip link add (root or passwordless sudo), if they are not up already
  uml     User Mode Linux: starts in 2-3 s, Python at full speed, system calls slower; CAN only; needs no root.
  qemu    emulated PC: starts in about 10 s, Python 20-30 times slower; also /dev/video0 (vivid) and two 16550A
          UARTs wired to each other, /dev/ttyS1 and /dev/ttyS2; as root, the guest can read what root can
  auto    the first of native, uml, qemu that can run here (default)

virtual time (-s), in which nothing is late because the host is busy or the guest slow:
  uml     what the guest waits for comes at once. Even without -s its clock stands still while it is not let run
  qemu    the clock counts instructions, 1 ns each; twice as slow. Not with KVM

further kernel modules (-k) that are of use with qemu:
  kvaser_pci                             can0 and can1, SJA1000 controllers on one bus (set the bitrate, then up)
  dummy_hcd usb_f_acm g_serial cdc-acm   a USB CDC-ACM pair, /dev/ttyACM0 and /dev/ttyGS0

The command gets the caller's environment and directory, no stdin, and VCAN_RUN, the backend's name. In a guest it also
gets a TMPDIR in memory and only the loopback network; files that it writes elsewhere are this machine's.

exit status: the command's; 124 if it ran longer than -t; 125 if the guest failed; 2 on wrong use or if not set up.

What --setup fetches lies in $MICRODRIVERS_VM_CACHE, or microdrivers/vm in the user's cache folder.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vcan-run", description=_DESCRIPTION, epilog=_DETAILS, allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="vcan-run [-b BACKEND] [-t SECONDS] [-m MIB] [-k MODULES] [-s] [-v] [--] COMMAND [ARG...]\n"
        "       vcan-run --setup {auto,uml,qemu}",
    )  # fmt: skip
    parser.add_argument("-b", "--backend", choices=("auto", "native", "uml", "qemu"), default="auto")
    parser.add_argument("-t", "--limit", type=_positive, default=900, metavar="SECONDS", help="time limit (900)")
    parser.add_argument("-m", "--memory", type=_positive, default=1024, metavar="MIB", help="of a guest (1024)")
    parser.add_argument("-k", "--modules", action="append", default=[], help="further kernel modules to load")
    parser.add_argument("-s", "--virtual-time", action="store_true", help="see below; for guests only")
    parser.add_argument("-v", "--verbose", action="store_true", help="show what the guest's kernel says")
    parser.add_argument(
        "--setup", choices=("auto", "uml", "qemu"),
        help="fetch what a backend needs (Debian, Ubuntu); auto: uml, unless this kernel has vcan",
    )  # fmt: skip
    parser.add_argument("command", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line says; the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    command = options.command[1:] if options.command[:1] == ["--"] else options.command
    if bool(command) == bool(options.setup):
        parser.error("give a command, or --setup")
    for signal_number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(signal_number, _end)
    cache = Cache()
    try:
        if options.setup:
            _set_up(options.setup, cache)
            return 0
        job = Job(
            command=tuple(command),
            limit_s=options.limit,
            memory_mib=options.memory,
            modules=tuple(name for names in options.modules for name in names.split()),
            show_boot_log=options.verbose,
            virtual_time=options.virtual_time,
        )
        return _run(options.backend, job, cache)
    except NotUsable as error:
        say(str(error))
        return WRONG_USE
    except GuestFailed as error:
        say(str(error))
        return GUEST_FAILED
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _set_up(backend: str, cache: Cache) -> None:
    if backend == "qemu":
        set_up_qemu(cache)
    elif backend == "uml" or not native.bring_up():
        set_up_uml(cache)


def _run(backend: str, job: Job, cache: Cache) -> int:
    if backend in ("native", "auto") and native.bring_up():
        return native.run(job)
    if backend == "native":
        raise NotUsable("this kernel has no usable vcan (as root: modprobe vcan; ip link add vcan0 type vcan)")
    if backend == "uml" or (backend == "auto" and cache.has_uml):
        return uml.run(job, cache)
    if backend == "qemu" or cache.has_qemu:
        return qemu.run(job, cache)
    raise NotUsable(
        "no vcan here: run vcan-run --setup uml (or qemu), or on a kernel that has the module: modprobe vcan as root"
    )


def _positive(text: str) -> int:
    number = int(text)
    if number <= 0:
        raise argparse.ArgumentTypeError("must be a positive whole number")
    return number


def _end(signal_number: int, _: FrameType | None) -> None:
    raise SystemExit(128 + signal_number)
