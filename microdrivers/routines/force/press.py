"""The live experiment: find the specimen with the probe, then press on it at constant speed and come back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import ConfigError, MoveCancelled, NoContact, NotReferenced
from microdrivers.core.samples import ForceSample, Frame
from microdrivers.devices.camera import Camera
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.rig import Rig
from microdrivers.routines.force.press_checks import check_press
from microdrivers.routines.force.press_settings import PressSettings
from microdrivers.routines.force.sight import Sight
from microdrivers.routines.force.source import (
    BEGIN,
    END,
    READY,
    FrameTracker,
    IndentationNames,
    IndentationSetup,
    Rests,
)
from microdrivers.routines.force.watches import Felt, Lost
from microdrivers.routines.force.way import ProbingWay
from microdrivers.routines.notes import note
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.progress import Progress

_LOOK_S = 0.05
_AFTER_S = 0.5
_CONTACT_SIGMAS = 8.0
_LEAST_CONTACT_UN = 1.0
_CONTACT_READINGS = 3
_REST_FRAMES = 10
_WATCH_S, _WATCH_FRAMES, _RECOVERED_UM, _LONGEST_RECOVERY_S = 0.5, 8, 0.1, 120.0
"""The specimen has recovered when its surface has moved by less than this over so many frames, so far apart."""


class PressExperiment:
    """Presses the rig's probe on the specimen before it; see `PressSettings`."""

    past_run = PastRun()
    repeatable = True

    def __init__(self, rig: Rig, settings: PressSettings | None = None, *, sight: Sight | None = None) -> None:
        section = rig.file.probe
        if section is None:
            raise ConfigError(
                "the rig file has no probe section, which a force characterisation needs",
                file=str(rig.description.file),
                remedy="add a probe section: stage, force, camera, ready_um",
            )
        self.settings = settings or PressSettings()
        self.settings.check()
        self.bus = rig.bus
        self.clock = rig.clock
        self.names = IndentationNames(section.force, f"{section.camera}/deformation", section.camera)
        self._rig = rig
        self._section = section
        self._stage = rig.device(section.stage, FineStage)
        self._sensor = rig.device(section.force, ForceSensor)
        self._camera = rig.device(section.camera, Camera)
        self._sight = sight or Sight()
        self._guard_uN = rig.safety.limit_uN(self._sensor.name)
        self._limit_uN = self.settings.limit_uN(self._sensor.range_uN, guard_uN=self._guard_uN)
        allowed_um_s = (rig.safety.max_speed_um_s(self._sensor.name), *self._stage.max_speed.values())
        self._free_um_s = min(self.settings.free_speed_um_s, *allowed_um_s)
        ready_um = section.ready_um
        self._ready_um = None if ready_um is None else dict(zip(self._stage.axis_names, ready_um, strict=True))
        check_press(rig, self._stage, self._sensor, self.settings, self._ready_um)
        self._way: ProbingWay | None = None
        self._contact_um = math.nan
        self._near = False
        self._indented = False
        self._watcher: FrameTracker | None = None
        self.whereabouts = ""

    # ------------------------------------------------------------------ before the indentation

    def prepare(self, progress: Progress) -> FrameTracker:
        """Bring the probe up, tare, measure the scale, find the specimen, and choose what is tracked."""
        self._require_referenced(progress)
        start_um = self._ready_um or self._stage.read().position
        check_press(self._rig, self._stage, self._sensor, self.settings, start_um)
        if self._ready_um is not None:
            at = ", ".join(f"{um:g}" for um in self._ready_um.values())
            progress.step(f"probe to its place before the specimen, ({at}) µm")
            self._stage.move_to(**{f"{axis}_um": um for axis, um in self._ready_um.items()}, speed_um_s=self._free_um_s)
        self._way = way = ProbingWay(self._stage, self._sensor, self._stage.read().position)
        progress.step("tare: the probe touches nothing")
        self._sensor.tare(self.settings.tare_s)
        travel = self._travel_in_sight(way, progress)
        self._sight.learn(*travel[:2], scale_hint_px_per_um=travel.scale_hint_px_per_um)
        progress.step("approach until contact")
        self._near = True
        self._contact_um = self._approach(way)
        progress.step(f"contact after {self._contact_um:.1f} µm; back by {self.settings.back_off_um:g} µm")
        self._go(way, self._contact_um - self.settings.back_off_um)
        self.clock.sleep(self.settings.rest_s)
        rest = [self._camera.grab() for _ in range(_REST_FRAMES)]
        ahead_um = self._contact_um - way.place_um(self._stage.read().position)
        # Two: what is seen between indentations must not change what is seen in them.
        tracker, self._watcher = (
            self._sight.tracker(self._camera.name, rest, contact_ahead_um=ahead_um, depth_um=self.settings.depth_um)
            for _ in range(2)
        )
        self._sensor.tare(self.settings.tare_s)
        self._note_ready(travel, rest, ahead_um)
        return tracker

    def _note_ready(self, travel: _Travel, rest: Sequence[Frame], ahead_um: float) -> None:
        """What a replay needs to see as this run does."""
        projection = self._sight.projection
        known = {
            "names": self.names._asdict(),
            "setup": self.setup()._asdict(),
            "projection": None if projection is None else projection._asdict(),
            "scale_source": self._sight.source,
            "travel_frames": [frame.seq for frame in travel.frames],
            "travel_um": travel.places_um,
            "scale_hint_px_per_um": travel.scale_hint_px_per_um,
            "rest_frames": [frame.seq for frame in rest],
            "contact_ahead_um": ahead_um,
            "depth_um": self.settings.depth_um,
        }
        note(self.bus, self.clock, READY, known)

    def _require_referenced(self, progress: Progress) -> None:
        unknown = [axis for axis in self._stage.reference_order if not self._stage.referenced[axis]]
        if unknown and self._rig.fake:
            progress.step(f"referencing {', '.join(unknown)} (emulated stage)")
            self._stage.reference(unknown)
        elif unknown:
            raise NotReferenced(
                f"the reference of axis {', '.join(unknown)} is not known; a characterisation never references by "
                "itself",
                device=self._stage.name,
                remedy=f"take the probe away from the specimen, then: microdrivers reference "
                f"{self._rig.description.file} --device {self._stage.name}",
            )

    def _travel_in_sight(self, way: ProbingWay, progress: Progress) -> _Travel:
        """Back and forth in free space, with a frame at rest at each step: what moves is the probe."""
        steps, travel_um = self.settings.free_steps, self.settings.free_travel_um
        progress.step(f"the probe's travel in sight, {travel_um:g} µm")
        frames: list[Frame] = []
        places_um: list[float] = []
        for step in range(steps + 1):
            self._go(way, -travel_um * (1.0 - step / steps))
            places_um.append(way.place_um(self._stage.read().position))
            frames.append(self._camera.grab())
            progress.count(step + 1, steps + 1)
        return _Travel(frames, places_um, self._expected_scale_px_per_um())

    def _expected_scale_px_per_um(self) -> float:
        """What objective, adapter, zoom and pixel pitch let expect."""
        microscope, zoom = self._rig.file.microscope, self._zoom()
        lens = 1.0 if microscope is None else microscope.objective * microscope.adapter
        return lens * (zoom or 1.0) / (self._camera.pixel_pitch_um * self._camera.settings.binning)

    def _approach(self, way: ProbingWay) -> float:
        """Go on until the sensor feels the specimen; returns where that was."""
        tare = self._sensor.tared
        threshold_uN = max(_LEAST_CONTACT_UN, _CONTACT_SIGMAS * (tare.sigma_uN if tare is not None else 0.0))
        felt = Felt(threshold_uN, _CONTACT_READINGS)
        end_um = self.settings.approach_um(way.longest_um())
        with self._readings(felt):
            reached = self._run(way, end_um, lambda: felt.enough)
        if not felt.enough:
            raise NoContact(
                f"no contact within {end_um:.0f} µm: the force stayed within ±{threshold_uN:.2g} µN",
                device=self._sensor.name,
                remedy="align the probe with the specimen, nearer to it; check the sensor's axis in the rig file",
                moved="yes",
            )
        if felt.force_uN < 0.0:
            raise ConfigError(
                f"{self._sensor.name} read {felt.force_uN:.3g} µN on contact, which must be positive",
                remedy="turn its axis round in the rig file, or take the probe out of what it sticks to",
            )
        return reached

    # ------------------------------------------------------------------ one indentation

    def indent(self, begin: Callable[[], None], progress: Progress) -> Rests:
        """Press to the depth or to the force limit, and come back at the same speed."""
        assert self._way is not None
        way, asked = self._way, self.settings
        start_um, end_um = self._contact_um - asked.back_off_um, self._contact_um + asked.depth_um
        self._go(way, start_um)
        if self._indented:
            self._let_recover(progress)
        self._indented = True
        unguarded = "" if self._guard_uN is not None else "; NO FORCE GUARD watches (safety: none)"
        to = f"to {asked.depth_um:g} µm or {self._limit_uN:.4g} µN{unguarded}"
        progress.step(f"pressing at {asked.speed_um_s:g} µm/s, {to}")
        felt, lost = Felt(self._limit_uN, 1), Lost()
        total = round(2.0 * (end_um - start_um))

        def show(place_um: float, *, back: bool) -> None:
            done = place_um - start_um
            progress.count(min(max(round(total - done if back else done), 0), total), total)

        with ExitStack() as open_streams:
            open_streams.enter_context(self._readings(felt))
            open_streams.enter_context(self._frames(lost))
            note(self.bus, self.clock, BEGIN, {})
            begin()
            self.clock.sleep(_AFTER_S)
            until_ns, rested_um = self.clock.now_ns(), way.place_um(self._stage.read().position)
            deepest_um = self._run(way, end_um, lambda: felt.enough or lost.too_long, lambda um: show(um, back=False))
            lost.raise_if_too_long(self._camera.name)
            if asked.hold_s:
                self.clock.sleep(asked.hold_s)
            back_um = self._run(way, start_um, lambda: lost.too_long, lambda um: show(um, back=True))
            since_ns = self.clock.now_ns()
            lost.raise_if_too_long(self._camera.name)
            self.clock.sleep(_AFTER_S)
            # A place read at rest is off by up to half a step, either time.
            rests = Rests(until_ns, since_ns, back_um - rested_um, way.step_um / math.sqrt(6.0))
            note(self.bus, self.clock, END, rests._asdict())
        pressed_um = deepest_um - self._contact_um
        felt.raise_if_too_soon(pressed_um, speed_um_s=asked.speed_um_s, sensor=self._sensor.name)
        return rests

    def _let_recover(self, progress: Progress) -> None:
        """Wait until the specimen's surface has come to rest, as the camera sees it."""
        progress.step("waiting until the specimen has recovered")
        assert self._watcher is not None
        seen: list[float] = []
        for _ in range(round(_LONGEST_RECOVERY_S / _WATCH_S)):
            sample = self._watcher.update(self._camera.grab())
            seen.append(sample.deformation_um)
            before = seen[-1 - _WATCH_FRAMES :][:1]
            if len(seen) > _WATCH_FRAMES and abs(seen[-1] - before[0]) < _RECOVERED_UM:
                return
            self.clock.sleep(_WATCH_S)
        progress.step(f"the specimen still moves after {_LONGEST_RECOVERY_S:g} s; going on")

    def _go(self, way: ProbingWay, place_um: float) -> None:
        self._stage.move_to(**way.targets(place_um), speed_um_s=self._free_um_s)

    def _run(
        self,
        way: ProbingWay,
        place_um: float,
        enough: Callable[[], bool],
        show: Callable[[float], None] = lambda _um: None,
    ) -> float:
        """Move at the experiment's speed until the place, or until enough; returns where the stage then stands."""
        move = self._stage.start_move_to(
            **way.targets(place_um), speed_um_s=way.path_speed_um_s(self.settings.speed_um_s)
        )
        told: list[bool] = []

        def stop_once(_sample: ForceSample) -> None:
            if enough() and not told and not self._rig.safety.tripped:
                told.append(True)
                self._stage.stop(by="experiment", reason="far enough")

        watch = self.bus.topic(self._sensor.name, ForceSample).subscribe(stop_once)
        seen = self._stage.topic.subscribe(lambda pose: show(way.place_um(pose.position)))
        try:
            move.wait()
        except MoveCancelled as cancelled:
            if not told:
                raise
            if tripped := "; ".join(self._rig.safety.tripped.values()):  # while the stage still braked
                raise MoveCancelled(
                    f"the force guard intervened: {tripped}",
                    device=self._stage.name,
                    remedy="press slower, or turn back farther below the limit: --max-force-uN",
                ) from cancelled
            self._rest()
        finally:
            watch.cancel()
            seen.cancel()
        return way.place_um(self._stage.read().position)

    def _rest(self) -> None:
        """Wait until a stopped stage stands."""
        while self._stage.read().moving:
            self.clock.sleep(_LOOK_S)

    @contextmanager
    def _readings(self, felt: Felt) -> Iterator[None]:
        subscription = self.bus.topic(self._sensor.name, ForceSample).subscribe(felt.take)
        try:
            with self._sensor.stream(self._sensor.stream_rate_hz):
                yield
        finally:
            subscription.cancel()

    @contextmanager
    def _frames(self, lost: Lost) -> Iterator[None]:
        subscription = self.bus.topic(self.names.deformation, DeformationSample).subscribe(lost.take)
        try:
            with self._camera.stream(self._camera.settings.rate_hz):
                yield
        finally:
            subscription.cancel()

    # ------------------------------------------------------------------ afterwards

    def finish(self) -> None:
        """Stop, and take the probe away if it may touch something; a guard that does so already is let finish."""
        self._rig.safety.finish()
        self._stage.stop(by="characterisation", reason="the experiment ended")
        if self._way is None or self._stage.link != "open":
            return
        self._rest()
        if self._near and self._stage.retract_um is not None and not self._rig.safety.took_away(self._stage.name):
            self._stage.retract().wait()
            self._near = False
        position = self._stage.read().position
        where = ", ".join(f"{axis} {um:.1f} µm" for axis, um in position.items())
        before_um = self._contact_um - self._way.place_um(position)
        contact = "no contact was felt" if math.isnan(before_um) else f"{before_um:.0f} µm before the contact"
        self.whereabouts = f"{self._stage.name} stands at {where}; {contact}"

    def setup(self) -> IndentationSetup:
        """Names, speed, scale and zoom."""
        tare = self._sensor.tared
        return IndentationSetup(
            sensor=self._sensor.name, stage=self._stage.name, camera=self._camera.name,
            scale_source=self._sight.source, scale_px_per_um=self._sight.scale_px_per_um,
            scale_sigma_px_per_um=self._sight.scale_sigma_px_per_um, zoom=self._zoom(),
            speed_um_s=self.settings.speed_um_s, tare_uN=None if tare is None else tare.offset_uN,
            guarded=self._guard_uN is not None,
        )  # fmt: skip

    def _zoom(self) -> float | None:
        microscope = self._rig.file.microscope
        motor = self._rig.devices.get(microscope.zoom) if microscope is not None else None
        return motor.read().zoom if isinstance(motor, ZoomMotor) and motor.link == "open" else None


class _Travel(NamedTuple):
    """Frames at rest on a way through free space."""

    frames: list[Frame]
    places_um: list[float]
    scale_hint_px_per_um: float
