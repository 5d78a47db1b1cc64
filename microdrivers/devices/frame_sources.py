"""Where cameras find their frame sources: by the scheme of a URL, as serial ports are found."""

from __future__ import annotations

from collections.abc import Callable

from microdrivers.core.clock import Clock
from microdrivers.core.errors import UnsupportedError
from microdrivers.devices.camera import FrameSource

SourceOpener = Callable[[str, Clock], FrameSource]

_openers: dict[str, SourceOpener] = {}


def register_frame_source(scheme: str, opener: SourceOpener) -> None:
    """Make `SCHEME://…` known; `opener` gets what stands behind `://` and the clock."""
    _openers[scheme] = opener


def known_schemes() -> list[str]:
    """The schemes that are known at present."""
    return sorted(_openers)


def find_frame_source(url: str, clock: Clock) -> FrameSource:
    """The source behind a URL, closed.

    Raises:
        UnsupportedError: no source of that scheme is installed.
    """
    scheme, _, rest = url.partition("://")
    opener = _openers.get(scheme)
    if opener is None:
        raise UnsupportedError(
            f"no frame source for {url!r} is installed (known: {', '.join(sorted(_openers)) or 'none'})",
            remedy="correct the camera's source in the rig file, or use --fake to run the rig on emulators",
        )
    return opener(rest, clock)
