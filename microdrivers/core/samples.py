"""Samples: what devices and estimators publish.

Every sample is an immutable record with the time of the *physical instant* it describes on the rig's clock
(`t_ns`), the half-width of the 95 % interval of that time (`dt_ns`) and where the time came from. Units are
part of the field names: µm, degrees, µN, px, ms. See docs/decisions/0002.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, TypeVar

import msgspec
import numpy.typing as npt

TimeSource = Literal["device", "request", "midpoint", "arrival", "recorded", "computed"]
"""Where `t_ns` comes from: stamped by the device · the request that latched the value · half-way between
request and reply · arrival at the host (weakest) · a recording · the samples an estimate was computed from."""

EventKind = Literal[
    "opened", "closed", "link_lost", "link_back", "fault", "fault_cleared", "reference_found", "reference_lost",
    "limit", "stopped", "settings_changed", "tared",
]  # fmt: skip


class Sample(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """What all samples share.

    Attributes:
        t_ns: physical instant, ns on the rig's clock.
        dt_ns: half-width of the 95 % interval of `t_ns`, ns.
        t_source: where the time came from.
        device: name of the publishing device or estimator.
        seq: goes up by 1 from sample to sample of a topic; a gap means that samples were lost.
        order: bus-wide counter, stamped by the bus at the first publication; −1 before.
        flags: what is unusual about this sample; empty when all is well.
    """

    t_ns: int
    device: str
    dt_ns: int = 0
    t_source: TimeSource = "device"
    seq: int = 0
    order: int = -1
    flags: frozenset[str] = frozenset()


SampleT = TypeVar("SampleT", bound=Sample)


class PoseSample(Sample, frozen=True, gc=False, kw_only=True):
    """Pose of a stage, all axes at one time.

    Attributes:
        moving: whether any axis moves.
        on_target: whether all axes are on target.
        referenced: whether all axes are referenced; if not, positions are no places.
    """

    position_fields: ClassVar[Mapping[str, str]] = {}
    """Name of each axis, and of the field that holds its position; `target_` before it is the target's."""

    moving: bool
    on_target: bool
    referenced: bool

    @property
    def position(self) -> dict[str, float]:
        """Position by axis, µm or degrees."""
        return {axis: getattr(self, field) for axis, field in self.position_fields.items()}

    @property
    def target(self) -> dict[str, float]:
        """Last commanded position by axis, µm or degrees; NaN if none."""
        return {axis: getattr(self, f"target_{field}") for axis, field in self.position_fields.items()}


class XYThetaSample(PoseSample, frozen=True, gc=False, kw_only=True):
    """Pose of an XYθ stage.

    Attributes:
        x_um, y_um, theta_deg: position.
        target_x_um, target_y_um, target_theta_deg: last commanded position, NaN if none.
    """

    position_fields = {"x": "x_um", "y": "y_um", "theta": "theta_deg"}

    x_um: float
    y_um: float
    theta_deg: float
    target_x_um: float = float("nan")
    target_y_um: float = float("nan")
    target_theta_deg: float = float("nan")


class FineStageSample(PoseSample, frozen=True, gc=False, kw_only=True):
    """Pose of a 3-DOF fine stage.

    Attributes:
        x_um, y_um, z_um: position in its own axes.
        target_x_um, target_y_um, target_z_um: last commanded position, NaN if none.
    """

    position_fields = {"x": "x_um", "y": "y_um", "z": "z_um"}

    x_um: float
    y_um: float
    z_um: float
    target_x_um: float = float("nan")
    target_y_um: float = float("nan")
    target_z_um: float = float("nan")


class ForceSample(Sample, frozen=True, gc=False, kw_only=True):
    """Force along the sensor's axis.

    Flags: SATURATED (at the end of the range), DISCONNECTED (the amplifier has no sensor), STALE (no new reading has
    come in time), UNTARED (no tare is set; the force is then the raw one).

    Attributes:
        force_uN: `raw_uN` − `tare_uN`, NaN if the reading is not valid.
        raw_uN: as the sensor reads.
        tare_uN: what it reads without a load, as tared; 0 if no tare is set.
    """

    force_uN: float
    raw_uN: float
    tare_uN: float = 0.0


class ZoomSample(Sample, frozen=True, gc=False, kw_only=True):
    """State of the zoom motor.

    Attributes:
        zoom: reading of the zoom body (0.75 … 11.25 on an SMZ1500).
        position_steps: of the motor.
        target_zoom: last commanded zoom, NaN if none.
        moving, on_target, referenced: of the motor.
    """

    zoom: float
    position_steps: int
    target_zoom: float = float("nan")
    moving: bool
    on_target: bool
    referenced: bool


class Frame(Sample, frozen=True, kw_only=True):
    """One camera image; `t_ns` is mid-exposure.

    Attributes:
        image: read-only array, rows × columns, uint8 or uint16.
        exposure_ms: exposure time as the device read it back.
        frame_id: the device's own counter.
        dropped_before: frames lost immediately before this one.
        settings_id: changes whenever a camera setting changes.
        bit_depth: significant bits per pixel.
        principal_point_px: (u, v) of the optical axis in *this* image, top-left pixel centre = (0, 0).
    """

    image: npt.NDArray[Any]
    exposure_ms: float
    frame_id: int
    dropped_before: int = 0
    settings_id: int = 0
    bit_depth: int = 8
    principal_point_px: tuple[float, float]


class WireTraffic(Sample, frozen=True, gc=False, kw_only=True):
    """Bytes that a driver has sent (`direction` "sent") or received; `t_ns` is when it handed them over or got them.

    Of a CAN bus: one frame in candump's notation (`60B#4000100000000000`), `device` is the bus and the time of a frame
    received is when it had arrived.
    """

    direction: Literal["sent", "received"]
    data: bytes


class RoutineNote(Sample, frozen=True, gc=False, kw_only=True):
    """What a routine has just settled, as JSON; on topic `routine`. A replay of its recording needs no more."""

    kind: str
    content: str


class DeviceEvent(Sample, frozen=True, gc=False, kw_only=True):
    """Something happened to a device; published on `<name>/event`."""

    kind: EventKind
    by: str = ""
    reason: str = ""


class TrackedPoint(Sample, frozen=True, gc=False, kw_only=True):
    """An image feature located in one frame.

    Attributes:
        u_px, v_px: place, px from the principal point, v down; NaN if the target is lost.
        sigma_px: standard deviation per axis that the fit itself predicts.
        found: false when the target is lost.
        frame_seq: `seq` of the frame.
    """

    u_px: float
    v_px: float
    sigma_px: float
    found: bool
    frame_seq: int


class OpticsEstimate(Sample, frozen=True, gc=False, kw_only=True):
    """The running estimate of the projection matrix after one frame, Bilen et al., eqs. (8)–(20).

    Attributes:
        frame_index: 0-based index of the frame within the run.
        projection: p11 p12 p13 p21 p22 p23; px/µm for the 2×2 block, px for p13 and p23.
        covariance: 6×6 covariance of `projection`, row-major, same units; empty while not valid.
        degrees_of_freedom: of the covariance's estimate, for Student's t; 0 while not valid.
        scale_px_per_um: M, the similarity fit's scale.
        angle_deg: in-plane angle, atan2(a21 − a12, a11 + a22).
        prediction_error_px: a priori, |y − φᵀ θ̂(t−1)|; NaN while undefined.
        posterior_error_px: a posteriori, |y − φᵀ θ̂(t)|; NaN until more than three frames of one zoom are fitted.
        x_um, y_um: stage pose at mid-exposure. u_px, v_px: tracked point.
        zoom: zoom reading at mid-exposure; `zoom_moving` as the motor's own samples say.
        valid: three frames of one zoom lie behind the estimate and it is well-conditioned.
    """

    frame_index: int
    projection: tuple[float, float, float, float, float, float]
    covariance: tuple[float, ...]
    degrees_of_freedom: float
    scale_px_per_um: float
    angle_deg: float
    prediction_error_px: float
    posterior_error_px: float
    x_um: float
    y_um: float
    u_px: float
    v_px: float
    zoom: float
    zoom_moving: bool
    valid: bool


class OpticsTruth(Sample, frozen=True, gc=False, kw_only=True):
    """Ground truth of a simulation at a frame's mid-exposure; on `truth/optics`, for the report and tests only.

    Attributes:
        x_um, y_um, theta_deg: where the table truly is.
        corners_px: u, v of the target's four corners, px from the principal point, in cyclic order.
        jacobian_px_per_um: ∂(u, v)/∂(X, Y) of the target's first corner, row-major.
        scale_px_per_um, angle_deg, mirrored: from the simulation's own parameters, not from an estimator.
        zoom: what the optics do, which the motor's reading need not tell exactly.
        tilt_deg: angle between the optical axis and the stage's normal.
    """

    frame_seq: int
    x_um: float
    y_um: float
    theta_deg: float
    corners_px: tuple[float, ...]
    jacobian_px_per_um: tuple[float, float, float, float]
    scale_px_per_um: float
    angle_deg: float
    mirrored: bool
    zoom: float
    tilt_deg: float
