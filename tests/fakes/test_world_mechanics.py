"""What a specimen answers, step by step, against closed-form solutions."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.fakes.world.mechanics import AT_REST, PRESETS, Contact, Mechanics, Memory

STEP_S = 0.0005
SPRING = 1000.0
LINEAR = Mechanics(4.0, 0.0, 20.0, 20.0)
SPEED_UM_S = 20.0


class Course(NamedTuple):
    """What happened, a row a step."""

    time_s: np.ndarray
    compression_um: np.ndarray
    slip_um: np.ndarray
    force_uN: np.ndarray
    touched: np.ndarray


def press(mechanics, depth_um, duration_s, *, spring=SPRING, step_s=STEP_S, memory=AT_REST, reachable=True):
    """Follow a depth that is a function of time."""
    contact = Contact(mechanics, stiffness_uN_per_um=spring)
    pace = contact.pace(step_s)
    rows = []
    for t in step_s * np.arange(1, round(duration_s / step_s) + 1):
        memory, force_uN = contact.step(memory, pace, float(depth_um(t)), reachable)
        rows.append((t, memory.compression_um, memory.slip_um, force_uN, memory.touched))
    return Course(*np.array(rows).T)


def there_and_back(turn_s):
    return lambda t: SPEED_UM_S * min(t, 2 * turn_s - t)


def test_a_ramp_ends_in_the_exact_solution_with_the_sensors_spring_in_series():
    course = press(LINEAR, lambda t: SPEED_UM_S * t, 0.5)
    rate = (LINEAR.k1_uN_per_um + SPRING) / LINEAR.b_loading_uN_s_per_um
    share = SPRING / (LINEAR.k1_uN_per_um + SPRING)
    exact = share * SPEED_UM_S * (course.time_s - (1 - np.exp(-rate * course.time_s)) / rate)
    assert course.compression_um[200:] == pytest.approx(exact[200:], rel=1e-3)
    assert course.compression_um == pytest.approx(exact, abs=2e-3)
    assert course.force_uN == pytest.approx(SPRING * (SPEED_UM_S * course.time_s - course.compression_um), rel=1e-9)


@pytest.mark.parametrize("preset", ["single", "unloading_springs", "slip_corrected"])
def test_both_branches_obey_the_model_of_the_paper(preset):
    own = PRESETS[preset]
    course = press(own, there_and_back(6.5), 13.0, step_s=2 * STEP_S)
    assert course.compression_um.max() > 100.0
    speed = np.gradient(course.compression_um, course.time_s)
    damping = np.where(speed > 0, own.b_loading_uN_s_per_um, own.b_unloading_uN_s_per_um)
    x = course.compression_um
    model = damping * speed + own.k1_uN_per_um * x + own.k2_uN_per_um3 * x**3
    # Away from the contact, the reversal and the loss, where the speed jumps.
    steady = (course.touched > 0) & (course.time_s > 0.6) & (np.abs(course.time_s - 6.5) > 0.6)
    steady &= course.time_s < course.time_s[course.touched > 0][-1] - 0.3
    assert steady.sum() > 5_000
    np.testing.assert_allclose(course.force_uN[steady], model[steady], rtol=1e-3, equal_nan=False)


def test_slip_tends_to_its_offset_while_touched_and_stays():
    own = PRESETS["slip_corrected"]._replace(slip_rate_per_s=0.4)
    course = press(own, there_and_back(6.5), 15.0)
    touched = course.touched > 0
    since_s = course.time_s - course.time_s[touched][0]
    exact = 25.0 * (1.0 - np.exp(-0.4 * since_s))
    np.testing.assert_allclose(course.slip_um[touched], exact[touched], rtol=0.0, atol=1e-6, equal_nan=False)
    depth_um = np.array([there_and_back(6.5)(t) for t in course.time_s[touched]])
    shares = course.compression_um + course.slip_um + course.force_uN / SPRING
    np.testing.assert_allclose(shares[touched], depth_um, rtol=0.0, atol=1e-9, equal_nan=False)
    assert not touched[-1]
    assert course.slip_um[-1] == pytest.approx(course.slip_um[touched][-1], abs=0.01)
    assert course.slip_um[-1] == course.slip_um[-1000] > 24.0


def test_the_maxwell_branch_relaxes_after_a_step():
    own = Mechanics(4.0, 1e-4, 0.0, 0.0, branch_uN_per_um=2.0, branch_s=3.0)
    course = press(own, lambda t: 50.0, 3.0, spring=math.inf)
    exact = 4.0 * 50.0 + 1e-4 * 50.0**3 + 2.0 * 50.0 * np.exp(-course.time_s / 3.0)
    assert course.force_uN == pytest.approx(exact, rel=1e-3)


def test_a_viscous_membrane_is_lost_on_the_way_back_and_follows_by_its_own_law():
    course = press(LINEAR, there_and_back(5.0), 14.0)
    lost = np.flatnonzero(course.touched)[-1] + 1
    # F = k·x − b·v = 0 there.
    assert course.compression_um[lost] == pytest.approx(
        LINEAR.b_unloading_uN_s_per_um * SPEED_UM_S / LINEAR.k1_uN_per_um, rel=0.02
    )
    assert not course.force_uN[lost:].any()
    assert course.force_uN.min() == 0.0
    since_s = course.time_s[lost:] - course.time_s[lost]
    decay = course.compression_um[lost] * np.exp(-since_s * LINEAR.k1_uN_per_um / LINEAR.b_unloading_uN_s_per_um)
    assert course.compression_um[lost:] == pytest.approx(decay, rel=2e-3, abs=1e-3)


def test_a_membrane_that_is_met_on_its_way_back_pushes_from_there():
    relaxing = Memory(20.0, 0.0, 0.0, 0.0, False)
    contact = Contact(LINEAR, stiffness_uN_per_um=SPRING)
    assert contact.step(relaxing, contact.pace(STEP_S), 19.9, True)[1] == 0.0
    memory, force_uN = contact.step(relaxing, contact.pace(STEP_S), 20.5, True)
    assert memory.touched
    assert force_uN > 0.0


def test_without_damping_the_membrane_stays_at_the_tip_until_its_surface():
    own = PRESETS["unloading_springs"]
    course = press(own, there_and_back(2.0), 6.0)
    lost = np.flatnonzero(course.touched)[-1]
    assert course.compression_um[lost] == pytest.approx(0.0, abs=0.01)
    assert course.compression_um[-1] == 0.0


def test_adhesion_holds_the_tip_until_it_pulls_too_hard():
    own = LINEAR._replace(b_loading_uN_s_per_um=1.0, b_unloading_uN_s_per_um=1.0, adhesion_uN=30.0)
    course = press(own, there_and_back(1.0), 6.0)
    assert course.force_uN.min() == pytest.approx(-30.0, abs=0.2)
    assert course.compression_um.min() == pytest.approx(-(30.0 - 20.0) / 4.0, abs=0.1)
    assert course.force_uN[-1] == 0.0
    assert not course.touched[-1]
    approaching = press(own, lambda t: -1.0 + t, 0.9)
    assert not approaching.force_uN.any()


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_there_is_no_force_without_contact(preset):
    assert not press(PRESETS[preset], lambda t: -0.01, 0.5).force_uN.any()
    assert not press(PRESETS[preset], lambda t: 80.0, 0.5, reachable=False).force_uN.any()


def test_mass_resists_acceleration():
    own = LINEAR._replace(m_kg=2.0)
    course = press(own, lambda t: 0.5 * 10.0 * t * t, 3.0, spring=math.inf)
    t = course.time_s
    exact = 2.0 * 10.0 + 20.0 * 10.0 * t + 4.0 * 5.0 * t * t
    # A speed is known half a step late.
    assert course.force_uN[1:] == pytest.approx(exact[1:], abs=1.01 * 20.0 * 10.0 * STEP_S / 2)


def test_mass_swings_on_the_sensors_spring_after_a_reversal():
    own = LINEAR._replace(b_loading_uN_s_per_um=1.0, b_unloading_uN_s_per_um=1.0)
    light, heavy = (press(own._replace(m_kg=mass), there_and_back(2.0), 3.0) for mass in (0.0, 0.02))
    turn = round(2.0 / STEP_S) + 20
    wave = heavy.force_uN[turn:] - light.force_uN[turn:]
    crossings = np.flatnonzero(np.diff(np.sign(wave)))[:6]
    assert 2.0 * np.diff(crossings).mean() * STEP_S == pytest.approx(2 * math.pi / math.sqrt(1004.0 / 0.02), rel=0.05)


def test_the_step_is_short_enough():
    own = PRESETS["single"]
    usual, fine = (press(own, there_and_back(3.0), 6.0, step_s=step_s) for step_s in (STEP_S, STEP_S / 5))
    difference = np.abs(usual.force_uN - fine.force_uN[4::5])
    loss_s = usual.time_s[usual.touched > 0][-1]
    jumps = [np.abs(usual.time_s - t) < 0.25 for t in (0.0, 3.0, loss_s)]
    assert difference[~np.logical_or.reduce(jumps)].max() < 1e-4 * usual.force_uN.max()
    assert difference.max() < 5e-3 * usual.force_uN.max()


@settings(deadline=None, max_examples=60)
@given(
    before=st.floats(-5.0, 500.0),
    depth=st.floats(-500.0, 1000.0),
    duration_s=st.floats(1e-9, 1e-2),
    preset=st.sampled_from(sorted(PRESETS)),
    spring=st.sampled_from([10.0, 1000.0, math.inf]),
)
def test_any_step_balances_and_never_pulls(before, depth, duration_s, preset, spring):
    own = PRESETS[preset]._replace(m_kg=0.0, branch_uN_per_um=0.0)
    contact = Contact(own, stiffness_uN_per_um=spring)
    memory, force_uN = contact.step(Memory(before, 0.0, 0.0, 0.0, False), contact.pace(duration_s), depth, True)
    assert force_uN >= 0.0
    c, rate = memory.compression_um, memory.rate_um_s
    damping = own.b_loading_uN_s_per_um if rate > 0 else own.b_unloading_uN_s_per_um
    answer = damping * rate + own.k1_uN_per_um * c + own.k2_uN_per_um3 * c**3
    # Rounding of c shows in its rate.
    slack = 1e-6 + 1e-9 * abs(answer) + damping * 1e-12 * (1 + abs(c) + abs(before)) / duration_s
    assert answer == pytest.approx(force_uN, abs=slack + (1e-9 * spring * abs(depth) if spring < 1e9 else 0.0))
