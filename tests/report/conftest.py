"""A calibration as a run would leave it, made from a plain least-squares fit of a synthetic circle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from microdrivers.estimators.optics import optical_parameters
from microdrivers.results.optics import (
    OpticsResult,
    Tilt,
    Traces,
    Truth,
    ValidFor,
    ZoomChange,
    iterations_to_settle,
)
from microdrivers.results.record import Provenance

MakeResult = Callable[..., OpticsResult]
PITCH_UM = 7.4


@pytest.fixture(scope="session")
def make_result() -> MakeResult:
    return synthetic_result


def synthetic_result(
    *,
    frames: int = 100,
    zoom_change: bool = True,
    with_truth: bool = True,
    magnification: bool = True,
    noise_px: float = 0.01,
    angle_deg: float = -93.4,
    mirrored: bool = True,
    provenance: dict[str, Any] | None = None,
    **changes: Any,
) -> OpticsResult:
    """`changes` replace fields of the result, `provenance` those of its provenance."""
    rng = np.random.default_rng(7)
    moving = np.zeros(frames, dtype=bool)
    zoom = np.full(frames, 1.2)
    if zoom_change:
        first = min(45, frames // 2)
        moving[first : first + 3] = True
        zoom[:first] = 0.9
        zoom[first : first + 3] = (0.97, 1.07, 1.16)
    turn = np.radians(4.0) * np.arange(frames)
    pose = np.column_stack([7510.0 + 300.0 * np.cos(turn), 7490.0 + 300.0 * np.sin(turn)])
    p_true = [_projection(value, angle_deg, mirrored) for value in zoom]
    image = np.array([p[:, :2] @ xy + p[:, 2] for p, xy in zip(p_true, pose, strict=True)])
    image += rng.normal(0.0, noise_px, image.shape)

    estimates: list[np.ndarray | None] = []
    prior: list[float | None] = []
    posterior: list[float | None] = []
    start = 0
    for k in range(frames):
        if moving[k]:
            start = max(k - 2, 0)
        elif k and moving[max(k - 3, 0) : k].any():
            start = k - 2
        newest = np.append(pose[k], 1.0)
        before = next((p for p in reversed(estimates) if p is not None), None)
        now = _fit(pose[start : k + 1], image[start : k + 1]) if k - start >= 2 else None
        prior.append(None if before is None else float(np.linalg.norm(image[k] - before @ newest)))
        posterior.append(None if now is None or k - start < 3 else float(np.linalg.norm(image[k] - now @ newest)))
        estimates.append(now)

    final = estimates[-1]
    assert final is not None
    covariance, dof = _covariance(pose[start:], image[start:], final)
    of_final = optical_parameters(final.ravel().tolist(), covariance, degrees_of_freedom=dof, pixel_pitch_um=PITCH_UM)
    each = [None if p is None else optical_parameters(p.ravel().tolist()) for p in estimates]
    scales = [None if o is None else o.scale_px_per_um for o in each]
    fields: dict[str, Any] = {
        "complete": True,
        "projection": tuple(map(tuple, final.tolist())),
        "scale_px_per_um": of_final.scale_px_per_um,
        "scale_sigma_px_per_um": of_final.sigma_scale_px_per_um,
        "zoom": float(zoom[-1]),
        "magnification": of_final.magnification if magnification else None,
        "angle_deg": of_final.angle_deg,
        "angle_sigma_deg": of_final.sigma_angle_deg,
        "tilt": Tilt(interval_deg=of_final.tilt_deg_interval, label=of_final.tilt_label),
        "view": of_final.view,
        "translation_um": of_final.translation_um,
        "covariance": covariance.tolist(),
        "degrees_of_freedom": dof,
        "prediction_error_px": prior,
        "posterior_error_px": posterior,
        "magnification_trace": [s * PITCH_UM if s is not None and magnification else None for s in scales],
        "zoom_change": _change(moving, zoom, prior, posterior),
        "frames": frames,
        "lost_frames": 0,
        "unmatched_frames": 1,
        "valid_for": ValidFor(
            camera="camera_fine", binning=1, roi=(0, 0, 640, 480), objective=1.5, zoom=float(zoom[-1])
        ),
        "traces": Traces(
            frame=list(range(frames)),
            time_s=(np.arange(frames) / 30.0).tolist(),
            x_um=pose[:, 0].tolist(),
            y_um=pose[:, 1].tolist(),
            u_px=image[:, 0].tolist(),
            v_px=image[:, 1].tolist(),
            zoom=zoom.tolist(),
            zoom_moving=moving.tolist(),
            projection=[None if p is None else tuple(p.ravel().tolist()) for p in estimates],
            scale_px_per_um=scales,
            angle_deg=[None if o is None else o.angle_deg for o in each],
        ),
        "notes": ["1 frame had no pose close enough before and after it."],
        "provenance": _provenance(provenance or {}),
        "truth": _truth(p_true[-1], float(zoom[-1]), angle_deg, mirrored) if with_truth else None,
    }
    return OpticsResult.model_validate(fields | changes)


def _projection(zoom: float, angle_deg: float, mirrored: bool) -> np.ndarray:
    scale = zoom * 1.5 / PITCH_UM
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    linear = scale * np.array([[c, s if mirrored else -s], [s, -c if mirrored else c]])
    return np.column_stack([linear, -linear @ np.array([7480.0, 7525.0])])


def _fit(pose: np.ndarray, image: np.ndarray) -> np.ndarray:
    centre = pose.mean(axis=0)
    design = np.column_stack([pose - centre, np.ones(len(pose))])
    p = np.linalg.lstsq(design, image, rcond=None)[0].T
    p[:, 2] -= p[:, :2] @ centre
    return p


def _covariance(pose: np.ndarray, image: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, float]:
    design = np.column_stack([pose, np.ones(len(pose))])
    dof = float(len(pose) - 3)
    residual = image - design @ p.T
    return np.kron(residual.T @ residual / dof, np.linalg.inv(design.T @ design)), dof


def _change(
    moving: np.ndarray, zoom: np.ndarray, prior: list[float | None], posterior: list[float | None]
) -> ZoomChange | None:
    if not moving.any():
        return None
    first, last = (int(np.flatnonzero(moving)[i]) for i in (0, -1))
    return ZoomChange(
        first_frame=first,
        last_moving_frame=last,
        zoom_before=float(zoom[first - 1]),
        zoom_after=float(zoom[-1]),
        iterations_to_0p1_px=iterations_to_settle(prior, first_frame=first),
        iterations_to_0p1_px_from_end=iterations_to_settle(prior, first_frame=last + 1),
        posterior_iterations_to_0p1_px=iterations_to_settle(posterior, first_frame=first),
        posterior_iterations_to_0p1_px_from_end=iterations_to_settle(posterior, first_frame=last + 1),
    )


def _truth(p: np.ndarray, zoom: float, angle_deg: float, mirrored: bool) -> Truth:
    scale = zoom * 1.5 / PITCH_UM
    return Truth(
        projection=tuple(map(tuple, p.tolist())),
        scale_px_per_um=scale,
        zoom=zoom,
        magnification=scale * PITCH_UM,
        angle_deg=angle_deg,
        tilt_deg=0.2,
        view="along_minus_z_or_mirrored" if mirrored else "along_plus_z",
        translation_um=(float(p[0, 2]) / scale, float(p[1, 2]) / scale),
        errors={},
    )


def _provenance(changes: dict[str, Any]) -> Provenance:
    fields: dict[str, Any] = {
        "microdrivers_version": "0.1.0",
        "created_utc": "2025-03-04T09:15:42+00:00",
        "command": "microdrivers calibrate optics --rig configs/workstation.yaml --fake --seed 7",
        "source": "live rig",
        "rig_name": "workstation",
        "rig_file": "configs/workstation.yaml",
        "rig": {
            "name": "workstation",
            "microscope": {"objective": 1.5, "adapter": 1.0, "target": {"kind": "square", "side_um": 400}},
            "devices": {"sample_stage": {"driver": "pi-gcs-xytheta", "serial": None}},
        },
        "fake": True,
        "seed": 7,
        "clock": "simulated",
        "devices": {
            "sample_stage": {"driver": "pi-gcs-xytheta", "vendor": "PI", "model": "C-884", "serial_number": "1170"},
            "camera_fine": {"driver": "camera", "vendor": "", "model": "emulated"},
        },
        "settings": {"radius_um": 300.0, "zoom": [0.9, 1.2], "frames": 100, "probe_um": None, "offset_um": -2.5},
        "python": "3.11.7",
        "platform": "Linux x86_64",
    }
    return Provenance.model_validate(fields | changes)
