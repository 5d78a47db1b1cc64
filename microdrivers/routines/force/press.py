"""The live experiment: find the specimen with the probe, then press on it at constant speed and come back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.errors import ConfigError, LinkError, MicrodriversError, NotReferenced
from microdrivers.core.samples import Frame
from microdrivers.devices.camera import Camera
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import TARE_DURATIONS_S, ForceSensor, Tare
from microdrivers.rig import Rig
from microdrivers.routines.force.approach import Contact, find_specimen, tare_s
from microdrivers.routines.force.press_checks import check_press, require_free
from microdrivers.routines.force.press_settings import PressSettings
from microdrivers.routines.force.probe_drive import ProbeDrive
from microdrivers.routines.force.sight import Sight, zoom_of
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

_AFTER_S = 0.5
"""How long samples come of the probe at rest, before and after an indentation: they show how the picture drifts."""

_REST_FRAMES = 10
"""Of the undeformed specimen, from which is chosen what is tracked."""

_WATCH_S, _WATCH_FRAMES, _RECOVERED_UM, _LONGEST_RECOVERY_S = 0.5, 8, 0.1, 120.0
"""The specimen has recovered when its surface has moved by less than this over so many frames, so far apart."""


class PressExperiment:
    """Presses the rig's probe on the specimen before it; see `PressSettings`."""

    past_run = PastRun()
    past_settings = None
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
        self._guarded = self._sensor.name in rig.safety.guards
        self._limit_at(None)
        allowed_um_s = (rig.safety.max_speed_um_s(self._sensor.name), *self._stage.max_speed.values())
        self._free_um_s = min(self.settings.free_speed_um_s, *allowed_um_s)
        ready_um = section.ready_um
        self._ready_um = None if ready_um is None else dict(zip(self._stage.axis_names, ready_um, strict=True))
        check_press(rig, self._stage, self._sensor, self.settings, self._ready_um)
        self._drive: ProbeDrive | None = None
        self._contact: Contact | None = None
        self._near = False
        self._indented = False
        self._watcher: FrameTracker | None = None
        self._zoom: float | None = None
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
        way = ProbingWay(self._stage, self._sensor, self._stage.read().position)
        self._drive = drive = ProbeDrive(
            self._rig, self._stage, self._sensor, way, speed_um_s=self.settings.speed_um_s, free_um_s=self._free_um_s
        )
        self._near = True
        progress.step("tare: the probe touches nothing")
        self._tare()
        travel = self._travel_in_sight(drive, progress)
        self._sight.learn(*travel[:2], scale_hint_px_per_um=travel.scale_hint_px_per_um)
        progress.step("approach until contact")
        self._contact = contact = find_specimen(
            drive, self._sensor, self.settings, limit_uN=self._limit_at(self._sensor.tared), retare=self._tare,
            clock=self.clock, progress=progress,
        )  # fmt: skip
        progress.step(f"contact after {contact.place_um:.1f} µm; back by {self.settings.back_off_um:g} µm")
        require_free(self._rig, self._stage, way, contact.place_um + self.settings.depth_um, by_depth=True)
        self.clock.sleep(self.settings.rest_s)
        rest = [self._camera.grab() for _ in range(_REST_FRAMES)]
        ahead_um = contact.place_um - drive.place_um
        # Two: what is seen between indentations must not change what is seen in them.
        tracker, self._watcher = (
            self._sight.tracker(self._camera.name, rest, contact_ahead_um=ahead_um, depth_um=self.settings.depth_um)
            for _ in range(2)
        )
        self._tare()
        self._zoom = zoom_of(self._rig)
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

    def _tare(self) -> None:
        """Take the sensor's zero, longer where noise hides a drift; it must leave the force that is asked for."""
        tare = self._sensor.tare(self.settings.tare_s)
        if (longer_s := min(tare_s(self._sensor, tare), TARE_DURATIONS_S.max)) > self.settings.tare_s:
            tare = self._sensor.tare(longer_s)
        self._limit_at(tare)

    def _limit_at(self, tare: Tare | None) -> float:
        """Where pressing ends by itself at a zero of the sensor.

        Raises:
            OutOfRange: the force that was asked for is more than sensor or guard allow.
        """
        tare_uN = 0.0 if tare is None else tare.offset_uN
        guard_uN = self._rig.safety.limit_uN(self._sensor.name, tare_uN=tare_uN)
        return self.settings.limit_uN(self._sensor.range_uN, guard_uN=guard_uN, tare_uN=tare_uN)

    def _travel_in_sight(self, drive: ProbeDrive, progress: Progress) -> _Travel:
        """Back and forth in free space, with a frame at rest at each step: what moves is the probe."""
        steps, travel_um = self.settings.free_steps, self.settings.free_travel_um
        progress.step(f"the probe's travel in sight, {travel_um:g} µm")
        frames: list[Frame] = []
        places_um: list[float] = []
        for step in range(steps + 1):
            drive.go(-travel_um * (1.0 - step / steps))
            places_um.append(drive.place_um)
            frames.append(self._camera.grab())
            progress.count(step + 1, steps + 1)
        return _Travel(frames, places_um, self._expected_scale_px_per_um())

    def _expected_scale_px_per_um(self) -> float:
        """What objective, adapter, zoom and pixel pitch let expect."""
        microscope, zoom = self._rig.file.microscope, zoom_of(self._rig)
        lens = 1.0 if microscope is None else microscope.objective * microscope.adapter
        return lens * (zoom or 1.0) / (self._camera.pixel_pitch_um * self._camera.settings.binning)

    # ------------------------------------------------------------------ one indentation

    def indent(self, begin: Callable[[], None], progress: Progress) -> Rests:
        """Press to the depth or to the force limit, and come back at the same speed."""
        assert self._drive is not None
        assert self._contact is not None
        drive, asked, limit_uN = self._drive, self.settings, self._limit_at(self._sensor.tared)
        contact_um = self._contact.place_um
        start_um, end_um = contact_um - asked.back_off_um, contact_um + asked.depth_um
        drive.go(start_um)
        if self._indented:
            self._let_recover(progress)
        self._indented = True
        unguarded = "" if self._guarded else "; NO FORCE GUARD watches (safety: none)"
        to = f"to {asked.depth_um:g} µm or {limit_uN:.4g} µN{unguarded}"
        progress.step(f"pressing at {asked.speed_um_s:g} µm/s, {to}")
        felt, lost = Felt(limit_uN, 1), Lost()
        total = round(2.0 * (end_um - start_um))

        def show(place_um: float, *, back: bool) -> None:
            done = place_um - start_um
            progress.count(min(max(round(total - done if back else done), 0), total), total)

        with ExitStack() as open_streams:
            open_streams.enter_context(drive.readings(felt))
            open_streams.enter_context(self._frames(lost))
            note(self.bus, self.clock, BEGIN, {})
            begin()
            self.clock.sleep(_AFTER_S)
            until_ns, rested_um = self.clock.now_ns(), drive.place_um
            deepest_um = drive.run(end_um, lambda: felt.enough or lost.too_long, lambda um: show(um, back=False))
            at_limit = felt.enough
            drive.hold(asked.hold_s, lambda: felt.saturated or felt.enough != at_limit or lost.too_long)
            lost.raise_if_too_long(self._camera.name)
            back_um = drive.run(start_um, lambda: lost.too_long, lambda um: show(um, back=True))
            since_ns = self.clock.now_ns()
            lost.raise_if_too_long(self._camera.name)
            self.clock.sleep(_AFTER_S)
            # A place read at rest is off by up to half a step, either time.
            rests = Rests(
                until_ns, since_ns, back_um - rested_um, drive.way.step_um / math.sqrt(6.0),
                turned_at_uN=limit_uN if at_limit and not felt.saturated else None,
            )  # fmt: skip
            note(self.bus, self.clock, END, rests._asdict())
        pressed_um = deepest_um - contact_um
        felt.raise_if_too_soon(pressed_um, speed_um_s=asked.speed_um_s, sensor=self._sensor.name)
        return rests

    def _let_recover(self, progress: Progress) -> None:
        """Wait until the specimen's surface has come to rest, as the camera sees it."""
        progress.step("waiting until the specimen has recovered")
        assert self._watcher is not None
        seen: list[float] = []
        lost = Lost()
        for _ in range(round(_LONGEST_RECOVERY_S / _WATCH_S)):
            sample = self._watcher.update(self._camera.grab())
            lost.take(sample)
            lost.raise_if_too_long(self._camera.name)
            seen.append(sample.deformation_um)
            if len(seen) > _WATCH_FRAMES and abs(seen[-1] - seen[-1 - _WATCH_FRAMES]) < _RECOVERED_UM:
                return
            self.clock.sleep(_WATCH_S)
        progress.step(f"the specimen was not seen to come to rest within {_LONGEST_RECOVERY_S:g} s; going on")

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
        """Stop, and take the probe away if it may touch something; a guard that does so already is let finish.

        A first Ctrl-C that comes now waits for that; a further one leaves the probe where it then is. Then, as when it
        cannot be taken away, `whereabouts` tells where it was last seen, and what was felt there.
        """
        try:
            with INTERRUPTION.held():
                self._take_away()
        except KeyboardInterrupt:
            self.whereabouts = self._last_seen()
            self._stage.stop(by="characterisation", reason="interrupted")
            raise
        except MicrodriversError as error:
            if not self._near:
                raise
            self.whereabouts = self._last_seen()
            error.what = f"{self.whereabouts}. {error.what}"
            if not self._rig.fake:
                back = "once the connection is back: " if isinstance(error, LinkError) else ""
                command = f"microdrivers move {self._rig.description.file} {self._stage.name} --retract"
                error.remedy = f"{back}{command}; or free it by hand. {error.remedy}".strip()
            raise

    def _take_away(self) -> None:
        self._rig.safety.finish()
        self._stage.stop(by="characterisation", reason="the experiment ended")
        if self._drive is None or not (self._near or self._stage.link == "open"):
            return
        self._drive.rest()
        if self._near and not self._rig.safety.took_away(self._stage.name):
            self._drive.take_away()
            self._near = False
        position = self._stage.read().position
        self.whereabouts = f"{self._stage.name} stands at {_written(position)}; {self._from_contact(position)}"

    def _from_contact(self, position: Mapping[str, float]) -> str:
        if self._contact is None or self._drive is None:
            took_away = self._rig.safety.took_away(self._stage.name)
            return "the force guard has taken it away" if took_away else "no contact was felt"
        before_um = self._contact.place_um - self._drive.way.place_um(position)
        return f"{abs(before_um):.0f} µm {'before' if before_um > 0.0 else 'beyond'} the contact"

    def _last_seen(self) -> str:
        """Where the newest samples say that the probe was, and what it felt, if it has been near the specimen."""
        pose, force = self._stage.topic.latest, self._sensor.topic.latest
        if not self._near:
            return "" if pose is None else f"{self._stage.name} was last seen at {_written(pose.position)}"
        place = "" if pose is None else self._from_contact(pose.position)
        at = "" if pose is None else f" at {_written(pose.position)}, {place}"
        felt = "" if force is None or math.isnan(force.force_uN) else f", with {force.force_uN:.4g} µN felt"
        if place.endswith("before the contact"):
            what = "the probe was not taken farther away"
        elif self._contact is None:
            what = "the probe was not taken away and may be near the specimen"
        else:
            what = "the probe was not taken away and may be pressing"
        return f"{what}: {self._stage.name} was last seen{at}{felt}"

    def setup(self) -> IndentationSetup:
        """Names, speed, scale and zoom."""
        tare = self._sensor.tared
        return IndentationSetup(
            sensor=self._sensor.name, stage=self._stage.name, camera=self._camera.name,
            scale_source=self._sight.source, scale_px_per_um=self._sight.scale_px_per_um,
            scale_sigma_px_per_um=self._sight.scale_sigma_px_per_um, zoom=self._zoom,
            speed_um_s=self.settings.speed_um_s, depth_um=self.settings.depth_um,
            tare_uN=None if tare is None else tare.offset_uN, bandwidth_hz=self._sensor.bandwidth_hz,
            guarded=self._guarded,
            touch_uN=None if self._contact is None else self._contact.touch_uN,
            touched_s=None if self._contact is None else self._contact.pressed_s,
        )  # fmt: skip


def _written(position: Mapping[str, float]) -> str:
    return ", ".join(f"{axis} {um:.1f} µm" for axis, um in position.items())


class _Travel(NamedTuple):
    """Frames at rest on a way through free space."""

    frames: list[Frame]
    places_um: list[float]
    scale_hint_px_per_um: float
