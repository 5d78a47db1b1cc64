"""The media that python-can finds by their names."""

from __future__ import annotations

from collections import Counter

from microdrivers.core.clock import Clock
from microdrivers.core.errors import ConfigError
from microdrivers.fakes.can.medium import Medium

_media: dict[str, Medium] = {}
_users: Counter[Medium] = Counter()


def shared_medium(name: str, *, clock: Clock, bitrate: int, seed: int) -> Medium:
    """The medium of that name on that clock; made by the first who asks. Give it back with `forget_medium`.

    A medium of the same name on another clock belongs to another rig: it keeps its users and loses its name.

    Raises:
        ConfigError: the medium has another bit rate.
    """
    medium = _media.get(name)
    if medium is None or medium.clock is not clock:
        medium = _media[name] = Medium(name, clock=clock, bitrate=bitrate, seed=seed)
    elif medium.bitrate != bitrate:
        raise ConfigError(
            f"two devices on {name} want {medium.bitrate} and {bitrate} bit/s",
            remedy="give all devices of a bus the same bitrate",
            key="connection.bitrate",
        )
    _users[medium] += 1
    return medium


def forget_medium(name: str, medium: Medium | None = None) -> None:
    """Give a medium back; the last user closes it. Nothing happens if there is none.

    Args:
        name: as it was asked for.
        medium: the one that is meant, where another rig may have taken the name over.
    """
    medium = medium or _media.get(name)
    if medium is None or medium not in _users:
        return
    _users[medium] -= 1
    if not _users[medium]:
        del _users[medium]
        if _media.get(name) is medium:
            del _media[name]
        medium.close()


def medium_named(name: str) -> Medium | None:
    """The medium that python-can opens as `channel=NAME`."""
    return _media.get(name)
