"""Records that no protocol explains: what the loading says by itself, and a slip that is none, are not to be quoted."""

from __future__ import annotations

import re

import numpy as np
import pytest

from microdrivers.estimators.force.identify import Identification, identify
from microdrivers.estimators.force.record import IndentationRecord

K1, K2, B = 3.5, 3e-4, 28.0
SPEED_UM_S, DEPTH_UM, RATE_HZ, FINE = 5.0, 110.0, 30.0, 20


def record(
    *, free_s: float = 2.0, noise_uN: float = 1.0, slip_um: float = 0.0, arm: tuple[float, float] | None = None,
    drift_uN_s: float = 0.0, step_uN: float = 0.0, late_s: float = 0.0,
) -> IndentationRecord:  # fmt: skip
    """Pressed and let go of at one speed; damped both ways, with what eq. (21) does not have."""
    turn_s, end_s = free_s + DEPTH_UM / SPEED_UM_S, 2.0 * free_s + 2.0 * DEPTH_UM / SPEED_UM_S
    fine_s = np.arange(0.0, end_s, 1.0 / (RATE_HZ * FINE))
    tool_um = np.interp(fine_s, [0.0, free_s, turn_s, end_s - free_s, end_s], [0.0, 0.0, DEPTH_UM, 0.0, 0.0])
    slipped_um = slip_um * -np.expm1(-0.1 * np.maximum(fine_s - free_s, 0.0))
    x = tool_um - slipped_um
    v = np.gradient(x, fine_s)
    force_uN = B * v + K1 * x + K2 * x**3
    if arm is not None:
        stiffness, time_s = arm
        kept = np.exp(-1.0 / (RATE_HZ * FINE * time_s))
        pull = 0.0
        for k, step in enumerate(np.diff(x, prepend=0.0).tolist()):
            pull = kept * pull + stiffness * step
            force_uN[k] += pull
    force_uN = np.where(x > 1e-9, np.maximum(force_uN, 0.0), 0.0)
    random = np.random.default_rng(0)
    t = np.arange(0.0, end_s, 1.0 / RATE_HZ)
    felt_uN = np.interp(t - late_s, fine_s, force_uN) + drift_uN_s * t + np.where(t > turn_s + 2.0, step_uN, 0.0)
    return IndentationRecord(
        t, np.interp(t, fine_s, tool_um) + 0.02 * random.standard_normal(len(t)),
        felt_uN + noise_uN * random.standard_normal(len(t)),
    )  # fmt: skip


def stepped(found: Identification) -> list[str]:
    return [note for note in found.notes if "each steady: the sensor's zero has stepped" in note]


@pytest.mark.parametrize(
    "amiss",
    [
        pytest.param({"slip_um": 5.0}, id="a slip and a damper both ways"),
        pytest.param({"late_s": 0.3}, id="a force that is late"),
        pytest.param({"drift_uN_s": 1.0, "free_s": 0.5}, id="a drift that the ends do not show"),
    ],
)
def test_the_loading_is_not_quoted_where_what_fits_both_branches_contradicts_it(amiss):
    found = identify(record(**amiss))
    assert found.misfit.found
    for name in ("loading", "loading_only"):
        fit = found.protocols[name]
        assert not any(fit.identifiable[key] for key in ("k1", "k2", "b"))
        assert f"no protocol explains both branches, and {found.best} fits them with " in fit.weak["b"]


def test_what_rests_on_a_slip_that_is_none_is_not_quoted():
    found = identify(record(arm=(3.0, 10.0), noise_uN=5.0))
    fit = found.protocols["slip_corrected"]
    assert not found.slip.identifiable
    assert found.best != "slip_corrected"
    assert not any(fit.identifiable[key] for key in ("k1", "k2", "b"))
    assert "what it takes for slip is none" in fit.weak["k1"]


def test_a_zero_that_steps_is_no_drift_and_leaves_the_loading_its_own():
    found = identify(record(step_uN=20.0))
    (note,) = stepped(found)
    before_uN, after_uN = map(float, re.findall(r"(-?[\d.]+) µN (?:before|after)", note))
    assert (before_uN, after_uN) == (pytest.approx(0.0, abs=0.5), pytest.approx(20.0, abs=0.5))
    assert np.ptp(found.baseline_uN) == 0.0
    fit = found.protocols["loading"]
    assert fit.k1_uN_per_um == pytest.approx(K1, rel=0.005)
    assert fit.b_loading_uN_s_per_um == pytest.approx(B, rel=0.005)


@pytest.mark.parametrize("drift_uN_s", [0.0, 0.05, 0.2, 1.0])
def test_a_straight_drift_is_no_step(drift_uN_s):
    found = identify(record(drift_uN_s=drift_uN_s))
    assert stepped(found) == []
    assert found.protocols[found.best].b_loading_uN_s_per_um == pytest.approx(B, rel=0.005)
