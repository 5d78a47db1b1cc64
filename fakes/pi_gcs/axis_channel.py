"""One axis of the controller: servo, reference, limits and profiles on an axis of the world."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from microdrivers.core.units import Range, seconds_to_ns
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.parameters import Parameter, Value
from microdrivers.fakes.world.axis import Axis, Encoder

ReferenceMove = Literal["FRF", "FNL", "FPL"]
Memory = dict[Parameter, Value]

_DEFAULT_VELOCITY_OF_MAX = 0.5
_REFERENCE_VELOCITY_OF_MAX = 0.5
_SETTLING_TIME_S = 0.02
_ABRUPT = 100.0
"""STP and #24 brake this many times harder than the maximum deceleration."""
_LARGEST_COUNTS = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class AxisSpec:
    """What the rig file and the world say about an axis, in true units (µm or degrees).

    Attributes:
        identifier: how GCS calls it by default.
        key: what the rig calls it: x, y or theta.
        direction: −1 if the controller's positive sense is the rig's negative one.
        true_per_unit: true units in a controller unit: 1000 µm in a millimetre, 1 degree in a degree.
        reference_position: where the reference switch is.
    """

    identifier: str
    key: str
    stage: str
    direction: int
    true_per_unit: float
    travel: Range
    max_speed: float
    acceleration: float
    resolution: float
    tolerance: float
    reference_position: float


class AxisChannel:
    """State of one axis. Public positions and rates are in controller units (mm, degrees), as on the wire.

    Attributes:
        identifier: how GCS calls it at present.
        parameters: the volatile memory.
        stored_parameters: the non-volatile memory, which the volatile one is filled from at power-on.
    """

    def __init__(self, spec: AxisSpec, axis: Axis, encoder: Encoder) -> None:
        self.spec = spec
        self.axis = axis
        self.encoder = encoder
        ends = [spec.direction * end / spec.true_per_unit for end in spec.travel]
        self.physical_travel = (min(ends), max(ends))
        self.stored_identifier = spec.identifier
        self.stored_parameters = self._default_parameters()
        self._power_on()

    def _power_on(self) -> None:
        self.identifier = self.stored_identifier
        self.parameters = dict(self.stored_parameters)
        self.servo = False
        self.referenced = False
        self.reference_mode = True
        self.target = 0.0
        self._servo_on_ns = 0
        self._referencing_until_ns: int | None = None
        self._blocked = False

    def _default_parameters(self) -> Memory:
        spec = self.spec
        counts = Fraction(spec.true_per_unit / spec.resolution).limit_denominator(1_000_000)
        velocity, acceleration = spec.max_speed / spec.true_per_unit, spec.acceleration / spec.true_per_unit
        return {
            Parameter.P_TERM: 200,
            Parameter.I_TERM: 10,
            Parameter.D_TERM: 200,
            Parameter.I_LIMIT: 2000,
            Parameter.MAX_VELOCITY: velocity,
            Parameter.ACCELERATION: acceleration,
            Parameter.DECELERATION: acceleration,
            Parameter.COUNTS_NUMERATOR: counts.numerator,
            Parameter.COUNTS_DENOMINATOR: counts.denominator,
            Parameter.HAS_REFERENCE: 1,
            Parameter.MAX_TRAVEL: self.physical_travel[1],
            Parameter.MIN_TRAVEL: self.physical_travel[0],
            Parameter.HAS_NO_LIMITS: 0,
            Parameter.SETTLING_WINDOW: max(1, int(spec.tolerance / spec.resolution + 1e-9)),
            Parameter.STAGE_NAME: spec.stage,
            Parameter.SETTLING_TIME: _SETTLING_TIME_S,
            Parameter.VELOCITY: _DEFAULT_VELOCITY_OF_MAX * velocity,
            Parameter.MAX_ACCELERATION: acceleration,
            Parameter.MAX_DECELERATION: acceleration,
            Parameter.REFERENCE_VELOCITY: _REFERENCE_VELOCITY_OF_MAX * velocity,
            Parameter.REFERENCE_SIGNAL: 0,
        }

    # ------------------------------------------------------------------ state at an instant

    def reading_at(self, t_ns: int) -> float:
        """The position as the encoder shows it; each call draws new noise."""
        return self.spec.direction * self.encoder.position_at(t_ns) / self.spec.true_per_unit

    def moving_at(self, t_ns: int) -> bool:
        """Whether a profile is running."""
        return self.axis.moving_at(t_ns)

    @property
    def referencing(self) -> bool:
        """Whether a reference move is under way."""
        return self._referencing_until_ns is not None

    def on_target_at(self, t_ns: int) -> bool:
        """Whether the axis has been within the settling window for the whole settling time."""
        if not self.servo or self.referencing or self._blocked:
            return False
        window = max(self._number(Parameter.SETTLING_WINDOW), 0.5) * self.spec.resolution
        since_ns = max(self.axis.within_from_ns(window), self._servo_on_ns)
        return t_ns >= since_ns + seconds_to_ns(self._number(Parameter.SETTLING_TIME))

    def status_at(self, t_ns: int, *, error: bool) -> int:
        """The status register of #4."""
        true = self.axis.position_at(t_ns)
        close = 0.5 * self.spec.resolution
        at_ends = (true <= self.spec.travel.min + close, true >= self.spec.travel.max - close)
        negative, positive = at_ends if self.spec.direction > 0 else at_ends[::-1]
        has_limits = not self.parameters[Parameter.HAS_NO_LIMITS]
        beyond_reference = self.spec.direction * (true - self.spec.reference_position) >= 0.0
        bits = {
            15: self.on_target_at(t_ns),
            14: self.referencing,
            13: self.moving_at(t_ns),
            12: self.servo,
            8: error,
            2: positive and has_limits,
            1: beyond_reference and self.parameters[Parameter.HAS_REFERENCE],
            0: negative and has_limits,
        }
        return sum(1 << bit for bit, is_set in bits.items() if is_set)

    # ------------------------------------------------------------------ checks

    def check_move(self, target: float) -> None:
        """Whether an absolute target may be commanded.

        Raises:
            CommandError: UNALLOWED_MOVE, or POSITION_OUT_OF_LIMITS.
        """
        if not self.servo or not self.referenced:
            raise CommandError(ErrorCode.UNALLOWED_MOVE)
        half_count = 0.5 * self.spec.resolution / self.spec.true_per_unit
        low, high = self._number(Parameter.MIN_TRAVEL), self._number(Parameter.MAX_TRAVEL)
        if not low - half_count <= target <= high + half_count:
            raise CommandError(ErrorCode.POSITION_OUT_OF_LIMITS)

    def check_reference_move(self, mode: ReferenceMove) -> None:
        """Whether a reference move may begin.

        Raises:
            CommandError: REFERENCE_MODE_OFF, UNALLOWED_MOVE, NO_REFERENCE_SWITCH or NO_LIMIT_SWITCH.
        """
        if not self.reference_mode:
            raise CommandError(ErrorCode.REFERENCE_MODE_OFF)
        if not self.servo:
            raise CommandError(ErrorCode.UNALLOWED_MOVE)
        if mode == "FRF" and not self.parameters[Parameter.HAS_REFERENCE]:
            raise CommandError(ErrorCode.NO_REFERENCE_SWITCH)
        if mode != "FRF" and self.parameters[Parameter.HAS_NO_LIMITS]:
            raise CommandError(ErrorCode.NO_LIMIT_SWITCH)

    def check_define_position(self, position: float, t_ns: int) -> None:
        """Whether POS may declare the present position.

        Raises:
            CommandError: COMMAND_NOT_ALLOWED, MOTION_IN_PROCESS or PARAMETER_OUT_OF_RANGE.
        """
        if self.reference_mode:
            raise CommandError(ErrorCode.COMMAND_NOT_ALLOWED)
        if self.moving_at(t_ns):
            raise CommandError(ErrorCode.MOTION_IN_PROCESS)
        if abs(position) * self.spec.true_per_unit > _LARGEST_COUNTS * self.spec.resolution:
            raise CommandError(ErrorCode.PARAMETER_OUT_OF_RANGE)

    # ------------------------------------------------------------------ commands

    def update(self, t_ns: int) -> int | None:
        """Note the end of a reference move; returns when it was, once."""
        found_ns = self._referencing_until_ns
        if found_ns is None or t_ns < found_ns:
            return None
        self._referencing_until_ns = None
        self.referenced = True
        self.encoder.offset = 0.0
        self.target = self._to_controller(self.axis.setpoint_at(found_ns)[0])
        return found_ns

    def set_servo(self, on: bool, t_ns: int) -> None:
        """Close or open the servo loop; opening it ends all motion."""
        if on == self.servo:
            return
        if not on:
            self.stop(t_ns, abrupt=True)
        self.servo = on
        self._servo_on_ns = t_ns
        self.target = self._to_controller(self.axis.setpoint_at(self._rest_ns(t_ns))[0])

    def move(self, target: float, t_ns: int) -> None:
        """Begin a profile to a checked target, in whole counts; a limit switch ends it with the travel."""
        self.target = target
        counts = round((self._to_true(target) + self.encoder.offset) / self.spec.resolution)
        wanted = counts * self.spec.resolution - self.encoder.offset
        end = min(max(wanted, self.spec.travel.min), self.spec.travel.max)
        self._blocked = abs(wanted - end) > self.spec.resolution
        self._drive(end, self._number(Parameter.VELOCITY), t_ns)

    def find_reference(self, mode: ReferenceMove, t_ns: int) -> None:
        """Begin a move to the reference switch (FRF), the negative (FNL) or the positive limit (FPL)."""
        negative, positive = self.spec.travel if self.spec.direction > 0 else self.spec.travel[::-1]
        end = {"FRF": self.spec.reference_position, "FNL": negative, "FPL": positive}[mode]
        self.referenced = False
        self._blocked = False
        self._drive(end, self._number(Parameter.REFERENCE_VELOCITY), t_ns)
        self._referencing_until_ns = self.axis.within_from_ns(0.5 * self.spec.resolution)

    def define_position(self, position: float, t_ns: int) -> None:
        """Let the present position be called `position` (POS); the limits do not follow."""
        true = self.axis.setpoint_at(t_ns)[0]
        self.encoder.offset = self.spec.direction * position * self.spec.true_per_unit - true
        self.target = position
        self.referenced = True

    def stop(self, t_ns: int, *, abrupt: bool) -> None:
        """End all motion, with DEC or abruptly; a reference move that was under way has found nothing."""
        moving = self.moving_at(t_ns)
        if moving:
            smooth = self._rate(Parameter.DECELERATION)
            wanted = _ABRUPT * self._rate(Parameter.MAX_DECELERATION) if abrupt else smooth
            self.axis.halt(t_ns, deceleration=self._braking(wanted, t_ns))
        if moving or self.referencing or self._blocked:
            self.target = self._to_controller(self.axis.setpoint_at(self._rest_ns(t_ns))[0])
        self._referencing_until_ns = None
        self._blocked = False

    def power_cycle(self, t_ns: int) -> None:
        """Switch off and on: nothing is known any more, and the encoder counts from here."""
        self.stop(t_ns, abrupt=True)
        self._power_on()
        self.encoder.offset = -self.axis.setpoint_at(self._rest_ns(t_ns))[0]

    # ------------------------------------------------------------------ true units

    def _number(self, parameter: Parameter) -> float:
        return float(self.parameters[parameter])

    def _rate(self, parameter: Parameter) -> float:
        return self._number(parameter) * self.spec.true_per_unit

    def _to_true(self, position: float) -> float:
        return self.spec.direction * position * self.spec.true_per_unit - self.encoder.offset

    def _to_controller(self, true: float) -> float:
        return self.spec.direction * (true + self.encoder.offset) / self.spec.true_per_unit

    def _rest_ns(self, t_ns: int) -> int:
        return max(t_ns, self.axis.profile_end_ns)

    def _drive(self, end: float, velocity: float, t_ns: int) -> None:
        self.axis.move(
            t_ns,
            end,
            speed=velocity * self.spec.true_per_unit,
            acceleration=self._rate(Parameter.ACCELERATION),
            deceleration=self._braking(self._rate(Parameter.DECELERATION), t_ns),
        )

    def _braking(self, wanted: float, t_ns: int) -> float:
        """The deceleration that does not run past the end of travel."""
        position, speed = self.axis.setpoint_at(t_ns)
        if speed == 0.0:
            return wanted
        room = self.spec.travel.max - position if speed > 0.0 else position - self.spec.travel.min
        return max(wanted, speed * speed / (2.0 * max(room, self.spec.resolution)))
