"""The touch by which a tool finds a specimen: felt in noise and drift; what it means for the indentation after it."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.samples import ForceSample
from microdrivers.devices.force_sensor import Tare
from microdrivers.estimators.force.model import SpecimenModel
from microdrivers.routines.force.approach import tare_s
from microdrivers.routines.force.touch_checks import slip_used_up_um, surface_ahead_um
from microdrivers.routines.force.watches import Touch

RATE_HZ, NOISE_UN = 1000.0, 1.8
SLIPS = SpecimenModel(5.8781, 3.8e-5, 1.1834, 0.0, slip_um=25.0, slip_rate_per_s=0.1)


def sensor(noise_uN=NOISE_UN):
    tare = Tare(t_ns=0, offset_uN=0.0, sigma_uN=noise_uN, n=500)
    return SimpleNamespace(tared=tare, stream_rate_hz=RATE_HZ, bandwidth_hz=RATE_HZ / 2.0)


def feel(touch, forces_uN, *, noise_uN=NOISE_UN, begin_s=0.0, seed=0):
    """Feed forces until the touch is felt; returns when that was, or None."""
    noise = noise_uN * np.random.default_rng(seed).standard_normal(len(forces_uN))
    for k, force_uN in enumerate((forces_uN + noise).tolist()):
        if touch.enough:
            return k / RATE_HZ
        touch.take(reading(begin_s + k / RATE_HZ, force_uN))
    return None


def go_on(touch, force_uN, *, begin_s, duration_s=0.15):
    for k in range(round(duration_s * RATE_HZ)):
        touch.take(reading(begin_s + k / RATE_HZ, force_uN))


def reading(time_s, force_uN):
    return ForceSample(t_ns=round(1e9 * time_s), device="force", force_uN=force_uN, raw_uN=force_uN, tare_uN=0.0)


@pytest.mark.parametrize("drift_uN_s", [-1.0, 0.0, 1.0])
def test_a_soft_specimen_is_felt_in_noise_and_drift_within_two_micrometres(drift_uN_s):
    time_s = np.arange(0.0, 12.0, 1.0 / RATE_HZ)
    specimen_uN = 3.0 * 2.0 * np.maximum(time_s - 8.0, 0.0)  # 3 µN/µm at 2 µm/s
    touch = Touch(sensor())
    felt_s = feel(touch, drift_uN_s * time_s + specimen_uN)
    assert 8.0 < felt_s < 9.0
    go_on(touch, drift_uN_s * felt_s, begin_s=felt_s)
    assert touch.is_over
    assert 0.0 < touch.pressed_s < 0.2


def test_a_force_that_stays_is_no_touch():
    time_s = np.arange(0.0, 40.0, 1.0 / RATE_HZ)
    touch = Touch(sensor())
    felt_s = feel(touch, 1.0 * time_s)
    assert 10.0 < felt_s < 20.0  # 14 µN of drift
    go_on(touch, felt_s, begin_s=felt_s)
    assert not touch.is_over


def test_noise_alone_is_no_touch():
    touch = Touch(sensor())
    assert feel(touch, np.zeros(60_000)) is None


def test_a_zero_is_taken_so_long_that_a_drift_shows():
    noisy_s = tare_s(sensor(), sensor().tared)
    assert 1.0 < noisy_s < 1.2
    assert tare_s(sensor(0.045), sensor(0.045).tared) < 0.1
    slope_sigma_uN_s = NOISE_UN * np.sqrt(12.0 / (RATE_HZ * noisy_s)) / noisy_s
    assert 6.0 * slope_sigma_uN_s == pytest.approx(1.0, rel=1e-6)


def left_after(model, speed_um_s, touch_uN):
    """What eq. (26) leaves of a slip when an approach first feels `touch_uN`, in small steps."""
    step_s, slip_um, tool_um = 1e-4, 0.0, 0.0
    while True:
        tool_um += speed_um_s * step_s
        slip_um = min(slip_um + step_s * model.slip_rate_per_s * (model.slip_um - slip_um), tool_um)
        if model.k1_uN_per_um * (tool_um - slip_um) > touch_uN:
            return model.slip_um - slip_um


@pytest.mark.parametrize("speed_um_s", [3.0, 5.0, 20.0])
def test_what_an_approach_has_used_up_of_a_slip_is_looked_back_at(speed_um_s):
    left_um = left_after(SLIPS, speed_um_s, 1.0)
    found = SLIPS._replace(slip_um=left_um)
    used_um = slip_used_up_um(found, speed_um_s=speed_um_s, touch_uN=1.0, touched_s=0.0)
    assert used_um == pytest.approx(25.0 - left_um, rel=0.02)


def test_a_specimen_that_withdraws_as_fast_as_the_tool_comes_may_have_slipped_any_way():
    left_um = left_after(SLIPS, 2.0, 1.0)
    assert left_um < 19.0
    found = SLIPS._replace(slip_um=left_um)
    assert slip_used_up_um(found, speed_um_s=2.0, touch_uN=1.0, touched_s=0.1) == np.inf
    assert slip_used_up_um(found, speed_um_s=1.0, touch_uN=1.0, touched_s=0.1) == np.inf
    unmoved = SLIPS._replace(slip_um=0.0, slip_rate_per_s=0.0)
    assert slip_used_up_um(unmoved, speed_um_s=2.0, touch_uN=1.0, touched_s=0.1) == 0.0


def frames(surface_um, *, count=200, depth_um=40.0):
    for k in range(count):
        tip_um = -15.0 + (depth_um + 15.0) * k / (count - 1)
        pressed_um = max(tip_um - surface_um, 0.0)
        yield DeformationSample(
            t_ns=k, device="camera", seq=k, deformation_um=pressed_um, sigma_um=0.03, tip_um=tip_um, tip_sigma_um=0.03,
            u_px=0.0, v_px=0.0, found=True, frame_seq=k, exposure_ms=2.0,
        )  # fmt: skip


@pytest.mark.parametrize("surface_um", [-2.0, 0.0, 25.0])
def test_the_camera_shows_where_the_surface_lies(surface_um):
    assert surface_ahead_um(frames(surface_um)) == pytest.approx(surface_um, abs=1e-9)


def test_a_specimen_that_recovers_more_slowly_than_the_tip_goes_back_shows_its_surface_all_the_same():
    pressed = list(frames(0.0))
    last = pressed[-1]
    left_behind = [
        msgspec.structs.replace(
            last, t_ns=last.t_ns + k, tip_um=last.tip_um - 0.7 * k, deformation_um=last.deformation_um - 0.05 * k
        )
        for k in range(1, 3 * len(pressed))
    ]
    assert surface_ahead_um([*pressed, *left_behind]) == pytest.approx(0.0, abs=1e-9)


def test_a_tool_that_presses_on_nothing_shows_no_surface():
    assert surface_ahead_um(frames(41.0)) is None
    assert surface_ahead_um([]) is None
