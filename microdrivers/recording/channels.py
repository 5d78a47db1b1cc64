"""Which topics a recording has, and the channels that the recorder itself adds."""

from __future__ import annotations

from collections.abc import Collection
from fnmatch import fnmatchcase

ARRIVALS_TOPIC = "microdrivers/arrivals"
DROPS_TOPIC = "microdrivers/drops"
TRUTH_PREFIX = "truth/"

_WIRE_SUFFIX = "/wire"


def is_wanted(topic: str, patterns: Collection[str] | None) -> bool:
    """Whether a topic is asked for: named, or matched by a pattern such as `truth/*`.

    None asks for all but the bytes on the wires, which drivers make only while somebody listens: these are to be asked
    for by a pattern that ends in `/wire`.
    """
    wire = topic.endswith(_WIRE_SUFFIX)
    if patterns is None:
        return not wire
    return any(fnmatchcase(topic, pattern) for pattern in patterns if not wire or pattern.endswith(_WIRE_SUFFIX))


def literal(topic: str) -> str:
    """The pattern that matches this topic alone."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in topic)
