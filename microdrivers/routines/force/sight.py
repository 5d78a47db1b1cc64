"""What the camera needs to see an indentation: the probe's tip, the image's scale, and the contact point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from microdrivers.core.errors import IllConditioned, StaleCalibration
from microdrivers.core.samples import Frame
from microdrivers.devices.camera import Camera
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.estimators.vision.contact import DeformationTracker, ImageScale
from microdrivers.estimators.vision.contact_patch import contact_patch
from microdrivers.estimators.vision.moving_tip import NoMovingTip, TipView, find_moving_tip
from microdrivers.estimators.vision.template import FloatArray
from microdrivers.results.optics import OpticsResult, read_result
from microdrivers.rig import Rig

_SAME_ZOOM = 2e-3
"""Relative difference of two readings of the zoom within which a calibration holds."""

_SCALE_SLACK, _SIGMAS = 5e-3, 4.0
"""So far may the probe's travel contradict a calibration: this part of it, and so many standard deviations of both."""

TRAVEL = "the probe's own travel"


class Sight:
    """Learns what moves with the probe, then hands out a tracker of the contact point.

    Without an optical calibration the image's scale is measured by the probe's own travel in sight. With one, the
    travel must agree with it.

    Args:
        projection: µm along the probing direction from px, by an optical calibration. source: its name.
    """

    def __init__(self, projection: ImageScale | None = None, *, source: str = TRAVEL) -> None:
        self.source = source
        self._projection = projection
        self._tip: TipView | None = None

    @classmethod
    def calibrated(cls, rig: Rig, file: Path) -> Sight:
        """With the result of `calibrate optics`.

        Raises:
            ConfigError: the file holds no such result. StaleCalibration: it belongs to another camera, zoom, region
                or binning than the rig has now. IllConditioned: the probe moves across the plane that it holds for.
        """
        result, section = read_result(file), rig.file.probe
        if section is None:
            return cls()
        camera = rig.device(section.camera, Camera)
        _require_same(result, camera, rig, file)
        axis: FloatArray = np.array(rig.device(section.force, ForceSensor).axis, dtype=np.float64)
        if math.hypot(axis[0], axis[1]) < math.sqrt(0.5):
            raise IllConditioned(
                "the probe presses along the line of sight, where the camera sees no deformation",
                remedy="use a camera that looks across the probing direction",
            )
        scale = ImageScale.from_projection(
            np.array(result.projection)[:, :2],
            -axis,
            relative_sigma=result.scale_sigma_px_per_um / result.scale_px_per_um,
        )
        return cls(scale, source=f"optical calibration {file}")

    @property
    def projection(self) -> ImageScale | None:
        """That of an optical calibration; None if the probe's travel tells the scale."""
        return self._projection

    @property
    def scale_px_per_um(self) -> float | None:
        """Along the probing direction; None before the probe has travelled in sight."""
        return None if self._tip is None else self._scale(self._tip).px_per_um

    @property
    def scale_sigma_px_per_um(self) -> float | None:
        """Its standard deviation."""
        return None if self._tip is None else self._scale(self._tip).relative_sigma * self._scale(self._tip).px_per_um

    def learn(self, frames: Sequence[Frame], travel_um: Sequence[float], *, scale_hint_px_per_um: float) -> None:
        """Find the probe by its travel through free space.

        Raises:
            NoMovingTip: nothing moves as the probe does. StaleCalibration: the travel contradicts the calibration.
        """
        try:
            tip = find_moving_tip(frames, travel_um, scale_hint_px_per_um=scale_hint_px_per_um)
        except NoMovingTip as error:
            if error.reason == "nothing_moved":
                error.what = f"nothing in the picture moved while the probe travelled {np.ptp(travel_um):.0f} µm"
                error.remedy = (
                    "see that the probe's tip, and the specimen before it, are in view, in focus and lit, and that the "
                    "sensor's axis in the rig file is the one along which it is pushed; an emulated rig shows neither "
                    "without a specimen (--specimen)"
                )
            raise
        if self._projection is not None:
            _require_agreement(tip, self._projection)
        self._tip = tip

    def tracker(
        self, camera: str, frames: Sequence[Frame], *, contact_ahead_um: float, depth_um: float
    ) -> DeformationTracker:
        """A tracker of the contact point and the tip.

        Args:
            camera: name under which it publishes.
            frames: the undeformed specimen, the tip at rest before it.
            contact_ahead_um: how far ahead of the tip the contact was felt.
            depth_um: how far it will be pressed in; so long it must stay in view.

        Raises:
            NoContactPatch: nothing ahead of the tip can be tracked that stays in view.
        """
        assert self._tip is not None
        patch = contact_patch(frames, self._tip, gap_um=contact_ahead_um, depth_um=depth_um)
        tracker = DeformationTracker(camera, tip=self._tip, patch=patch, scale=self._scale(self._tip))
        rest = [tracker.update(frame) for frame in frames]
        tracker.set_contact(
            tip_um=float(np.nanmean([sample.tip_um for sample in rest])) + contact_ahead_um,
            deformation_um=float(np.nanmean([sample.deformation_um for sample in rest])),
        )
        return tracker

    def _scale(self, tip: TipView) -> ImageScale:
        return self._projection or ImageScale.from_travel(tip)


def zoom_of(rig: Rig) -> float | None:
    """What the microscope's zoom reads; None if the rig has none, or it cannot be asked."""
    microscope = rig.file.microscope
    motor = rig.devices.get(microscope.zoom) if microscope is not None else None
    return motor.read().zoom if isinstance(motor, ZoomMotor) and motor.link == "open" else None


def _require_same(result: OpticsResult, camera: Camera, rig: Rig, file: Path) -> None:
    valid, now, zoom, microscope = result.valid_for, camera.settings, zoom_of(rig), rig.file.microscope
    differences = []
    if valid.camera != camera.name:
        differences.append(f"of camera {valid.camera}, not {camera.name}")
    if zoom is None and microscope is not None and microscope.zoom in rig.devices:
        differences.append(f"at zoom {valid.zoom:.4g}, and {microscope.zoom} cannot be asked for its own")
    if zoom is not None and not math.isclose(valid.zoom, zoom, rel_tol=_SAME_ZOOM):
        differences.append(f"at zoom {valid.zoom:.4g}, and the zoom reads {zoom:.4g}")
    if (valid.binning, tuple(valid.roi)) != (now.binning, tuple(now.roi)):
        differences.append(f"with binning {valid.binning} and region {valid.roi}, not {now.binning} and {now.roi}")
    if differences:
        raise StaleCalibration(
            f"the calibration {file} is {'; '.join(differences)}",
            remedy="calibrate the optics as they are now, or leave the calibration out: the probe's travel gives the "
            "scale",
        )


def _require_agreement(tip: TipView, scale: ImageScale) -> None:
    travelled = tip.scale_px_per_um * float(np.dot(scale.um_per_px, tip.direction))
    allowed = _SCALE_SLACK + _SIGMAS * math.hypot(scale.relative_sigma, tip.scale_sigma_px_per_um / tip.scale_px_per_um)
    if abs(travelled - 1.0) > allowed:
        raise StaleCalibration(
            f"by the calibration the probe travelled {100.0 * travelled:.2f} % of what its encoder says",
            remedy="calibrate the optics as they are now, and check axes_in_rig and the units of the probe's stage",
            moved="yes",
        )
