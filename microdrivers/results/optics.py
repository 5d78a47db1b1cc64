"""The result of an optical calibration: `result.json` and `calibration.yaml`, schema version 1.

Keys are stable: a key is never renamed or given another unit within a schema version. `None` stands where a figure
is undefined; NaN is never written.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import pydantic
import yaml

from microdrivers.core.errors import ConfigError
from microdrivers.results.record import Provenance, Record, Trace

SCHEMA_VERSION = 1

Row = tuple[float, float, float]
View = Literal["along_plus_z", "along_minus_z_or_mirrored"]


class Tilt(Record):
    """Bound or interval (95 %) on the angle between optical axis and stage normal.

    A planar calibration cannot tell tilt from unequal scales of the stage's axes or the pixels, nor its sign.
    """

    interval_deg: tuple[float, float]
    label: str
    sign_ambiguous: bool = True


class ZoomChange(Record):
    """How the calibration settled after the zoom change.

    Frames are 0-based; iteration 1 is the first frame exposed after the zoom began to move. `iterations_…` are None
    if the error did not stay at or below 0.1 px for 30 frames (or to the end of the run). The plain names use the a
    priori error |y − φᵀθ̂(t−1)|, `posterior_…` the a posteriori error as eqs. (9)–(10) of the paper print it.
    """

    first_frame: int
    last_moving_frame: int
    zoom_before: float
    zoom_after: float
    iterations_to_0p1_px: int | None
    iterations_to_0p1_px_from_end: int | None
    posterior_iterations_to_0p1_px: int | None
    posterior_iterations_to_0p1_px_from_end: int | None


class Traces(Record):
    """One value a frame: what figures 4–7 are drawn from.

    `projection` holds p11 p12 p13 p21 p22 p23 (px/µm, px from the principal point).
    """

    frame: list[int]
    time_s: list[float]
    x_um: list[float]
    y_um: list[float]
    u_px: list[float]
    v_px: list[float]
    zoom: list[float]
    zoom_moving: list[bool]
    projection: list[tuple[float, float, float, float, float, float] | None]
    scale_px_per_um: Trace
    angle_deg: Trace


class Truth(Record):
    """What the simulation knows, under the result's own names, and the error of each estimate.

    `projection` is the affine map that best fits the simulated (perspective) projection over the poses visited
    after the zoom change. `errors` is estimate minus truth: scale in percent, angle in degrees, projection as is.
    """

    projection: tuple[Row, Row]
    scale_px_per_um: float
    zoom: float
    magnification: float | None
    angle_deg: float
    tilt_deg: float
    view: View
    translation_um: tuple[float, float]
    errors: dict[str, float | list[float]]


class ValidFor(Record):
    """The settings that a calibration belongs to; it must not be used with others."""

    camera: str
    binning: int
    roi: tuple[int, int, int, int]
    objective: float | None
    zoom: float


class OpticsResult(Record):
    """An optical calibration, Bilen et al., section III.B.

    Attributes:
        complete: False if the run was interrupted, or its recording lacks its end: the estimates are then those up to
            there. Also if the zoom changed where no frame could be used any more. The notes say which.
        projection: P, 2×3: (u, v) = P (X, Y, 1); px/µm and px from the principal point, v down; X, Y in µm.
        scale_px_per_um: M of eq. (5), from the similarity fit. `scale_sigma_px_per_um`: standard deviation.
        magnification: scale × pixel pitch, dimensionless; None if the pitch is unknown.
        angle_deg: in-plane angle. `angle_sigma_deg`: standard deviation.
        translation_um: T of eq. (20).
        covariance: 6×6, of p11 p12 p13 p21 p22 p23. `degrees_of_freedom` of its estimate: 95 % intervals are
            Student's.
        prediction_error_px: a priori, one a frame. posterior_error_px: a posteriori.
        magnification_trace: one a frame.
        zoom_change: None if the zoom did not change.
        lost_frames: frames in which the target was not found, or that a replayed recording lacks.
        unmatched_frames: frames without a pose around them.
    """

    schema_version: Literal[1] = 1
    kind: Literal["optical-calibration"] = "optical-calibration"
    complete: bool
    projection: tuple[Row, Row]
    scale_px_per_um: float
    scale_sigma_px_per_um: float
    zoom: float
    magnification: float | None
    angle_deg: float
    angle_sigma_deg: float
    tilt: Tilt
    view: View
    translation_um: tuple[float, float]
    covariance: Annotated[list[list[float]], pydantic.Field(min_length=6, max_length=6)]
    degrees_of_freedom: float
    prediction_error_px: Trace
    posterior_error_px: Trace
    magnification_trace: Trace
    zoom_change: ZoomChange | None
    frames: int
    lost_frames: int
    unmatched_frames: int
    valid_for: ValidFor
    traces: Traces
    notes: list[str]
    provenance: Provenance
    truth: Truth | None = None

    def as_json(self) -> str:
        """All of it as in `result.json`; keys in the order of this class."""
        return self.model_dump_json(indent=1) + "\n"

    def write_json(self, file: Path) -> None:
        """Write `result.json`."""
        file.write_text(self.as_json(), encoding="utf-8")

    def write_calibration(self, file: Path) -> None:
        """Write `calibration.yaml`: what is needed to use the calibration, and what it is valid for."""
        content = {
            "schema_version": self.schema_version,
            "kind": self.kind,
            "valid_for": self.valid_for.model_dump(mode="json"),
            "projection": [list(row) for row in self.projection],
            "projection_units": "u, v in px from the principal point (v down); X, Y in um",
            "scale_px_per_um": self.scale_px_per_um,
            "scale_sigma_px_per_um": self.scale_sigma_px_per_um,
            "angle_deg": self.angle_deg,
            "angle_sigma_deg": self.angle_sigma_deg,
            "view": self.view,
            "covariance": self.covariance,
            "degrees_of_freedom": self.degrees_of_freedom,
            "created_utc": self.provenance.created_utc,
            "rig": self.provenance.rig_name or None,
            "complete": self.complete,
            "simulated": self.provenance.fake,
        }
        file.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")


def read_result(file: Path) -> OpticsResult:
    """Read a `result.json`.

    Raises:
        ConfigError: it is not one, or of another schema version.
    """
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        return OpticsResult.model_validate(data)
    except (OSError, ValueError) as error:  # pydantic's ValidationError is a ValueError
        raise ConfigError(
            f"not a result of an optical calibration of schema version {SCHEMA_VERSION}: {error}",
            file=str(file), remedy="give the result.json of `microdrivers calibrate optics`",
        ) from error  # fmt: skip


def iterations_to_settle(
    errors_px: Sequence[float | None], *, first_frame: int, limit_px: float = 0.1, hold_frames: int = 30
) -> int | None:
    """Iterations until the error stays within `limit_px` for `hold_frames` frames, or to the end of the run.

    Iteration 1 is `first_frame`. None if it never does. An undefined error counts as too large.
    """
    good = [error is not None and error <= limit_px for error in errors_px]
    for start in range(first_frame, len(good)):
        if all(good[start : start + hold_frames]):
            return start - first_frame + 1
    return None
