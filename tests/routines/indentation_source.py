"""A source that presses on a made-up specimen, F = b·v + k1·x + k2·x³ in closed form, without any device."""

from __future__ import annotations

import numpy as np

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.samples import ForceSample
from microdrivers.routines.force.source import IndentationNames, IndentationSetup

K1, K2, B = 3.0, 2e-4, 20.0
SPEED_UM_S, DEPTH_UM, PERIOD_NS = 5.0, 60.0, 33_333_333


class MadeUpSource:
    """Publishes a ramp in and out at 30 Hz; `broken_off_at` raises in the middle of an indentation."""

    repeatable = True

    def __init__(self, *, seed=0, broken_off_at=None, error=None, depth_noise_um=0.05, offset_uN=0.0):
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
        self._now_ns = 0

    def prepare(self, progress):
        progress.step("ready")

    def indent(self, begin, progress):
        begin()
        self.indentations += 1
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
            self._publish(x_um, max(B * v + K1 * x_um + K2 * x_um**3, 0.0) + self._offset_uN)

    def finish(self):
        self.finished += 1

    def setup(self):
        return IndentationSetup("force", None, None, "made up", 0.25, 1e-5, None, SPEED_UM_S, 0.0)

    def _publish(self, x_um, force_uN):
        self._now_ns += PERIOD_NS
        seq = self._now_ns // PERIOD_NS
        force_uN += 0.02 * self._random.standard_normal()
        self.bus.topic("force", ForceSample).publish(
            ForceSample(t_ns=self._now_ns, device="force", seq=seq, force_uN=force_uN, raw_uN=force_uN)
        )
        seen_um = x_um + self._depth_noise_um * self._random.standard_normal()
        self.bus.topic("deformation", DeformationSample).publish(
            DeformationSample(
                t_ns=self._now_ns, device="deformation", seq=seq, deformation_um=seen_um,
                sigma_um=self._depth_noise_um, tip_um=float("nan"), tip_sigma_um=float("nan"), u_px=0.0, v_px=0.0,
                found=True, frame_seq=seq, exposure_ms=0.0,
            )
        )  # fmt: skip
