"""A contact as a function of time: its memory is stepped on a grid of its own, up to whatever instant is asked for."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

import numpy as np

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.world.approach import Approach
from microdrivers.fakes.world.mechanics import AT_REST, Contact, Memory, Pace

STEP_NS = 500_000
_STEPS_A_SPAN = 128
_SPAN_NS = _STEPS_A_SPAN * STEP_NS
_KEPT_SPANS = 96
"""6 s, for whoever asks late."""
_KEPT_PACES = 1000


class Touch(NamedTuple):
    """The contact at one instant.

    Attributes:
        deformation_um: how far the contact point has moved into the specimen: compression and slip.
        tip_um: how far beyond the undeformed surface the tip is, with what the sensor's spring gives in.
        force_uN: on the tip, against the probing direction; negative while it is held back.
    """

    deformation_um: float
    compression_um: float
    slip_um: float
    tip_um: float
    force_uN: float
    in_contact: bool


class _Span(NamedTuple):
    """The memory in a stretch of time, from the spans `number` to `until` (exclusive; None: to the next command).

    Attributes:
        approach: the tip from its beginning on.
        memories: at each instant of the grid, from the beginning to the end; a single one if it stays the same.
    """

    number: int
    until: int | None
    approach: Approach
    memories: list[Memory]


class Indentation:
    """The state of a contact at any instant, the same whoever asks, whenever and in whatever order.

    Nothing is stepped while the tip is away and the specimen at rest, or while nothing changes. A command to a stage
    undoes what had been worked out for later times. Whoever asks for more than 6 s ago gets the oldest that is kept.

    Args:
        origin_ns: until then the specimen is at rest.
    """

    def __init__(self, contact: Contact, approach: Approach, *, origin_ns: int) -> None:
        self._contact = contact
        self._pace = contact.pace(STEP_NS / NS_PER_S)
        self._paces: dict[int, Pace] = {}
        self._approach = approach
        self._origin_ns = origin_ns
        self._first = (0, AT_REST)
        """Number and memory that the spans begin with if none is kept."""
        self._spans: deque[_Span] = deque()
        self._changes: deque[int] = deque()
        self._lock = threading.Lock()
        for axis in approach.axes:
            axis.on_change(self._changes.append)

    def at(self, t_ns: int) -> Touch:
        """The contact at an instant."""
        with self._lock:
            self._forget_changed()
            span = self._find((max(t_ns - 1, self._origin_ns) - self._origin_ns) // _SPAN_NS)
        begin_ns = self._origin_ns + span.number * _SPAN_NS
        t_ns = max(t_ns, begin_ns + 1)
        steps = (t_ns - 1 - begin_ns) // STEP_NS
        memory = span.memories[steps if len(span.memories) > 1 else 0]
        depth_um, reachable = span.approach.depth_at(t_ns)
        if _idle(memory) and not (reachable and depth_um > memory.slip_um):
            return Touch(memory.slip_um, 0.0, memory.slip_um, depth_um, 0.0, False)
        pace = self._pace_of(t_ns - begin_ns - steps * STEP_NS)
        memory, force_uN = self._contact.step(memory, pace, depth_um, reachable)
        deformation_um = memory.compression_um + memory.slip_um
        return Touch(
            deformation_um,
            memory.compression_um,
            memory.slip_um,
            deformation_um if memory.touched else depth_um,
            force_uN,
            memory.touched,
        )

    def _pace_of(self, duration_ns: int) -> Pace:
        """Whoever asks at a fixed rate asks for few different ones."""
        pace = self._paces.get(duration_ns)
        if pace is None:
            if len(self._paces) > _KEPT_PACES:
                self._paces.clear()
            pace = self._paces[duration_ns] = self._contact.pace(duration_ns / NS_PER_S)
        return pace

    # ------------------------------------------------------------------ spans

    def _find(self, number: int) -> _Span:
        """The span that holds a number; the oldest one if that is no longer kept."""
        while not self._spans or ((until := self._spans[-1].until) is not None and until <= number):
            self._spans.append(self._next())
            if len(self._spans) > _KEPT_SPANS:
                self._spans.popleft()
        last = self._spans[-1]
        if last.number <= number:
            return last
        return next((span for span in reversed(self._spans) if span.number <= number), self._spans[0])

    def _next(self) -> _Span:
        """Work out what follows the last span."""
        number, memory = self._first
        if self._spans and (until := self._spans[-1].until) is not None:
            number, memory = until, self._spans[-1].memories[-1]
        begin_ns = self._origin_ns + number * _SPAN_NS
        approach = self._approach.from_instant(begin_ns)
        if approach.still and self._contact.step(memory, self._pace, *approach.depth_at(begin_ns))[0] == memory:
            return _Span(number, None, approach, [memory])
        depths, reachable = approach.depths_at(begin_ns + STEP_NS * np.arange(1, _STEPS_A_SPAN + 1))
        untouched = 0
        if _idle(memory):
            meets = reachable & (depths > memory.slip_um)
            if not meets.any():
                return _Span(number, number + 1, approach, [memory])
            untouched = int(meets.argmax())
        memories = [memory] * (untouched + 1)
        step, pace = self._contact.step, self._pace
        for depth_um, met in zip(depths[untouched:].tolist(), reachable[untouched:].tolist(), strict=True):
            memory, _ = step(memory, pace, depth_um, met)
            memories.append(memory)
        return _Span(number, number + 1, approach, memories)

    def _forget_changed(self) -> None:
        """Drop what was worked out for times after a command."""
        while self._changes:
            changed = max(self._changes.popleft() - self._origin_ns, 0) // _SPAN_NS
            while self._spans and self._spans[-1].number >= changed:
                span = self._spans.pop()
                self._first = (span.number, span.memories[0])
            if self._spans and self._spans[-1].until is None:
                self._spans[-1] = self._spans[-1]._replace(until=changed)


def _idle(memory: Memory) -> bool:
    """Whether nothing happens by itself."""
    return not (memory.touched or memory.compression_um or memory.branch_uN or memory.rate_um_s)
