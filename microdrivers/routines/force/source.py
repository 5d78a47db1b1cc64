"""What a force characterisation needs of whoever publishes the samples: a live probe, a recording, a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.samples import Frame
from microdrivers.estimators.force.identify import IdentificationSettings
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress

READY, BEGIN, END, DONE = "force/ready", "force/begin", "force/end", "force/done"
"""The routine's notes: all is ready for indentations, one begins, it has ended; the run is over, early by what."""

SETTINGS = "force/settings"
"""The routine's note of how specimens are identified."""


def host_name(number: int) -> str:
    """Under this name the order is recorded in which the estimators got the samples of the n-th indentation."""
    return f"force/{number}"


class IndentationNames(NamedTuple):
    """Topics: the sensor's readings, the deformations, and the frames that these come from (None: they are given)."""

    sensor: str
    deformation: str
    camera: str | None


class Rests(NamedTuple):
    """The tool at rest out of contact, before and after an indentation, and why it turned between.

    Attributes:
        until_ns, since_ns: when the first rest ended, and the second began.
        travel_um: how much farther along the direction of probing its encoders say that it was in the second.
        travel_sigma_um: standard deviation of it.
        turned_at_uN: the limit of force that turned it back before it had come to its depth; None if that did not.
    """

    until_ns: int
    since_ns: int
    travel_um: float
    travel_sigma_um: float
    turned_at_uN: float | None = None


class FrameTracker(Protocol):
    """Finds the deformation in a frame."""

    def update(self, frame: Frame) -> DeformationSample:
        """Track one frame; `found` is False if the contact point is lost."""


class IndentationSetup(NamedTuple):
    """How the specimen is indented and seen; None where that is not known.

    Attributes:
        scale_source: where µm come from.
        speed_um_s: of the tool while loading. depth_um: how far it was to go beyond the contact.
        tare_uN: the sensor's zero that was in use. bandwidth_hz: of the sensor.
        guarded: whether a force guard of the rig watched.
        touch_uN: the rise of the force by which the approach found the specimen. touched_s: how long it felt it.
    """

    sensor: str
    stage: str | None
    camera: str | None
    scale_source: str
    scale_px_per_um: float | None
    scale_sigma_px_per_um: float | None
    zoom: float | None
    speed_um_s: float | None
    tare_uN: float | None
    guarded: bool = True
    touch_uN: float | None = None
    touched_s: float | None = None
    depth_um: float | None = None
    bandwidth_hz: float | None = None


class IndentationSource(Protocol):
    """Presses on a specimen and publishes what camera and sensor say.

    Attributes:
        repeatable: whether `indent` may be called again, for a fresh indentation of the same specimen.
        whereabouts: where the tool was observed to stand after `finish`, in words; empty if it never moved.
    """

    bus: Bus
    clock: Clock
    names: IndentationNames
    repeatable: bool
    whereabouts: str

    @property
    def past_run(self) -> PastRun:
        """What a recording tells of its run, valid after `indent`."""

    @property
    def past_settings(self) -> IdentificationSettings | None:
        """How a recorded run identified; None for a live run, or where a recording does not tell."""

    def prepare(self, progress: Progress) -> FrameTracker | None:
        """Make everything ready for an indentation; returns what finds the deformation in frames."""

    def indent(self, begin: Callable[[], None], progress: Progress) -> Rests | None:
        """Press once, to the limit and back. Calls `begin` when what follows belongs to the indentation.

        Returns:
            Where the tool rested before and after, if that is known.
        """

    def finish(self) -> None:
        """On any way out, an interruption included: the tool is away from the specimen and nothing moves any more."""

    def setup(self) -> IndentationSetup:
        """What is known of the arrangement, valid after `prepare`."""
