"""Samples about a tool that presses on a specimen: what the camera sees of it, what the sensor feels, what follows."""

from __future__ import annotations

from microdrivers.core.samples import Sample


class DeformationSample(Sample, frozen=True, gc=False, kw_only=True):
    """How far the contact point of the specimen has moved, as one frame shows it; on `<camera>/deformation`.

    Attributes:
        deformation_um: along the probing direction, into the specimen; 0 where the undeformed surface was. NaN if lost.
        sigma_um: standard deviation of it.
        tip_um: how far the tool's tip has come along the same direction, from the same zero; NaN if not seen.
        tip_sigma_um: standard deviation of it.
        u_px, v_px: the contact point, px from the principal point, v down.
        found: False if the contact point was lost in this frame.
        frame_seq: the frame's `seq`. exposure_ms: its exposure, centred on `t_ns`.
    """

    deformation_um: float
    sigma_um: float
    tip_um: float
    tip_sigma_um: float
    u_px: float
    v_px: float
    found: bool
    frame_seq: int
    exposure_ms: float


class IndentationSample(Sample, frozen=True, gc=False, kw_only=True):
    """Deformation and force of one instant; on `estimate/indentation`.

    The force is the mean of the sensor's `readings` over the frame's exposure.
    """

    deformation_um: float
    deformation_sigma_um: float
    force_uN: float
    force_sigma_uN: float
    readings: int
    frame_seq: int


class SpecimenEstimate(Sample, frozen=True, gc=False, kw_only=True):
    """The running estimate of a specimen's model, Bilen et al., eq. (23); on `estimate/specimen`.

    Attributes:
        k1_uN_per_um, k2_uN_per_um3, b_uN_s_per_um: springs and damper; m_kg: NaN where the mass is not estimated.
        covariance: of (k1, k2, b) row-major, in these units; empty while not valid.
        prediction_error_uN: measured force minus the one predicted before this sample was used.
        condition_number: of the scaled regressor; infinite while undetermined.
        valid: the samples so far determine all of them.
    """

    k1_uN_per_um: float
    k2_uN_per_um3: float
    b_uN_s_per_um: float
    m_kg: float
    covariance: tuple[float, ...]
    prediction_error_uN: float
    condition_number: float
    valid: bool


class VisionForceSample(Sample, frozen=True, gc=False, kw_only=True):
    """Force read from the camera alone, through an identified model; on `estimate/force`.

    Flags: OUTSIDE_RANGE (deeper or faster than the model was identified, or on a way back of which it knows nothing),
    LOST (the contact point is not seen), NO_VELOCITY (frames too far apart to tell a speed), MAY_BE_RELEASED (at rest
    on the way back, with a force left).
    """

    force_uN: float
    sigma_uN: float
    deformation_um: float
    velocity_um_s: float


class Intervention(Sample, frozen=True, gc=False, kw_only=True):
    """A safety rule has acted; on `safety`. `value` and `limit` are in the rule's own unit, told by `reason`."""

    rule: str
    stage: str
    sensor: str = ""
    value: float = float("nan")
    limit: float = float("nan")
    reason: str = ""


class ContactTruth(Sample, frozen=True, gc=False, kw_only=True):
    """Ground truth of a simulated contact at a frame's mid-exposure; on `truth/contact`, for the report and tests only.

    Attributes:
        deformation_um: how far the contact point has truly moved. compression_um: the same without the slip.
        slip_um: how far the specimen has slipped in its holder. tip_um: where the tip is, 0 at the undeformed surface.
        force_uN: on the tip. in_contact: whether it touches.
    """

    frame_seq: int
    deformation_um: float
    compression_um: float
    slip_um: float
    tip_um: float
    force_uN: float
    in_contact: bool


class SpecimenTruth(Sample, frozen=True, gc=False, kw_only=True):
    """Ground truth of a simulated specimen; on `truth/specimen`, once, when the simulation is built.

    Attributes:
        preset: its name. sensor: the force sensor that can press on it.
        surface_um: where its undeformed surface lies, in the rig's frame.
        slip_um, slip_rate_per_s: offset and α of Bilen et al., eq. (26); 0 if it does not slip.
        branch_uN_per_um, branch_s: stiffness and relaxation time of a Maxwell element beside eq. (21); 0: none.
        adhesion_uN: the pull at which the tip comes off.
    """

    preset: str
    sensor: str
    surface_um: tuple[float, float, float]
    k1_uN_per_um: float
    k2_uN_per_um3: float
    b_loading_uN_s_per_um: float
    b_unloading_uN_s_per_um: float
    m_kg: float
    slip_um: float
    slip_rate_per_s: float
    branch_uN_per_um: float
    branch_s: float
    adhesion_uN: float
