from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.estimators.vision import ContactEvent, VisualContact

START_NS = 5_000_000_000
ZERO_UM = 7.0


def sample(k: int, *, tip_um: float, deformation_um: float, sigma_um: float, found: bool = True) -> DeformationSample:
    return DeformationSample(
        t_ns=START_NS + round(k * 1e9 / 30), device="camera", seq=k, frame_seq=k, exposure_ms=2.0, u_px=0.0, v_px=0.0,
        deformation_um=deformation_um, sigma_um=sigma_um, tip_um=tip_um, tip_sigma_um=1.5 * sigma_um, found=found,
    )  # fmt: skip


def watch(
    tip_um: Callable[[float], float],
    *,
    seed: int,
    frames: int = 300,
    sigma_um: float = 0.03,
    deformation_um: Callable[[float], float] | None = None,
) -> tuple[ContactEvent | None, float]:
    """The event, and the time at which it came, s; the surface is at 0, the samples call it `ZERO_UM`."""
    rng = np.random.default_rng(seed)
    contact = VisualContact()
    for k in range(frames):
        t_s = k / 30.0
        place = tip_um(t_s)
        moved = max(0.0, place) if deformation_um is None else deformation_um(t_s)
        seen = sample(
            k,
            tip_um=place + ZERO_UM + 1.5 * sigma_um * rng.standard_normal(),
            deformation_um=moved + sigma_um * rng.standard_normal(),
            sigma_um=sigma_um,
        )
        event = contact.update(seen)
        if event is not None:
            assert contact.event is event
            return event, t_s
    return None, math.nan


@pytest.mark.parametrize(("speed_um_s", "sigma_um"), [(5.0, 0.03), (5.0, 0.1), (0.5, 0.03), (0.15, 0.03), (20.0, 0.03)])
def test_time_and_place_are_as_uncertain_as_they_say(speed_um_s: float, sigma_um: float) -> None:
    time_z, place_z, delays_s = [], [], []
    for seed in range(40):
        touch_s = 2.0 + 0.0017 * seed
        event, seen_s = watch(lambda t, at=touch_s: speed_um_s * (t - at), seed=seed, sigma_um=sigma_um)  # type: ignore[misc]
        assert event is not None
        time_z.append(((event.t_ns - START_NS) / 1e9 - touch_s) / event.sigma_s)
        place_z.append((event.tip_um - ZERO_UM) / event.tip_sigma_um)
        delays_s.append(seen_s - touch_s)
    assert 0.5 < np.mean(np.square(place_z)) < 1.5
    assert 0.5 < np.mean(np.square(time_z)) < 1.5
    # Six frames, then what tells a touch from another motion.
    assert np.max(delays_s) < 0.3 + 30.0 * sigma_um / speed_um_s


def test_a_tip_that_goes_in_steps() -> None:
    for touch_s in (3.9, 4.05, 4.2):
        event, _ = watch(lambda t, at=touch_s: 5.0 * (math.floor(2.0 * t) / 2.0 - at), seed=0)  # type: ignore[misc]
        assert event is not None
        assert event.tip_um == pytest.approx(ZERO_UM, abs=5.0 * event.tip_sigma_um)


def test_no_touch_no_event() -> None:
    assert watch(lambda t: 5.0 * (t - 1000.0), seed=1, frames=2000)[0] is None
    assert watch(lambda _t: -20.0, seed=2, frames=2000)[0] is None


def test_a_specimen_that_drifts_or_is_pushed_otherwise_is_not_touched() -> None:
    approach = lambda t: 5.0 * t - 1000.0  # noqa: E731
    assert watch(approach, seed=3, frames=900, deformation_um=lambda t: 0.003 * t)[0] is None
    assert watch(approach, seed=3, deformation_um=lambda t: 2.0 * max(0.0, t - 4.0))[0] is None
    assert watch(lambda _t: -20.0, seed=3, deformation_um=lambda t: 3.0 if t > 4.0 else 0.0)[0] is None
    assert watch(lambda _t: -20.0, seed=3, deformation_um=lambda t: 4.0 * max(0.0, t - 4.0))[0] is None


def test_a_push_from_elsewhere_does_not_hide_a_later_touch() -> None:
    pushed = lambda t: (3.0 if t > 3.0 else 0.0) + max(0.0, 5.0 * (t - 6.0))  # noqa: E731
    event, _ = watch(lambda t: 5.0 * (t - 6.0), seed=4, deformation_um=pushed)
    assert event is not None
    assert event.tip_um == pytest.approx(ZERO_UM, abs=5.0 * event.tip_sigma_um)
    assert event.deformation_um == pytest.approx(3.0, abs=5.0 * event.deformation_sigma_um)


def after_creep(creep_um: Callable[[float], float], touch_s: float, seed: int) -> ContactEvent | None:
    return watch(
        lambda t: 5.0 * (t - touch_s),
        seed=seed,
        frames=round(30 * touch_s) + 90,
        deformation_um=lambda t: creep_um(t) + max(0.0, 5.0 * (t - touch_s)),
    )[0]


@pytest.mark.parametrize("shift_um", [0.045, 0.1, 0.2])
@pytest.mark.parametrize("touch_s", [4.5, 8.0, 14.0])
def test_a_small_lasting_shift_does_not_hide_a_later_touch(shift_um: float, touch_s: float) -> None:
    for seed in range(5):
        event = after_creep(lambda t: shift_um if t > 2.0 else 0.0, touch_s, seed)
        assert event is not None
        assert event.tip_um == pytest.approx(ZERO_UM, abs=5.0 * event.tip_sigma_um)
        assert event.deformation_um == pytest.approx(shift_um, abs=5.0 * event.deformation_sigma_um)


@pytest.mark.parametrize("drift_um_s", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("touch_s", [5.0, 9.0, 14.0])
def test_a_drift_does_not_hide_a_later_touch(drift_um_s: float, touch_s: float) -> None:
    for seed in range(5):
        event = after_creep(lambda t: drift_um_s * t, touch_s, seed)
        assert event is not None
        # The rest is that of some seconds before.
        assert event.tip_um == pytest.approx(ZERO_UM, abs=0.1 + 3.0 * drift_um_s)


def test_a_shift_while_the_tip_rests_does_not_hide_a_later_touch() -> None:
    shifted = lambda t: (0.045 if t > 2.0 else 0.0) + max(0.0, 5.0 * (t - 12.0))  # noqa: E731
    event, _ = watch(lambda t: 5.0 * (max(t, 10.0) - 12.0), seed=6, frames=450, deformation_um=shifted)
    assert event is not None
    assert event.tip_um == pytest.approx(ZERO_UM, abs=5.0 * event.tip_sigma_um)


def test_lost_frames_are_left_out() -> None:
    contact = VisualContact()
    rng = np.random.default_rng(5)
    for k in range(200):
        place = 5.0 * (k / 30.0 - 4.0)
        lost = k % 3 == 0
        contact.update(
            sample(
                k,
                tip_um=math.nan if lost else place + 0.03 * rng.standard_normal(),
                deformation_um=math.nan if k % 6 == 0 else max(0.0, place) + 0.03 * rng.standard_normal(),
                sigma_um=0.03,
                found=k % 6 != 0,
            )
        )
    assert contact.event is not None
    assert contact.event.tip_um == pytest.approx(0.0, abs=0.15)
    assert (contact.event.t_ns - START_NS) / 1e9 == pytest.approx(4.0, abs=5.0 * contact.event.sigma_s)


def test_once_until_reset() -> None:
    contact = VisualContact()

    def press() -> int:
        return sum(
            contact.update(sample(k, tip_um=0.2 * (k - 30), deformation_um=max(0.0, 0.2 * (k - 30)), sigma_um=0.03))
            is not None
            for k in range(80)
        )

    assert [press(), press()] == [1, 0]
    contact.reset()
    assert contact.event is None
    assert press() == 1
