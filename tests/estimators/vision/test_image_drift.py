"""The picture's drift, from a tool that has come back."""

import math

import numpy as np
import pytest

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.estimators.vision.image_drift import image_drift

NOISE_UM = 0.03
RATE_UM_S = 0.004


def rest(random, from_s, place_um, *, frames=15, seen=True):
    times = from_s + np.arange(frames) / 30.0
    return [
        DeformationSample(
            t_ns=round(1e9 * t), device="camera", seq=k, deformation_um=0.0, sigma_um=NOISE_UM,
            tip_um=place_um + RATE_UM_S * t + random.normal(0.0, NOISE_UM) if seen else math.nan,
            tip_sigma_um=NOISE_UM, u_px=0.0, v_px=0.0, found=True, frame_seq=k, exposure_ms=4.0,
        )
        for k, t in enumerate(times.tolist())
    ]  # fmt: skip


def test_drift_is_what_the_tip_moved_and_its_encoder_did_not():
    errors = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        drift = image_drift(
            rest(random, 1.0, -15.0), rest(random, 46.0, -14.9),
            travel_um=0.1 + random.normal(0.0, 0.02), travel_sigma_um=0.02,
        )  # fmt: skip
        errors.append((drift.rate_um_s - RATE_UM_S) / drift.sigma_um_s)
    assert np.std(errors) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(errors)) < 0.25
    assert drift.sigma_um_s == pytest.approx(math.hypot(0.02, NOISE_UM * math.sqrt(2 / 15)) / 45.0, rel=0.3)
    assert drift.um_at(drift.from_ns) == 0.0
    assert drift.um_at(drift.from_ns + 10**10) == pytest.approx(10.0 * drift.rate_um_s)


def test_a_tip_that_is_hardly_seen_tells_no_drift():
    random = np.random.default_rng(0)
    there = rest(random, 1.0, 0.0)
    for gone in (rest(random, 46.0, 0.0, seen=False), rest(random, 46.0, 0.0, frames=4)):
        assert image_drift(there, gone, travel_um=0.0, travel_sigma_um=0.02) is None
        assert image_drift(gone, there, travel_um=0.0, travel_sigma_um=0.02) is None
