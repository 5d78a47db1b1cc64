"""Indentations of simulated specimens: an equation of motion integrated in fine steps, and what camera and sensor see.

Shares nothing with the estimators. A stage carries a force sensor (a spring) whose tip presses on a specimen; the
specimen pushes only, its surface stays behind when the tip leaves faster than it recovers, and it may slip in its
holder and creep.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FRAME_HZ = 30.0


@dataclass(frozen=True)
class Specimen:
    """Spring, damper and mass of Bilen et al., eq. (21), holding slip of eq. (26), and a Maxwell branch beside them."""

    k1: float
    k2: float
    b_loading: float
    b_unloading: float = 0.0
    m_kg: float = 0.0
    slip_um: float = 0.0
    slip_rate: float = 0.1
    maxwell: float = 0.0
    maxwell_s: float = 3.0


PRESETS = {
    "single": Specimen(4.5161, 1e-4, 27.72, 27.72),
    "unloading_springs": Specimen(2.9577, 1e-4, 51.3317, 0.0),
    "slip_corrected": Specimen(5.8781, 3.8346e-5, 1.1834, 0.0, slip_um=25.0),
    "viscoelastic": Specimen(4.5161, 1e-4, 5.0, 5.0, maxwell=2.0),
}


@dataclass(frozen=True)
class Push:
    """A trapezoid of the stage, along the probing direction from the undeformed surface: out, in, hold, out again.

    It comes back at `back_um_s` if that is given; `ripple_um` at `ripple_hz` is added to the stage while it moves in.
    """

    start_um: float = -20.0
    depth_um: float = 120.0
    speed_um_s: float = 5.0
    back_um_s: float | None = None
    acceleration_um_s2: float = 1000.0
    hold_s: float = 0.0
    rest_s: float = 0.5
    phase: float = 0.0
    exposure_s: float = 0.01
    sensor_uN_per_um: float = 1000.0
    ripple_um: float = 0.0
    ripple_hz: float = 1.0


@dataclass(frozen=True)
class Truth:
    """One indentation without noise, a value a frame; the times of contact and of its loss."""

    time_s: Array
    deformation_um: Array
    tip_um: Array
    force_uN: Array
    compression_um: Array
    in_contact: npt.NDArray[np.bool_]
    contact_s: float


def _ramp(t: Array, push: Push, speed_um_s: float, begin_s: float) -> Array:
    """Distance covered since `begin_s` on a trapezoidal velocity profile that runs the whole way."""
    ramp_s = speed_um_s / push.acceleration_um_s2
    whole_s = _way_s(push, speed_um_s)
    s = np.clip(t - begin_s, 0.0, whole_s)
    up = np.minimum(s, ramp_s)
    down = np.maximum(s - (whole_s - ramp_s), 0.0)
    cruise = np.clip(s - ramp_s, 0.0, whole_s - 2 * ramp_s)
    a = push.acceleration_um_s2
    return 0.5 * a * up**2 + speed_um_s * cruise + speed_um_s * down - 0.5 * a * down**2


def _way_s(push: Push, speed_um_s: float) -> float:
    return (push.depth_um - push.start_um) / speed_um_s + speed_um_s / push.acceleration_um_s2


def duration_s(push: Push) -> float:
    return (
        2.0 * push.rest_s
        + _way_s(push, push.speed_um_s)
        + push.hold_s
        + _way_s(push, push.back_um_s or push.speed_um_s)
    )


def stage_um(t: Array, push: Push) -> Array:
    """Where the tip would be without a force."""
    in_s = _way_s(push, push.speed_um_s)
    ripple = np.zeros_like(t)
    if push.ripple_um:
        s = np.clip(t - push.rest_s, 0.0, in_s)
        turns = max(1.0, np.round(push.ripple_hz * in_s))
        ripple = push.ripple_um * np.sin(2.0 * np.pi * turns * s / in_s)
    into = _ramp(t, push, push.speed_um_s, push.rest_s)
    back = _ramp(t, push, push.back_um_s or push.speed_um_s, push.rest_s + in_s + push.hold_s)
    return push.start_um + into - back + ripple


def indent(specimen: Specimen, push: Push, *, steps_a_frame: int = 20) -> Truth:
    """Integrate one indentation, implicit Euler, the contact decided anew in every step."""
    dt = 1.0 / FRAME_HZ / steps_a_frame
    t = np.arange(int(duration_s(push) / dt) + steps_a_frame) * dt
    x = speed = creep = slip = 0.0
    decay = 1.0 / (1.0 + dt / specimen.maxwell_s)
    touched_s = math.nan
    rows = []

    def next_x(sensor: float, target: float) -> float:
        """The compression after this step, with the sensor's spring pulling the surface towards `target`."""
        springs = specimen.k1 + specimen.k2 * x * x
        inward = sensor * (target - x) - springs * x - decay * creep > 0.0
        b = specimen.b_loading if inward else specimen.b_unloading
        inertia = b / dt + specimen.m_kg / dt**2
        linear = inertia + decay * specimen.maxwell + specimen.k1 + sensor
        constant = inertia * x + specimen.m_kg * speed / dt + decay * (specimen.maxwell * x - creep) + sensor * target
        new = x
        for _ in range(3):
            new -= (linear * new + specimen.k2 * new**3 - constant) / (linear + 3.0 * specimen.k2 * new * new)
        return new

    for now, stage in zip(t.tolist(), stage_um(t, push).tolist(), strict=True):
        if math.isnan(touched_s) and stage > 0.0:
            touched_s = now - stage / push.speed_um_s
        force = new = 0.0
        if not math.isnan(touched_s):
            slip = -specimen.slip_um * math.expm1(-specimen.slip_rate * (now - touched_s))
            new = next_x(push.sensor_uN_per_um, stage - slip)
            force = push.sensor_uN_per_um * (stage - slip - new)
            if force <= 0.0:
                force, new = 0.0, next_x(0.0, 0.0)
        creep = decay * (creep + specimen.maxwell * (new - x))
        speed, x = (new - x) / dt, new
        rows.append((x + slip, x, force, force > 0.0))
    surface, compression, felt, contact = np.array(rows, dtype=np.float64).T
    return _seen(t, push, surface, compression, felt, contact, touched_s)


def _seen(
    t: Array, push: Push, surface: Array, compression: Array, force: Array, contact: Array, contact_s: float
) -> Truth:
    dt = t[1] - t[0]
    summed = np.concatenate([[0.0], np.cumsum((force[1:] + force[:-1]) / 2.0 * dt)])
    frames = np.arange(int((duration_s(push) - 2.0 / FRAME_HZ) * FRAME_HZ)) / FRAME_HZ
    at = frames + (0.5 + push.phase) / FRAME_HZ
    half = push.exposure_s / 2.0
    mean = (np.interp(at + half, t, summed) - np.interp(at - half, t, summed)) / push.exposure_s
    tip = stage_um(at, push) - mean / push.sensor_uN_per_um
    return Truth(
        time_s=at,
        deformation_um=np.interp(at, t, surface),
        tip_um=tip,
        force_uN=mean,
        compression_um=np.interp(at, t, compression),
        in_contact=np.interp(at, t, contact) > 0.99,
        contact_s=contact_s,
    )


@dataclass(frozen=True)
class Noise:
    """Per sample, white; and the zero of the deformation, where the camera happened to begin."""

    deformation_um: float = 0.06
    force_uN: float = 0.05
    zero_um: float = 0.0
    drift_uN_per_s: float = 0.0


def measured(
    truth: Truth, noise: Noise, rng: np.random.Generator, *, of: str = "surface"
) -> tuple[Array, Array, Array]:
    """Time, deformation and force as measured; `of` is `surface` or `tip`."""
    seen = truth.deformation_um if of == "surface" else truth.tip_um
    n = len(truth.time_s)
    deformation = seen + noise.zero_um + noise.deformation_um * rng.standard_normal(n)
    force = truth.force_uN + noise.drift_uN_per_s * truth.time_s + noise.force_uN * rng.standard_normal(n)
    return truth.time_s, deformation, force


def varied(push: Push, rng: np.random.Generator) -> Push:
    """The same push with another start, depth (≥ 100 µm) and phase of the frames."""
    return dataclasses.replace(
        push,
        start_um=float(rng.uniform(-25.0, -12.0)),
        depth_um=float(rng.uniform(105.0, 135.0)),
        hold_s=float(rng.choice([0.0, 0.0, 2.0])),
        phase=float(rng.uniform(-0.4, 0.4)),
    )
