"""The result of a force characterisation: `result.json` and `specimen.yaml`, schema version 1.

Keys are stable: a key is never renamed or given another unit within a schema version. `None` stands where a figure
is undefined; NaN is never written.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import pydantic
import yaml

from microdrivers.core.errors import ConfigError
from microdrivers.core.protocol_names import ProtocolName
from microdrivers.results.record import Provenance, Record, Trace

SCHEMA_VERSION = 1

_COORDINATES = """\
# The model's x is the deformation less contact_um and, if there is one, less the slip of eq. (26). valid_for is what x
# and its rate may be; pressed_um is how far the contact point went in, slip included.
"""


class Contact(Record):
    """Where and when the tool met the specimen, estimated together with the model.

    `deformation_um` is where x = 0 lies in the deformation's own coordinate.
    """

    time_s: float
    deformation_um: float
    deformation_sigma_um: float | None


class Identifiable(Record):
    """Whether each parameter is a property of the specimen; `reasons` say why not.

    It is one if the record determines it and the model leaves nothing but noise of the samples that it is estimated
    from; reports put the others in brackets: do not quote them. `loading_only` is judged by the loading alone, as
    `loading` is, with which it shares its parameters.
    """

    k1: bool
    k2: bool
    b: bool
    m: bool
    reasons: dict[str, str]


class SlipFit(Record):
    """Bilen et al., eq. (26): x*(t) = x(t) − offset·(1 − e^(−α·t)), t from the contact, as `slip_corrected` has it.

    `not_returned_um` is the deformation that was left when contact was lost; None if it was not lost. `reason` says why
    it is not identifiable: offset and rate are then no properties of the specimen, not even of its holder.
    """

    offset_um: float
    offset_sigma_um: float | None
    rate_per_s: float
    rate_sigma_per_s: float | None
    not_returned_um: float | None
    identifiable: bool
    reason: str = ""


class ProtocolResult(Record):
    """One way of fitting F = m·a + b·v + k1·x + k2·x³.

    Attributes:
        b_uN_s_per_um: while loading. b_unloading_uN_s_per_um: on the way back; 0 where the protocol says so.
        m_kg: None where the record does not determine it: at constant speed it never does.
        covariance: 3×3, of k1, k2, b in these units. sigma_*: standard deviations.
        error_percent: 100·RMS(F − F̂)/RMS(F), over the samples of both branches (of loading alone for `loading`) that
            fits use: `ForceResult.excluded_samples` are not counted, so no reversal.
        residual_uN: RMS of the force's own residual, the noise of the image taken off.
        noise_residual_ratio: RMS residual over that which the noise of force and image alone would leave.
        identifiable: per parameter; one that is not must not be quoted as a property of the specimen.
    """

    k1_uN_per_um: float
    k1_sigma_uN_per_um: float | None
    k2_uN_per_um3: float
    k2_sigma_uN_per_um3: float | None
    b_uN_s_per_um: float
    b_sigma_uN_s_per_um: float | None
    b_unloading_uN_s_per_um: float
    m_kg: float | None
    covariance: list[list[float]] | None
    error_percent: float
    noise_residual_ratio: float | None
    condition_number: float | None
    identifiable: Identifiable
    residual_uN: float | None = None


class Misfit(Record):
    """A test of the residual's structure: is what the best fit leaves over noise, or an effect outside the model?

    `statistic` and `p_value` are of the residual's order (Ljung and Box). `found_by` says what found it: this `order`,
    or, in records too short for it, the `size` alone, whatever `p_value`; None if nothing was found.
    """

    found: bool
    found_by: Literal["order", "size"] | None = None
    statistic: float | None
    p_value: float | None
    text: str


class VisionCheck(Record):
    """A fresh indentation of the same specimen with the force from the camera alone, against the sensor.

    All its frames count, reversals included; in `error_within_range_percent` those that are not `outside_range`, if
    there are such frames. `left_over_uN` is the largest force that the camera still told where the specimen rested on
    its way back, flagged MAY_BE_RELEASED, and the sensor felt less than half of it; None if nowhere.
    `largest_error_s` and `deepest_s` are instants of `ForceTraces.check_*`.
    """

    error_percent: float
    largest_error_uN: float
    samples: int
    outside_range: int
    largest_error_s: float | None = None
    deepest_s: float | None = None
    left_over_uN: float | None = None
    error_within_range_percent: float | None = None


class ForceTraces(Record):
    """One value a frame: what figures 9–11 are drawn from. None where nothing was measured.

    `branch` is approach, loading, hold, unloading or lost. `fitted_uN` by protocol; `check_*` of the fresh indentation.
    """

    time_s: list[float]
    deformation_um: Trace
    force_uN: Trace
    branch: list[str]
    fitted_uN: dict[str, Trace]
    check_time_s: list[float]
    check_force_uN: list[float]
    check_vision_uN: Trace


class ForceTruth(Record):
    """What the simulation knows of the specimen, and the error of the best fit; percent of the truth."""

    preset: str
    k1_uN_per_um: float
    k2_uN_per_um3: float
    b_uN_s_per_um: float
    b_unloading_uN_s_per_um: float
    m_kg: float
    slip_offset_um: float
    slip_rate_per_s: float
    outside_model: list[str]
    errors_percent: dict[str, float]
    vision_deformation_rms_um: float | None


class Setup(Record):
    """How the specimen was indented and seen.

    `scale_source`: the probe's own travel, an optical calibration, or a recording that states µm.
    `image_drift_um_s`: of the picture along the probing direction, as a probe that has come back shows it; taken off.
    `speed_um_s`, `unloading_speed_um_s`: of the tool; of a recording, the contact point's mean speed in and out. The
    latter, and `fastest_unloading_um_s`, None where the way back could not be fitted.
    `pressed_um`: how far the contact point was pressed in from the undeformed surface. `deepest_um`: how deep the best
    model is valid, in its own compression x: of a specimen that slipped, x*, which is less by what the holder gave way.
    `fastest_um_s`, `fastest_unloading_um_s`: how fast the best model is valid, in and out.
    `largest_force_uN`: the sensor's zero taken off, and within its range; samples at the end of it are not counted.
    """

    sensor: str
    stage: str | None
    camera: str | None
    scale_source: str
    scale_px_per_um: float | None
    scale_sigma_px_per_um: float | None
    zoom: float | None
    speed_um_s: float
    deepest_um: float
    largest_force_uN: float
    tare_uN: float | None
    image_drift_um_s: float | None = None
    image_drift_sigma_um_s: float | None = None
    unloading_speed_um_s: float | None = None
    pressed_um: float | None = None
    fastest_um_s: float | None = None
    fastest_unloading_um_s: float | None = None


class ForceResult(Record):
    """A force characterisation, Bilen et al., sections II.B and III.C.

    Attributes:
        complete: False if the run was interrupted, or the recording of it lacks its end; the estimates then come from
            what had been measured.
        best: the protocol that suits the record best.
        excluded_samples: reason → number of samples that no fit used.
        vision_force_error_percent: 100·RMS(F − F̂)/RMS(F) of the fresh indentation; None if there was none.
        largest_speed_um_s: keeps the predicted force below `setup.largest_force_uN` down to the deepest point; null
            where the record does not determine k1 and b.
    """

    schema_version: Literal[1] = 1
    kind: Literal["force-characterisation"] = "force-characterisation"
    complete: bool
    contact: Contact
    protocols: dict[ProtocolName, ProtocolResult]
    best: ProtocolName
    slip: SlipFit | None
    misfit: Misfit
    vision_force_error_percent: float | None
    vision_check: VisionCheck | None
    largest_speed_um_s: float | None
    excluded_samples: dict[str, int]
    deformation_sigma_um: float
    force_sigma_uN: float
    setup: Setup
    traces: ForceTraces
    notes: list[str]
    provenance: Provenance
    truth: ForceTruth | None = None

    def as_json(self) -> str:
        """All of it as in `result.json`; keys in the order of this class."""
        return self.model_dump_json(indent=1) + "\n"

    def write_json(self, file: Path) -> None:
        """Write `result.json`."""
        file.write_text(self.as_json(), encoding="utf-8")

    def write_specimen(self, file: Path) -> None:
        """Write `specimen.yaml`: what is needed to read force from the camera, and what it is valid for.

        `microdrivers.results.specimen.read_specimen` reads it.
        """
        best = self.protocols[self.best]
        content = {
            "schema_version": self.schema_version,
            "kind": "specimen",
            "protocol": self.best,
            "k1_uN_per_um": best.k1_uN_per_um,
            "k2_uN_per_um3": best.k2_uN_per_um3,
            "b_uN_s_per_um": best.b_uN_s_per_um,
            "b_unloading_uN_s_per_um": best.b_unloading_uN_s_per_um,
            "m_kg": best.m_kg,
            "covariance_of_k1_k2_b": best.covariance,
            "contact_um": self.contact.deformation_um,
            "residual_uN": best.residual_uN,
            "slip": None if self.slip is None or self.best != "slip_corrected" else self.slip.model_dump(mode="json"),
            "identifiable": best.identifiable.model_dump(mode="json"),
            "misfit": self.misfit.found,
            "valid_for": {
                "deepest_um": self.setup.deepest_um,
                "fastest_um_s": self.setup.fastest_um_s,
                "fastest_unloading_um_s": self.setup.fastest_unloading_um_s,
                "force_uN": self.setup.largest_force_uN,
            },
            "pressed_um": self.setup.pressed_um,
            "vision_force_error_percent": self.vision_force_error_percent,
            "created_utc": self.provenance.created_utc,
            "rig": self.provenance.rig_name,
            "complete": self.complete,
            "simulated": self.provenance.fake,
        }
        file.write_text(_COORDINATES + yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")


def read_force_result(file: Path) -> ForceResult:
    """Read a `result.json`.

    Raises:
        ConfigError: it is not one, or of another schema version.
    """
    try:
        return ForceResult.model_validate(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, pydantic.ValidationError) as error:
        raise ConfigError(
            f"not a result of a force characterisation of schema version {SCHEMA_VERSION}: {error}",
            file=str(file), remedy="give the result.json of `microdrivers calibrate force`",
        ) from error  # fmt: skip
