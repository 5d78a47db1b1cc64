"""Which axis and which controller an error is about, where whoever raises it does not know."""

from __future__ import annotations

import re
from collections.abc import Iterable

from microdrivers.core.errors import LinkLost, LinkTimeout, MicrodriversError
from microdrivers.devices.xytheta_stage import AXES

_NAMED_AXIS = re.compile(rf"\baxis ({'|'.join(AXES)})\b")


class NamingErrors:
    """A context that puts axes and address in front of errors that do not name any; a lost port is nobody's.

    Args:
        axes: of the stage; none if it is not known which.
        address: of their controller in a daisy chain. If it is silent, its switches are part of the remedy.
    """

    def __init__(self, axes: Iterable[str], address: int | None) -> None:
        self._axes = ", ".join(axes)
        self._address = address

    def __enter__(self) -> None:
        """Nothing to prepare: one object may be entered any number of times."""

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Complete what is being raised."""
        if isinstance(error, MicrodriversError) and not isinstance(error, LinkLost):
            self._name(error)

    def _name(self, error: MicrodriversError) -> None:
        places = []
        if self._axes and not _NAMED_AXIS.search(error.what):
            places.append(f"axis {self._axes}")
        if self._address is not None and not re.search(rf"\baddress {self._address}\b", error.what):
            places.append(f"address {self._address}")
        if places:
            error.what = f"{', '.join(places)}: {error.what}"
        if self._address is not None and isinstance(error, LinkTimeout):
            _mention_switches(error, self._address)


def _mention_switches(error: LinkTimeout, address: int) -> None:
    switches = (
        "check that all controllers of the daisy chain are switched on, and that DIP switches 1-4 of this one say "
        f"address {address} (all on is 1)"
    )
    if switches not in error.remedy:
        error.remedy = f"{switches}; {error.remedy}"
