"""A recorded indentation as a source of samples."""

from __future__ import annotations

from collections.abc import Callable

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.recording.indentation_table import IndentationTable
from microdrivers.routines.force.source import FrameTracker, IndentationNames, IndentationSetup, Rests
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress


class IndentationPlayback:
    """Publishes a recorded indentation, once."""

    past_run = PastRun()
    past_settings = None
    whereabouts = ""

    def __init__(self, table: IndentationTable) -> None:
        self.bus = Bus()
        self.clock: Clock = SimulatedClock()
        self.names = IndentationNames("force", "deformation", None)
        self.repeatable = False
        self._table = table

    def prepare(self, progress: Progress) -> FrameTracker | None:
        """Nothing needs to be made ready; deformations are recorded."""
        progress.step(f"{len(self._table)} samples from {self._table.file}")
        return None

    def indent(self, begin: Callable[[], None], progress: Progress) -> Rests | None:  # noqa: ARG002 - it takes no time
        """Publish the recording; nothing is known of rests."""
        begin()
        self._table.publish(self.bus, sensor=self.names.sensor, deformation=self.names.deformation)
        return None

    def finish(self) -> None:
        """Nothing moves."""

    def setup(self) -> IndentationSetup:
        """A recording states µm and µN, and nothing else."""
        return IndentationSetup(
            sensor=self.names.sensor, stage=None, camera=None, scale_source="the recording's own µm",
            scale_px_per_um=None, scale_sigma_px_per_um=None, zoom=None, speed_um_s=None, tare_uN=None,
        )  # fmt: skip
