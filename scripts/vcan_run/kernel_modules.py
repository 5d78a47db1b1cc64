"""Which files to load for a kernel module, in which order."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from .job import NotUsable

CAN_MODULES = ("can-raw", "can-bcm", "can-isotp", "vcan", "vxcan", "slcan")
"""Loaded in every guest, as far as its kernel has them."""


class ModuleTree:
    """The modules of one kernel.

    Args:
        folder: …/lib/modules/VERSION, with the `modules.dep` that depmod makes.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, str] = {}
        self._needs: dict[str, list[str]] = {}
        for line in (folder / "modules.dep").read_text(encoding="ascii").splitlines():
            file, _, needed = line.partition(":")
            self._files[_name(file)] = file
            self._needs[_name(file)] = [_name(other) for other in needed.split()]

    def load_order(self, wanted: Iterable[str], *, where_present: Iterable[str] = ()) -> list[Path]:
        """Files of these modules, each after those that it needs.

        Args:
            wanted: names, with dashes or underscores.
            where_present: further modules, skipped if this kernel lacks them or has them built in.

        Raises:
            NotUsable: this kernel lacks a wanted module.
        """
        order: dict[str, Path] = {}
        for name in where_present:
            if _name(name) in self._files:
                self._add(_name(name), order)
        for name in wanted:
            if _name(name) not in self._files:
                raise NotUsable(f"the kernel in {self._folder} has no module '{name}'")
            self._add(_name(name), order)
        return list(order.values())

    def _add(self, name: str, order: dict[str, Path]) -> None:
        if name in order:
            return
        # depmod lists all that a module needs, indirectly too, the most basic ones last.
        for needed in reversed(self._needs[name]):
            self._add(needed, order)
        order[name] = self._folder / self._files[name]


def _name(file: str) -> str:
    """`kernel/net/can/can-raw.ko.xz` → `can_raw`: the kernel takes dashes and underscores for the same."""
    return Path(file).name.partition(".ko")[0].replace("-", "_")
