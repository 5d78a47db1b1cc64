"""Gathers the ground truth of a simulated contact from `truth/*` topics and compares a result with it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from microdrivers.core.bus import Bus
from microdrivers.core.contact_samples import ContactTruth, DeformationSample, SpecimenTruth
from microdrivers.results.force import ForceResult, ForceTruth


class ContactTruthCollector:
    """Listens to `truth/contact` and `truth/specimen`; holds nothing if nobody publishes there."""

    def __init__(self, bus: Bus) -> None:
        self.contacts: dict[int, ContactTruth] = {}
        self._specimen = bus.topic("truth/specimen", SpecimenTruth)
        bus.topic("truth/contact", ContactTruth).subscribe(self._take)

    def _take(self, truth: ContactTruth) -> None:
        self.contacts[truth.frame_seq] = truth

    def compare(self, result: ForceResult, deformations: Sequence[DeformationSample]) -> ForceTruth | None:
        """The truth, and the errors of the best fit and of the deformations; None if there is none."""
        specimen = self._specimen.latest
        if specimen is None:
            return None
        best, slip = result.protocols[result.best], result.slip
        pairs = {
            "k1": (best.k1_uN_per_um, specimen.k1_uN_per_um),
            "k2": (best.k2_uN_per_um3, specimen.k2_uN_per_um3),
            "b": (best.b_uN_s_per_um, specimen.b_loading_uN_s_per_um),
        }
        if slip is not None and specimen.slip_um and result.best == "slip_corrected":
            pairs |= {
                "slip_offset": (slip.offset_um, specimen.slip_um),
                "slip_rate": (slip.rate_per_s, specimen.slip_rate_per_s),
            }
        return ForceTruth(
            preset=specimen.preset,
            k1_uN_per_um=specimen.k1_uN_per_um,
            k2_uN_per_um3=specimen.k2_uN_per_um3,
            b_uN_s_per_um=specimen.b_loading_uN_s_per_um,
            b_unloading_uN_s_per_um=specimen.b_unloading_uN_s_per_um,
            m_kg=specimen.m_kg,
            slip_offset_um=specimen.slip_um,
            slip_rate_per_s=specimen.slip_rate_per_s,
            outside_model=_outside_model(specimen),
            errors_percent={name: 100.0 * (value / true - 1.0) for name, (value, true) in pairs.items() if true},
            vision_deformation_rms_um=self._deformation_rms_um(deformations),
        )

    def _deformation_rms_um(self, deformations: Sequence[DeformationSample]) -> float | None:
        """RMS of seen minus true deformation, the zero aside."""
        differences = [
            sample.deformation_um - self.contacts[sample.frame_seq].deformation_um
            for sample in deformations
            if sample.found and sample.frame_seq in self.contacts
        ]
        return float(np.std(differences)) if len(differences) > 1 and math.isfinite(sum(differences)) else None


def _outside_model(specimen: SpecimenTruth) -> list[str]:
    """Effects that eq. (21) does not know."""
    effects = []
    if specimen.branch_uN_per_um:
        effects.append(
            f"a viscoelastic branch of {specimen.branch_uN_per_um:g} µN/µm that relaxes in {specimen.branch_s:g} s"
        )
    if specimen.adhesion_uN:
        effects.append(f"adhesion up to {specimen.adhesion_uN:g} µN")
    return effects
