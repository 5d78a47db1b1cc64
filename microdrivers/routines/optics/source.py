"""What the calibration needs of whoever publishes the samples: a live experiment, a recording, a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import ConfigError
from microdrivers.estimators.optics.calibrator import CalibratorSettings, PointTracker
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress

BEGIN = "optics/begin"
"""The routine's note that what follows belongs to the calibration."""

SETTINGS = "optics/settings"
"""The routine's note of what its estimator is set to."""

DONE = "optics/done"
"""The routine's note that the run is over, and by what it was ended early."""

HOST = "optics"
"""Under this name the order is recorded in which the estimator got its samples."""


class SourceNames(NamedTuple):
    """Topics of the three streams."""

    stage: str
    zoom: str
    camera: str


class Optics(NamedTuple):
    """What is known of the optics beforehand; None where it is not."""

    camera: str
    binning: int
    roi: tuple[int, int, int, int]
    objective: float | None
    pixel_pitch_um: float | None


def frames_taken(asked: int | None, there: int, *, source: str) -> int:
    """How many frames of old data a calibration takes.

    Raises:
        ConfigError: more are asked for than are there.
    """
    if asked is not None and asked > there:
        raise ConfigError(f"{source} holds {there} frames of the experiment, not {asked}", remedy="ask for fewer")
    return there if asked is None else asked


class OpticsSource(Protocol):
    """Publishes poses, zoom readings and frames of a moving target."""

    bus: Bus
    clock: Clock
    names: SourceNames

    @property
    def past_run(self) -> PastRun:
        """What a recording tells of its run, valid after `run`."""

    @property
    def past_settings(self) -> CalibratorSettings | None:
        """What the estimator of a recorded run was set to; None for a live run, or where a recording does not tell."""

    def run(self, begin: Callable[[PointTracker], None], progress: Progress) -> None:
        """Publish the samples.

        Calls `begin` with a tracker for the target once what follows is meant for the calibration. On any way out,
        an interruption included, nothing moves any more.
        """

    def optics(self) -> Optics:
        """What is known of the optics, valid after `run`."""

    def frames_expected(self) -> int | None:
        """How many frames the calibration takes; None takes all that come."""
