"""A world file: what only a simulation knows. Every value is the centre or the spread of what a seed draws."""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from microdrivers.devices.drivers import DeviceSettings


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= pair[0] <= pair[1]:
        raise ValueError(f"a range is [smaller, larger], neither negative, not {list(pair)}")
    return pair


_Pair = Annotated[tuple[float, float], pydantic.AfterValidator(_rising)]


class StageWorld(DeviceSettings):
    """The sample stage's mechanics; noises are standard deviations, spreads are those of normal draws."""

    servo_lag_ms: float = pydantic.Field(default=4.0, gt=0)
    lost_motion_um: float = pydantic.Field(default=0.5, ge=0)
    lost_motion_deg: float = pydantic.Field(default=5e-4, ge=0)
    encoder_noise_um: float = pydantic.Field(default=0.010, ge=0)
    encoder_noise_deg: float = pydantic.Field(default=1e-5, ge=0)
    power_on_spread_um: float = pydantic.Field(default=1500.0, ge=0)
    latch_delay_ms: float = pydantic.Field(default=0.05, ge=0)
    latch_spread_ms: float = pydantic.Field(default=0.0255, ge=0)
    drift_spread_um_s: float = pydantic.Field(default=0.003, ge=0)


class ZoomWorld(DeviceSettings):
    """The zoom body behind the motor: play of the gear, and how far the optics differ from the engraved curve."""

    lost_motion_steps: float = pydantic.Field(default=8.0, ge=0)
    servo_lag_ms: float = pydantic.Field(default=1.0, gt=0)
    start_zoom: _Pair = (0.8, 1.1)
    curve_spread: float = pydantic.Field(default=0.003, ge=0)


class OpticsWorld(DeviceSettings):
    """The microscope. The angle is drawn from the whole circle, the handedness is tossed."""

    working_distance_um: float = pydantic.Field(default=45_000.0, gt=0)
    tilt_spread_deg: float = pydantic.Field(default=0.25, ge=0)
    boresight_spread_px: float = pydantic.Field(default=3.0, ge=0)


class CameraWorld(DeviceSettings):
    """The camera's times: delivery after the exposure's end, and the error of its own stamps.

    The stamp error is drawn once a world, normal with `stamp_spread_ms`; `stated_uncertainty_ms` is what the data
    sheet says of it, the half-width of the 95 % interval.
    """

    delivery_ms: _Pair = (6.0, 18.0)
    delivery_jitter_ms: float = pydantic.Field(default=1.0, ge=0)
    stamp_spread_ms: float = pydantic.Field(default=0.051, ge=0)
    stamp_jitter_ms: float = pydantic.Field(default=0.005, ge=0)
    stated_uncertainty_ms: float = pydantic.Field(default=0.1, gt=0)


class TargetWorld(DeviceSettings):
    """The square on the slide, and the dust around it."""

    side_um: float = pydantic.Field(default=400.0, gt=0)
    offset_um: float = pydantic.Field(default=450.0, ge=0)
    background_levels: _Pair = (90.0, 130.0)
    contrast_levels: _Pair = (100.0, 120.0)
    polarity: Literal["drawn", "dark", "bright"] = "drawn"
    blur_px: _Pair = (1.0, 1.5)
    noise_levels: float = pydantic.Field(default=2.0, ge=0)
    gradient_levels: float = pydantic.Field(default=6.0, ge=0)
    specks: int = pydantic.Field(default=12, ge=0, le=500)
    visible: bool = True


class ToolsWorld(DeviceSettings):
    """The fine stages' mechanics, and the one thing that tools can touch.

    The obstacle's surface lies `obstacle_um` below the middle of a tool's travel, z = −obstacle_um of its stage.
    """

    servo_lag_ms: float = pydantic.Field(default=2.0, gt=0)
    encoder_noise_um: float = pydantic.Field(default=0.010, ge=0)
    obstacle_um: float = 200.0
    obstacle_stiffness_uN_per_um: float = pydantic.Field(default=50.0, gt=0)


class SpecimenWorld(DeviceSettings):
    """The embryo that the gripper holds before the probe; it is there if the rig has a probe that can press on it.

    A probe is a force sensor on a fine stage whose `origin_um` is stated. `preset` gives the figures that are not
    stated here, see `Mechanics` for what they mean; `spread` is the relative standard deviation of springs and dampers
    from seed to seed. The surface lies 60 µm ahead of the probe's `ready_um`, or of its place with all axes at 0 if
    that is farther in, but at most at half of the way that the travel leaves; if the rig file states no `ready_um`,
    where 72 % of the probe's way from 0 is over; ± `place_spread_um`. Grains are what the embryo is textured with,
    drawn with that mean distance; those within `cap_um` of the contact point move with it.
    """

    preset: Literal["none", "single", "unloading_springs", "slip_corrected", "viscoelastic"] = "single"
    k1_uN_per_um: float | None = pydantic.Field(default=None, gt=0)
    k2_uN_per_um3: float | None = pydantic.Field(default=None, ge=0)
    b_loading_uN_s_per_um: float | None = pydantic.Field(default=None, ge=0)
    b_unloading_uN_s_per_um: float | None = pydantic.Field(default=None, ge=0)
    m_kg: float | None = pydantic.Field(default=None, ge=0)
    slip_um: float | None = pydantic.Field(default=None, ge=0)
    slip_rate_per_s: float | None = pydantic.Field(default=None, ge=0)
    branch_uN_per_um: float | None = pydantic.Field(default=None, ge=0)
    branch_s: float | None = pydantic.Field(default=None, gt=0)
    adhesion_uN: float | None = pydantic.Field(default=None, ge=0)
    spread: float = pydantic.Field(default=0.0, ge=0, le=0.5)
    place_spread_um: float = pydantic.Field(default=30.0, ge=0)
    diameter_um: float = pydantic.Field(default=1300.0, ge=800)
    cap_um: float = pydantic.Field(default=200.0, ge=0)
    grain_distance_um: float = pydantic.Field(default=18.0, ge=8)
    contrast_levels: _Pair = (40.0, 60.0)


class ForceWorld(DeviceSettings):
    """The force sensors' imperfections: white noise by device, drift, and the zero that they were switched on with."""

    noise_uN_per_sqrt_Hz: dict[str, float] = pydantic.Field(
        default_factory=lambda: {"probe_force": 0.002, "gripper_force": 0.07}
    )
    default_noise_uN_per_sqrt_Hz: float = pydantic.Field(default=0.07, ge=0)
    drift_uN_per_min: float = pydantic.Field(default=0.1, ge=0)
    zero_spread_uN: float = pydantic.Field(default=5.0, ge=0)


class WorldSettings(DeviceSettings):
    """A microscope that looks at a square on an XYθ stage, and tools on fine stages beside it."""

    schema_version: Literal[1] = 1
    world: Literal["microscope"] = "microscope"
    stage: StageWorld = StageWorld()
    zoom: ZoomWorld = ZoomWorld()
    optics: OpticsWorld = OpticsWorld()
    camera: CameraWorld = CameraWorld()
    target: TargetWorld = TargetWorld()
    tools: ToolsWorld = ToolsWorld()
    specimen: SpecimenWorld = SpecimenWorld()
    force: ForceWorld = ForceWorld()
