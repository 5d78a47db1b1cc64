"""A source that presses on a made-up specimen, F = b·v + k1·x + k2·x³ in closed form, without any device."""

from __future__ import annotations

import math
import pathlib

import numpy as np

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, utc_now
from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.samples import ForceSample
from microdrivers.routines.force import build_result
from microdrivers.routines.force.source import IndentationNames, IndentationSetup, Rests
from microdrivers.routines.past_run import PastRun
from microdrivers.routines.provenance import describe_run

REAL = pathlib.Path(__file__).parents[1] / "data" / "force" / "chiaro_aebp1_30hz.csv"
K1, K2, B = 3.0, 2e-4, 20.0
SPEED_UM_S, DEPTH_UM, PERIOD_NS = 5.0, 60.0, 33_333_333


def result_of(run, **known):
    """Its result, as `calibrate force` makes it."""
    known = {"source": "made up", "clock": "simulated"} | known
    return build_result(run, describe_run(known, command="calibrate force", now=utc_now()))


class MadeUpSource:
    """Publishes a ramp in and out at 30 Hz.

    `broken_off_at` raises in the middle of an indentation; the contact point is `lost` in these frames; the sensor is
    saturated from `range_uN` on; the picture drifts, as a tip at rest shows, which `stuck_uN` holds at the end.
    """

    past_run = PastRun()
    past_settings = None
    repeatable = True
    whereabouts = ""

    def __init__(
        self, *, seed=0, broken_off_at=None, error=None, depth_noise_um=0.05, offset_uN=0.0, lost=(), range_uN=1e9,
        drift_um_s=None, stuck_uN=0.0,
    ):  # fmt: skip
        self.bus = Bus()
        self.clock = SimulatedClock()
        self.names = IndentationNames("force", "deformation", None)
        self.finished = 0
        self.indentations = 0
        self._random = np.random.default_rng(seed)
        self._broken_off_at = broken_off_at
        self._error = error
        self._depth_noise_um = depth_noise_um
        self._offset_uN = offset_uN
        self._lost = lost
        self._range_uN = range_uN
        self._drift_um_s = drift_um_s
        self._stuck_uN = stuck_uN
        self._now_ns = 0

    def prepare(self, progress):
        progress.step("ready")

    def indent(self, begin, progress):
        begin()
        self.indentations += 1
        begun_ns = self._now_ns
        turn_s = 3.0 + DEPTH_UM / SPEED_UM_S
        for k in range(round((2 * turn_s) * 1e9 / PERIOD_NS)):
            if k == self._broken_off_at:
                raise self._error
            time_s = k * PERIOD_NS / 1e9
            loading = time_s < turn_s
            stage_um = SPEED_UM_S * ((time_s - 3.0) if loading else (turn_s - 3.0) - (time_s - turn_s))
            x_um = max(stage_um, 0.0)
            v = (SPEED_UM_S if loading else -SPEED_UM_S) if x_um > 0.0 else 0.0
            # The damper pulls the surface behind the tip: let it go with the tip, and the force end at zero.
            pressed_uN = max(B * v + K1 * x_um + K2 * x_um**3, 0.0)
            held_uN = self._stuck_uN if time_s > 2.0 * turn_s - 1.0 else 0.0
            self._publish(x_um, pressed_uN + held_uN + self._offset_uN, k not in self._lost)
        if self._drift_um_s is None:
            return None
        return Rests(begun_ns + 500_000_000, self._now_ns - 500_000_000, travel_um=0.0, travel_sigma_um=0.01)

    def finish(self):
        self.finished += 1

    def setup(self):
        return IndentationSetup("force", None, None, "made up", 0.25, 1e-5, None, SPEED_UM_S, 0.0)

    def _publish(self, x_um, force_uN, found):
        self._now_ns += PERIOD_NS
        seq = self._now_ns // PERIOD_NS
        raw_uN = min(force_uN + 0.02 * self._random.standard_normal(), self._range_uN)
        full = raw_uN >= self._range_uN
        self.bus.topic("force", ForceSample).publish(
            ForceSample(
                t_ns=self._now_ns, device="force", seq=seq, force_uN=math.nan if full else raw_uN, raw_uN=raw_uN,
                flags=frozenset({"SATURATED"} if full else ()),
            )
        )  # fmt: skip
        tip_um = (self._drift_um_s or 0.0) * self._now_ns / 1e9
        seen_um = x_um + tip_um + self._depth_noise_um * self._random.standard_normal()
        self.bus.topic("deformation", DeformationSample).publish(
            DeformationSample(
                t_ns=self._now_ns, device="deformation", seq=seq, deformation_um=seen_um if found else math.nan,
                sigma_um=self._depth_noise_um, tip_um=tip_um, tip_sigma_um=0.03, u_px=0.0, v_px=0.0,
                found=found, frame_seq=seq, exposure_ms=0.0,
            )
        )  # fmt: skip
