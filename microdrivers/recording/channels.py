"""Which topics a recording has, and the channels that the recorder itself adds."""

from __future__ import annotations

from collections.abc import Collection
from fnmatch import fnmatchcase

ARRIVALS_TOPIC = "microdrivers/arrivals"
DROPS_TOPIC = "microdrivers/drops"
TRUTH_PREFIX = "truth/"

PATTERN = frozenset("*?[")
"""What makes a pattern of a topic's name."""

_WIRE_SUFFIX = "/wire"


def matches(topic: str, patterns: Collection[str] | None) -> bool:
    """Whether a topic is one of those named, or matched by a pattern such as `truth/*`; None matches all."""
    return patterns is None or any(fnmatchcase(topic, pattern) for pattern in patterns)


def is_wanted(topic: str, patterns: Collection[str] | None) -> bool:
    """Whether a topic is to be recorded: it matches.

    None asks for all but the bytes on the wires, which drivers make only while somebody listens: these are to be asked
    for by a pattern that ends in `/wire`.
    """
    if topic.endswith(_WIRE_SUFFIX):
        patterns = [pattern for pattern in patterns or () if pattern.endswith(_WIRE_SUFFIX)]
    return matches(topic, patterns)


def literal(topic: str) -> str:
    """The pattern that matches this topic alone."""
    return "".join(f"[{letter}]" if letter in PATTERN else letter for letter in topic)
