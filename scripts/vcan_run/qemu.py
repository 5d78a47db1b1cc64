"""QEMU: an emulated PC with Debian's kernel, on this machine's files.

Beside vcan it has a camera (`vivid`, /dev/video0), two 16550A UARTs that are wired to each other (/dev/ttyS1 and
/dev/ttyS2) and two SJA1000 CAN controllers on one bus (with the module `kvaser_pci`: can0 and can1).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from .job import Job, NotUsable
from .kernel_modules import CAN_MODULES, ModuleTree
from .session import Session
from .setup import QEMU, Cache

_INITRAMFS_INIT = Path(__file__).parent / "guest" / "initramfs_init.sh"
_TO_REACH_THE_ROOT = ("virtio_pci", "9pnet_virtio", "9p", "virtio_console")
_MODULE_OPTIONS = {"vivid": "n_devs=1 node_types=0x1"}  # one camera, and none of its other twenty devices

# Boot messages and a panic are wanted, tests of timers, side channels and security are not: they cost seconds.
_KERNEL_OPTIONS = (
    "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable no_timer_check nowatchdog selinux=0 apparmor=0 audit=0 "
    "random.trust_cpu=on"
)


def run(job: Job, cache: Cache) -> int:
    """Run the command in a guest; its exit status.

    Raises:
        NotUsable: not set up, or the kernel lacks a module. GuestFailed: the guest did not get that far.
    """
    if not cache.has_qemu:
        raise NotUsable("the qemu backend is not set up: vcan-run --setup qemu (as root)")
    tree = ModuleTree(next(cache.linux.glob("lib/modules/*")))
    modules = tree.load_order(["vivid", *job.modules], where_present=CAN_MODULES)
    with Session(job, "qemu", cache, [_with_options(file) for file in modules]) as session:
        initramfs = _make_initramfs(session, cache, tree.load_order(_TO_REACH_THE_ROOT))
        return session.run(_machine(job, cache, session, initramfs))


def _machine(job: Job, cache: Cache, session: Session, initramfs: Path) -> list[str]:
    out, err = session.outputs
    unpacked = cache.linux / "vmlinux"
    kernel = unpacked if unpacked.is_file() else next(cache.linux.glob("boot/vmlinuz-*"))
    return [
        QEMU, "-M", "pc", *_processor(virtual_time=job.virtual_time), "-smp", "1", "-m", str(job.memory_mib),
        "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot",
        "-kernel", str(kernel), "-initrd", str(initramfs), "-append", _KERNEL_OPTIONS,
        # The root: this machine's files, with the rights that the caller has. Several file systems may have files of
        # one number: remap tells them apart.
        "-fsdev", "local,id=host,path=/,security_model=none,multidevs=remap",
        "-device", "virtio-9p-pci,fsdev=host,mount_tag=host",
        # ttyS0 takes the kernel's messages; ttyS1 and ttyS2 are the two ends of a socket (in the session's folder,
        # where QEMU runs: a full path may be too long for a socket).
        "-serial", f"file:{session.console}",
        "-chardev", "socket,id=uart1,path=uart,server=on,wait=off", "-serial", "chardev:uart1",
        "-chardev", "socket,id=uart2,path=uart", "-serial", "chardev:uart2",
        "-object", "can-bus,id=can",
        "-device", "kvaser_pci,canbus=can", "-device", "kvaser_pci,canbus=can",
        # The command's output.
        "-device", "virtio-serial-pci",
        "-chardev", f"file,id=out,path=/dev/fd/{out}", "-device", "virtserialport,chardev=out,name=out",
        "-chardev", f"file,id=err,path=/dev/fd/{err}", "-device", "virtserialport,chardev=err,name=err",
    ]  # fmt: skip


def _processor(*, virtual_time: bool) -> list[str]:
    """The machine's own processor where it can be virtualised: 20 times faster than an emulated one.

    An emulated one is slow, unless the guest's clock counts instructions, 1 ns each, and jumps to the next timer when
    there are none. While the guest waits for files it then runs fast.
    """
    # /dev/kvm alone says little: it may be there on a machine whose CPU does not virtualise.
    virtualises = re.search(r"\b(vmx|svm)\b", Path("/proc/cpuinfo").read_text())
    if virtualises and os.access("/dev/kvm", os.R_OK | os.W_OK):
        return ["-accel", "kvm", "-cpu", "host"]
    # Nehalem (x86-64-v2) is the least that numpy's and OpenCV's wheels ask for.
    count = ["-icount", "shift=0,sleep=off"] if virtual_time else []
    return ["-accel", "tcg", "-cpu", "Nehalem", *count]


def _with_options(file: Path) -> str:
    return f"{file} {_MODULE_OPTIONS.get(file.name.partition('.ko')[0], '')}".rstrip()


def _make_initramfs(session: Session, cache: Cache, modules: Sequence[Path]) -> Path:
    """A file system in memory with what the kernel needs to reach this machine's files."""
    root = session.folder / "initramfs"
    (root / "bin").mkdir(parents=True)
    (root / "modules").mkdir()
    shutil.copy(cache.busybox, root / "bin" / "busybox")
    shutil.copy(_INITRAMFS_INIT, root / "init")
    (root / "init").chmod(0o755)
    (root / "first_process").write_text(f"{session.first_process}\n")
    for number, file in enumerate(modules, 10):  # two digits: the shell sorts them by text
        shutil.copy(file, root / "modules" / f"{number}-{file.name}")
    names = "".join(f"{path.relative_to(root)}\n" for path in sorted(root.rglob("*")))
    archive = session.folder / "initramfs.cpio"
    pack = [str(cache.busybox), "cpio", "-o", "-H", "newc"]
    archive.write_bytes(subprocess.run(pack, cwd=root, input=names.encode(), capture_output=True, check=True).stdout)
    return archive
