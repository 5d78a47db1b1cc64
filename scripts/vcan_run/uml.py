"""User Mode Linux: a kernel that runs as an ordinary program, on this machine's files."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

from .job import Job, NotUsable
from .kernel_modules import CAN_MODULES, ModuleTree
from .session import Session
from .setup import Cache

_SHARED_MEMORY = Path("/dev/shm")
_LOOK_S = 0.2


def run(job: Job, cache: Cache) -> int:
    """Run the command in a guest; its exit status.

    Raises:
        NotUsable: not set up, or the kernel lacks a module. GuestFailed: the guest did not get that far.
    """
    if not cache.has_uml:
        raise NotUsable("the uml backend is not set up: vcan-run --setup uml")
    tree = ModuleTree(next(cache.uml.glob("usr/lib/uml/modules/*")))
    modules = [str(file) for file in tree.load_order(job.modules, where_present=CAN_MODULES)]
    with Session(job, "uml", cache, modules) as session:
        out, err = session.outputs
        machine: list[str | Path] = [
            cache.uml / "usr/bin/linux.uml", f"mem={job.memory_mib}M",
            "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f"init={session.first_process}",
            "quiet", "panic=-1",
            # Console 0, for the kernel's messages, is the machine's own output; 1 and 2 take the command's.
            "con=null", "con0=null,fd:1", f"con1=null,fd:{out}", f"con2=null,fd:{err}", "ssl=null",
            # Where it puts its control socket, in place of the home folder.
            f"uml_dir={session.folder}", "umid=u",
        ]  # fmt: skip
        environment = {"TMPDIR": str(_memory_folder(job, session)), "LD_PRELOAD": str(cache.uml_preload)}
        if job.virtual_time:
            environment["VCAN_RUN_SKIP_IDLE"] = "1"
        os.sched_setaffinity(0, {idlest_processor()})
        return session.run(machine, environment)


def idlest_processor() -> int:
    """Where the guest, which has one processor, is to stay.

    Its kernel and its programs are processes that hand over to each other at each system call: on two processors of the
    host that takes twice as long as on one.
    """
    before = _idle_ticks()
    time.sleep(_LOOK_S)
    after = _idle_ticks()
    return max(after, key=lambda number: after[number] - before[number])


def _idle_ticks() -> dict[int, int]:
    """How long each processor that we may use has been idle (proc(5))."""
    lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
    words = {line.split()[0]: line.split() for line in lines if line.startswith("cpu")}
    return {number: int(words[f"cpu{number}"][4]) for number in os.sched_getaffinity(0)}


def _memory_folder(job: Job, session: Session) -> Path:
    """Where the guest's memory, a file that it runs programs from, is kept: in memory if there is room for it."""
    if not _SHARED_MEMORY.is_dir() or os.statvfs(_SHARED_MEMORY).f_flag & os.ST_NOEXEC:
        return session.folder
    free_mib = shutil.disk_usage(_SHARED_MEMORY).free >> 20
    return _SHARED_MEMORY if free_mib > job.memory_mib else session.folder
