"""Fetches what the virtual machines need from Debian's or Ubuntu's packages into a cache.

Packages are unpacked, not installed, so no root is needed (except for QEMU itself, which is installed). Everything in
the cache is complete: it is made under another name and renamed. To fetch a newer kernel, delete the cache.
"""

from __future__ import annotations

import lzma
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from .job import NotUsable

QEMU = "qemu-system-x86_64"
_TOOLS = {QEMU: "qemu-system-x86", "ip": "iproute2"}
"""What the qemu backend needs of this machine. The guest has the same files: `ip` is for its CAN controllers."""

_PRELOAD_SOURCES = tuple(Path(__file__).with_name(name) for name in ("uml_xsave.c", "uml_clock.c"))
_XZ_MAGIC = b"\xfd7zXZ\0"


def say(text: str) -> None:
    """Tell the user something that is not the command's output."""
    print(f"vcan-run: {text}", file=sys.stderr, flush=True)


class Cache:
    """The folder of fetched files: MICRODRIVERS_VM_CACHE, or microdrivers/vm in the user's cache folder."""

    def __init__(self) -> None:
        user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        self.folder = Path(os.environ.get("MICRODRIVERS_VM_CACHE") or user_cache / "microdrivers" / "vm").absolute()
        self.busybox = self.folder / "busybox"
        self.uml = self.folder / "uml"
        self.uml_preload = self.folder / "uml_preload.so"
        self.linux = self.folder / "linux"

    @property
    def has_uml(self) -> bool:
        """Whether the `uml` backend is set up."""
        return self.uml.is_dir() and self.uml_preload.is_file() and self.busybox.is_file()

    @property
    def has_qemu(self) -> bool:
        """Whether the `qemu` backend is set up."""
        return not _missing() and self.linux.is_dir() and self.busybox.is_file()


def set_up_uml(cache: Cache) -> None:
    """A user-mode kernel with its modules (120 MB), and the library that mends what it lacks.

    Raises:
        NotUsable: something cannot be fetched, or there is no C compiler and the user is not root.
    """
    _set_up_busybox(cache)
    if not cache.uml.is_dir():
        _make(cache.uml, lambda folder: _unpack("user-mode-linux", folder))
    newest_s = max(source.stat().st_mtime for source in _PRELOAD_SOURCES)
    if cache.uml_preload.is_file() and cache.uml_preload.stat().st_mtime >= newest_s:
        return
    if shutil.which("cc") is None:
        _install("gcc", "libc6-dev")
    _make(
        cache.uml_preload, lambda file: _run(["cc", "-O2", "-shared", "-fPIC", "-o", file, *_PRELOAD_SOURCES, "-ldl"])
    )


def set_up_qemu(cache: Cache) -> None:
    """QEMU and a tool, and Debian's kernel with its modules (470 MB).

    Raises:
        NotUsable: something cannot be fetched, or must be installed and the user is not root.
    """
    if cache.has_qemu:
        return
    if missing := _missing():
        _install(*missing)
    _set_up_busybox(cache)
    if not cache.linux.is_dir():
        _make(cache.linux, lambda folder: _unpack_kernel(folder, cache.busybox))


def _missing() -> list[str]:
    """Packages that the qemu backend needs and that are not installed; a user's search path may lack sbin."""
    return [
        package
        for tool, package in _TOOLS.items()
        if shutil.which(tool) is None and shutil.which(tool, path="/usr/sbin:/sbin") is None
    ]


def _set_up_busybox(cache: Cache) -> None:
    """A static one: it also works in a guest that has no other file yet."""
    if cache.busybox.is_file():
        return
    with tempfile.TemporaryDirectory() as scratch:
        _unpack("busybox-static", Path(scratch))
        binary = next(Path(scratch).glob("**/bin/busybox"))
        _make(cache.busybox, lambda file: shutil.copy(binary, file))


def _unpack_kernel(folder: Path, busybox: Path) -> None:
    package = _kernel_package()
    _unpack(package, folder)
    # The package's own installation script would do this, for the running system.
    _run([busybox, "depmod", "-b", folder, package.removeprefix("linux-image-")])
    image = next(folder.glob("boot/vmlinuz-*")).read_bytes()
    # An emulated CPU takes 5 s to decompress it. Where this does not work, QEMU takes the packed kernel.
    try:
        kernel = lzma.LZMADecompressor().decompress(image[image.find(_XZ_MAGIC) :])
    except lzma.LZMAError:
        return
    if kernel.startswith(b"\x7fELF"):
        (folder / "vmlinux").write_bytes(kernel)


def _kernel_package() -> str:
    """The package that Debian's kernel meta-package stands for at present."""
    for attempt in _attempts():
        answer = subprocess.run(["apt-cache", "depends", "linux-image-amd64"], capture_output=True, text=True)
        for line in answer.stdout.splitlines():
            word, _, package = line.strip().partition(": ")
            if word == "Depends" and package.startswith("linux-image-"):
                return package
        attempt()
    raise NotUsable("apt knows no linux-image-amd64: the qemu backend needs Debian's kernel (on Ubuntu, use uml)")


# ---------------------------------------------------------------- packages


def _unpack(package: str, folder: Path) -> None:
    """Download a package and unpack it into a folder."""
    _require_debian()
    say(f"fetching {package}")
    with tempfile.TemporaryDirectory() as scratch:
        # apt would download as a user of its own, who may not write here. It checks signatures in any case.
        download = ["apt-get", "-qq", "-o", "APT::Sandbox::User=root", "download", package]
        for attempt in _attempts():
            if _succeeds(download, cwd=scratch):
                break
            attempt()
        else:
            raise NotUsable(_unreachable(f"download {package}"))
        _run(["dpkg-deb", "-x", next(Path(scratch).glob("*.deb")), folder])


def _install(*packages: str) -> None:
    names = " ".join(packages)
    _require_debian()
    command = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages]
    if os.geteuid() != 0:
        raise NotUsable(f"{names} is missing and only root can install it: sudo {' '.join(command)}")
    say(f"installing {names}")
    for attempt in _attempts():
        if _succeeds(command):
            return
        attempt()
    raise NotUsable(_unreachable(f"install {names}"))


def _unreachable(what: str) -> str:
    lists = "" if os.geteuid() == 0 else "run 'sudo apt-get update' first; "
    return (
        f"apt cannot {what}, see above. It needs a package server, once: {lists}without a network, copy the folder "
        f"{Cache().folder} from a computer where this has worked, or (for CAN) use a kernel that has vcan"
    )


def _attempts() -> list[Callable[[], object]]:
    """What to do after each failed attempt: fresh containers have no package lists yet, and only root gets them."""
    if os.geteuid() != 0:
        return [lambda: None]
    return [lambda: _succeeds(["apt-get", "-qq", "update"]), lambda: None]


def _require_debian() -> None:
    for tool in ("apt-get", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise NotUsable(f"{tool} is missing: only Debian and Ubuntu can be set up")


# ---------------------------------------------------------------- files


def _make(path: Path, fill: Callable[[Path], object]) -> None:
    """Make a file or folder of the cache, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix="unfinished-") as scratch:
        unfinished = Path(scratch) / path.name
        fill(unfinished)
        unfinished.rename(path)


def _succeeds(command: list[str], *, cwd: str | None = None) -> bool:
    return subprocess.run(command, cwd=cwd, stdout=sys.stderr).returncode == 0


def _run(command: list[str | Path]) -> None:
    """Run a tool.

    Raises:
        NotUsable: it fails.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise NotUsable(f"{' '.join(map(str, command))} failed:\n{done.stderr.strip()}")
