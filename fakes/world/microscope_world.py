"""A stage, a zoom and a microscope as one physical whole; everything is a function of time.

Each seed draws a world, not only noise: camera angle and handedness, tilt, place, polarity and contrast of the
target, blur, dust, play of the zoom, latency and stamp error of the camera, latch delay of the stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import OpticsTruth
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import WorldRequest
from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.contact_truth import ContactTruths
from microdrivers.fakes.world.optics import Microscope
from microdrivers.fakes.world.painting import Overlay
from microdrivers.fakes.world.scene import Look, Speck
from microdrivers.fakes.world.settings import WorldSettings
from microdrivers.fakes.world.specimen import Specimen, find_holder, find_probe, nominal_surface_um
from microdrivers.fakes.world.specimen_views import SpecimenView
from microdrivers.fakes.world.tools import Tools
from microdrivers.fakes.world.views import View, coarse_noise_seed, coarse_optics, lateral_view, nothing_px

Array = npt.NDArray[np.float64]


class MicroscopeWorld:
    """What the emulators share; they move `stage_axes`, `zoom_axis` and `fine_stage_axes` and look through `view`."""

    def __init__(self, request: WorldRequest[WorldSettings]) -> None:
        self.settings = request.settings
        self.seed = request.seed
        self.origin_ns = request.clock.now_ns()
        self._truth = request.bus.topic("truth/optics", OpticsTruth, history=4096)
        self._rig = request.rig
        probe = find_probe(request.rig) if request.settings.specimen.preset != "none" else None
        self._probe = probe
        random = np.random.default_rng(request.seed)
        self._draw_stage(random)
        self._draw_zoom(random)
        self._draw_optics(random)
        self._draw_target(random)
        self._draw_times(random)
        holder = find_holder(request.rig, probe) if probe is not None else None
        tools = Tools(
            request.rig.get("devices", {}),
            request.settings.tools,
            seed=request.seed,
            holder=holder.name if holder is not None else "",
        )
        self.fine_stage_axes = tools.axes
        self.fine_stage_home_um = tools.home_um
        self.fine_stage_power_on_offset_um = tools.power_on_offset_um
        self._tools = tools
        self.pressed: dict[str, Callable[[int], float]] = {}
        """By sensor: a force as a function of time that is put on its tip in place of what the tip touches."""
        self.specimen: Specimen | None = None
        self._contact_truths: ContactTruths | None = None
        if probe is not None:
            own = request.settings.specimen
            self.specimen = Specimen(own, probe, holder, tools.axes, seed=self.seed, origin_ns=self.origin_ns)
            self._contact_truths = ContactTruths(request.bus, self.specimen, preset=own.preset, t_ns=self.origin_ns)

    def close(self) -> None:
        """A world holds nothing that must be released."""

    # ------------------------------------------------------------------ state at an instant

    def zoom_at(self, t_ns: int) -> float:
        """Zoom of the optics, which lag behind the motor by the gear's play and differ from the engraved curve."""
        steps = self._zoom_cam_steps(t_ns)
        place = (steps - self._curve_steps[0]) / (self._curve_steps[-1] - self._curve_steps[0])
        engraved = math.exp(float(np.interp(steps, self._curve_steps, self._curve_log_zoom)))
        return engraved * (1.0 + self._curve_error * math.cos(2.0 * math.pi * place))

    def force_uN(self, sensor: str, t_ns: int) -> float:
        """True force on a sensor's tip along its axis."""
        pressed = self.pressed.get(sensor)
        if pressed is not None:
            return pressed(t_ns)
        force_uN = self._tools.force_uN(sensor, t_ns)
        if self.specimen is not None and sensor == self.specimen.sensor:
            force_uN += self.specimen.touch_at(t_ns).force_uN
        return force_uN

    def corners_px(self, t_ns: int) -> Array:
        """The target's corners, 4×2 px from the principal point."""
        return self.microscope.project(
            self._on_stage(self._corners_um, t_ns), zoom=self.zoom_at(t_ns), time_s=self._s(t_ns)
        )

    def _visible_corners_px(self, t_ns: int) -> Array:
        return nothing_px(t_ns) if self._target_away(t_ns) else self.corners_px(t_ns)

    def _target_away(self, t_ns: int) -> bool:
        return not self.settings.target.visible or self.specimen_in_view(t_ns)

    def specimen_in_view(self, t_ns: int) -> bool:
        """Whether cameras from above see specimen and tools, and not the slide; see docs/decisions/0015.

        They look at what was moved last, probe or slide.
        """
        if self.specimen is None:
            return False
        if not self._device("sample_stage"):
            return True
        slide_ns = _commanded_ns(self.stage_axes, t_ns)
        probe_ns = _commanded_ns(self.fine_stage_axes[self.specimen.probe.tool.name], t_ns)
        return probe_ns is not None and (slide_ns is None or slide_ns < probe_ns)

    def view(self, camera: str) -> View:
        """What a camera of the rig file sees: the microscope's own, one from the side, or any other from above."""
        section = self._rig.get("devices", {}).get(camera, {})
        if camera == (self._rig.get("microscope") or {}).get("camera", camera):
            return View(
                self.look,
                self._visible_corners_px,
                (self.seed, 7),
                self._blobs_px,
                self.publish_truth,
                self._overlay(self.microscope, self.zoom_at),
            )
        if section.get("view") == "lateral":
            return lateral_view(camera, self.look, self.fine_stage_axes, self.specimen, seed=self.seed)
        optics = coarse_optics(camera, self.microscope, seed=self.seed)

        def corners_px(t_ns: int) -> Array:
            if self.specimen_in_view(t_ns):
                return nothing_px(t_ns)
            return optics.project(self._on_stage(self._corners_um, t_ns), zoom=1.0, time_s=self._s(t_ns))

        return View(
            self.look,
            corners_px,
            coarse_noise_seed(camera, seed=self.seed),
            overlay=self._overlay(optics, lambda _t_ns: 1.0),
        )

    def _overlay(self, optics: Microscope, zoom_at: Callable[[int], float]) -> Callable[[int, int], Overlay | None]:
        if self.specimen is None:
            return lambda _t_ns, _exposure_ns: None

        def project(places_um: Array, t_ns: int) -> Array:
            return optics.project(places_um[:, :2], zoom=zoom_at(t_ns), time_s=self._s(t_ns))

        seen = SpecimenView(self.specimen, project, blur_px=self.look.blur_px, seed=self.seed)
        return lambda t_ns, exposure_ns: seen.overlay(t_ns, exposure_ns) if self.specimen_in_view(t_ns) else None

    def publish_truth(self, t_ns: int, frame_seq: int) -> None:
        """Put the truth of a frame on the bus, for the report and tests."""
        stage = {name: axis.position_at(t_ns) for name, axis in self.stage_axes.items()}
        zoom = self.zoom_at(t_ns)
        first_corner = self._on_stage(self._corners_um, t_ns)[0]
        jacobian = self.microscope.jacobian(first_corner, zoom=zoom, time_s=self._s(t_ns)).tolist()
        self._truth.publish(
            OpticsTruth(
                t_ns=t_ns,
                device="world",
                t_source="computed",
                frame_seq=frame_seq,
                x_um=stage["x"],
                y_um=stage["y"],
                theta_deg=stage["theta"],
                corners_px=tuple(self.corners_px(t_ns).ravel().tolist()),
                jacobian_px_per_um=(*jacobian[0], *jacobian[1]),
                scale_px_per_um=self.microscope.scale_per_zoom_px_per_um * zoom,
                angle_deg=self.microscope.angle_deg,
                mirrored=self.microscope.mirrored,
                zoom=zoom,
                tilt_deg=self.microscope.tilt_deg,
            )
        )
        if self._contact_truths is not None:
            self._contact_truths.publish(t_ns, frame_seq)

    # ------------------------------------------------------------------ geometry

    def _s(self, t_ns: int) -> float:
        return (t_ns - self.origin_ns) / NS_PER_S

    def _on_stage(self, slide_um: Array, t_ns: int) -> Array:
        """Slide coordinates (from the axis of rotation) to stage-plane coordinates."""
        theta = math.radians(self.stage_axes["theta"].position_at(t_ns))
        turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
        table = np.array([self.stage_axes["x"].position_at(t_ns), self.stage_axes["y"].position_at(t_ns)])
        return np.asarray(slide_um @ turn.T + table)

    def _zoom_cam_steps(self, t_ns: int) -> float:
        """The cam follows the motor behind half the gear's play on either side, through every turn so far."""
        half = 0.5 * self.settings.zoom.lost_motion_steps
        cam = self._cam_start_steps
        for motor in (*self.zoom_axis.knots_until(t_ns), self.zoom_axis.position_at(t_ns)):
            cam = min(max(cam, motor - half), motor + half)
        return cam

    def _blobs_px(self, t_ns: int, origin: Array) -> Array:
        if not self._specks or self.specimen_in_view(t_ns):
            return np.empty((0, 4))
        places = np.array([(speck.x_um, speck.y_um) for speck in self._specks])
        scale = self.microscope.scale_per_zoom_px_per_um * self.zoom_at(t_ns)
        image = origin + self.microscope.project(
            self._on_stage(places, t_ns), zoom=self.zoom_at(t_ns), time_s=self._s(t_ns)
        )
        sizes = np.array([(scale * speck.radius_um, speck.depth_levels) for speck in self._specks])
        return np.hstack([image, sizes])

    # ------------------------------------------------------------------ drawing a world

    def _device(self, role: str) -> Mapping[str, Any]:
        name = (self._rig.get("microscope") or {}).get(role, "")
        settings: Mapping[str, Any] = self._rig.get("devices", {}).get(name, {})
        return settings

    def _draw_stage(self, random: np.random.Generator) -> None:
        world = self.settings.stage
        axes = self._device("sample_stage").get("axes", {})
        travel = {
            name: axes.get(name, {}).get(f"travel_{unit}", fallback)
            for name, unit, fallback in (
                ("x", "um", (0, 15000)),
                ("y", "um", (0, 15000)),
                ("theta", "deg", (-180, 180)),
            )
        }
        self.reference_position = {name: 0.5 * (low + high) for name, (low, high) in travel.items()}
        self.encoder_noise = {
            "x": world.encoder_noise_um, "y": world.encoder_noise_um, "theta": world.encoder_noise_deg,
        }  # fmt: skip
        spread = {"x": world.power_on_spread_um, "y": world.power_on_spread_um, "theta": 0.2}
        start = {
            name: middle + float(np.clip(random.normal(0.0, spread[name]), -3 * spread[name], 3 * spread[name]))
            for name, middle in self.reference_position.items()
        }
        self.stage_axes = {
            name: Axis(
                min(max(start[name], travel[name][0]), travel[name][1]),
                lag_s=world.servo_lag_ms / 1000.0,
                lost_motion=world.lost_motion_deg if name == "theta" else world.lost_motion_um,
            )
            for name in ("x", "y", "theta")
        }
        # An incremental encoder counts from where it was switched on.
        self.power_on_offset = {name: -start[name] for name in start}

    def _draw_zoom(self, random: np.random.Generator) -> None:
        world = self.settings.zoom
        points = self._device("zoom").get("curve", [[0, 0.75], [10_000, 11.25]])
        self._curve_steps = np.array([float(steps) for steps, _ in points])
        self._curve_log_zoom = np.log(np.array([float(zoom) for _, zoom in points]))
        self._curve_error = float(random.normal(0.0, world.curve_spread))
        start_zoom = float(random.uniform(*world.start_zoom))
        start_steps = float(np.interp(math.log(start_zoom), self._curve_log_zoom, self._curve_steps))
        self.zoom_axis = Axis(round(start_steps), lag_s=world.servo_lag_ms / 1000.0)
        self._cam_start_steps = start_steps

    def _draw_optics(self, random: np.random.Generator) -> None:
        world = self.settings.optics
        camera = self._device("camera")
        microscope = self._rig.get("microscope") or {}
        pitch_um = float(camera.get("pixel_pitch_um", 7.4))
        lens = float(microscope.get("objective", 1.5)) * float(microscope.get("adapter", 1.0))
        drift = self.settings.stage.drift_spread_um_s
        self.microscope = Microscope(
            scale_per_zoom_px_per_um=lens / pitch_um,
            distance_um=world.working_distance_um,
            angle_deg=float(random.uniform(-180.0, 180.0)),
            mirrored=bool(random.random() < 0.5),
            tilt_deg=abs(float(random.normal(0.0, world.tilt_spread_deg))),
            tilt_direction_deg=float(random.uniform(-180.0, 180.0)),
            axis_um=self._middle_um(),
            boresight_px=(
                float(random.normal(0, world.boresight_spread_px)),
                float(random.normal(0, world.boresight_spread_px)),
            ),
            drift_um_s=(float(random.normal(0.0, drift)), float(random.normal(0.0, drift))),
        )

    def _middle_um(self) -> tuple[float, float]:
        """What the microscope looks at: the middle of the sample stage's travel, or where the specimen should be."""
        if self._probe is not None and not self._device("sample_stage"):
            x_um, y_um, _ = nominal_surface_um(self._probe).tolist()
            return x_um, y_um
        return self.reference_position["x"], self.reference_position["y"]

    def _draw_target(self, random: np.random.Generator) -> None:
        world = self.settings.target
        half = 0.5 * world.side_um
        square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        turn = math.radians(float(random.uniform(-180.0, 180.0)))
        rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        distance = world.offset_um * math.sqrt(float(random.random()))
        direction = float(random.uniform(-math.pi, math.pi))
        centre = np.array([distance * math.cos(direction), distance * math.sin(direction)])
        self._corners_um = square @ rotation.T + centre
        contrast = float(random.uniform(*world.contrast_levels))
        tossed = 1.0 if random.random() < 0.5 else -1.0
        sign = {"drawn": tossed, "dark": -1.0, "bright": 1.0}[world.polarity]
        background = float(random.uniform(*world.background_levels)) + (40.0 if sign < 0 else 0.0)
        gradient = random.normal(0.0, world.gradient_levels / 2.0, size=2)
        self.look = Look(
            background_levels=background,
            contrast_levels=sign * contrast,
            blur_px=float(random.uniform(*world.blur_px)),
            noise_levels=world.noise_levels,
            gradient_levels=(float(gradient[0]), float(gradient[1])),
        )
        self._specks = self._draw_specks(random, centre)

    def _draw_specks(self, random: np.random.Generator, centre: Array) -> list[Speck]:
        """Dust on the slide, clear of the target's edges by a tenth of its side."""
        world = self.settings.target
        specks: list[Speck] = []
        while len(specks) < world.specks:
            place = centre + random.uniform(-4.0, 4.0, size=2) * world.side_um
            radius_um, depth = float(random.uniform(3.0, 12.0)), float(random.uniform(8.0, 40.0))
            if np.hypot(*(place - centre)) > (0.5 * math.sqrt(2.0) + 0.1) * world.side_um + 3.0 * radius_um:
                specks.append(Speck(float(place[0]), float(place[1]), radius_um, depth))
        return specks

    def _draw_times(self, random: np.random.Generator) -> None:
        stage, camera = self.settings.stage, self.settings.camera
        latch_ms = stage.latch_delay_ms + float(random.normal(0.0, stage.latch_spread_ms))
        self.pose_latch_delay_s = max(0.0, latch_ms) / 1000.0
        self.delivery_delay_s = float(random.uniform(*camera.delivery_ms)) / 1000.0
        self.stamp_error_s = float(random.normal(0.0, camera.stamp_spread_ms)) / 1000.0


def _commanded_ns(axes: Mapping[str, Axis], t_ns: int) -> int | None:
    """When any of the axes was told to go somewhere last, up to `t_ns`."""
    return max((at_ns for axis in axes.values() if (at_ns := axis.commanded_ns(t_ns)) is not None), default=None)


def check_world(world: object) -> MicroscopeWorld:
    """The world as what a camera needs.

    Raises:
        ConfigError: it is another kind of world.
    """
    if not isinstance(world, MicroscopeWorld):
        raise ConfigError("the emulated camera needs a 'microscope' world", remedy="set world: microscope")
    return world
