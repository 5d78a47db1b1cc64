"""What a drive moves: a table on an axis of the world, its encoder, its switches and the ends of its way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.world.axis import Axis, Encoder

ENCODER_NOISE_UM = 0.010

_HYSTERESIS_UM = 2.0
"""A switch is on from so far beyond its edge; on the way back it is off from the edge on."""

_RUN_OUT_UM = 50.0
"""From the limit switches to the mechanical ends."""

_ABRUPT = 10.0
"""How much faster than it accelerates an axis comes to rest by itself when its motor has no current."""

_INT32 = (1 << 31) - 1
_MICROSECOND_NS = 1000


@dataclass(frozen=True)
class AxisSpec:
    """One axis, as it is built.

    Attributes:
        counts_per_um: of the encoder.
        travel_um: in stage coordinates, from one limit switch to the other.
        home_um: home switch and index mark, in stage coordinates.
        direction: 1, or −1 if the drive counts against the stage's axis.
    """

    counts_per_um: float
    travel_um: tuple[float, float]
    max_speed_um_s: float
    acceleration_um_s2: float
    home_um: float
    direction: int = 1


@dataclass(frozen=True)
class Profile:
    """How a move is made: counts/s and counts/s²."""

    speed: float
    acceleration: float
    deceleration: float


class Motion:
    """Motion in the drive's counts. Places are µm in the drive's direction, from the stage's zero.

    Args:
        axis: the truth that the rest of the world sees, µm in stage coordinates.
        seed: of the encoder's noise.
        offset_um: what the encoder shows beyond the truth at power-on.
    """

    def __init__(
        self, axis: Axis, spec: AxisSpec, *, seed: int, offset_um: float, noise_um: float = ENCODER_NOISE_UM
    ) -> None:
        self.axis = axis
        self.spec = spec
        self.negative_um, self.positive_um = sorted(spec.direction * end for end in spec.travel_um)
        self.home_um = spec.direction * spec.home_um
        self._scale = spec.counts_per_um
        self._encoder = Encoder(axis, resolution=1.0 / spec.counts_per_um, noise=noise_um, seed=seed, offset=offset_um)
        self._zero_counts = 0
        self._read_ns, self._read_counts = -1, 0
        self._jammed: Axis | None = None
        self._last_move: tuple[float, Profile] | None = None
        self._turn_ns = 0

    # ------------------------------------------------------------------ state at an instant

    def position_at(self, t_ns: int) -> int:
        """What the encoder shows; each instant has its own noise."""
        if t_ns != self._read_ns:
            self._read_ns, self._read_counts = t_ns, self._encoder.counts_at(t_ns)
        return self.spec.direction * self._read_counts - self._zero_counts

    def demand_at(self, t_ns: int) -> int:
        """Where the drive wants the table to be."""
        return round(self._to_counts(self.spec.direction * self._demand.setpoint_at(t_ns)[0]))

    def speed_at(self, t_ns: int) -> int:
        """How fast the table is, counts/s."""
        return round(self.spec.direction * self.axis.speed_at(t_ns) * self._scale)

    def following_error_at(self, t_ns: int) -> int:
        """Demand minus true position, counts; at most what 32 bits hold."""
        error = round(self.spec.direction * self._lag_um(t_ns) * self._scale)
        return min(max(error, -_INT32), _INT32)

    def moving_at(self, t_ns: int) -> bool:
        """Whether a profile is running."""
        return self._demand.moving_at(t_ns)

    @property
    def end_ns(self) -> int:
        """When the profile ends or ended."""
        return self._demand.profile_end_ns

    def settled_from_ns(self, window: int) -> int | None:
        """From when on the table is within `window` counts of where the profile ends; None if it cannot move."""
        if self._jammed is not None:
            return None
        return self.axis.within_from_ns((window or 0.5) / self._scale)

    def switches_at(self, t_ns: int) -> int:
        """60FDh: bit 0 negative limit, 1 positive limit, 2 home."""
        place = self.spec.direction * self.axis.position_at(t_ns)
        return (
            (place <= self.negative_um - _HYSTERESIS_UM)
            | (place >= self.positive_um + _HYSTERESIS_UM) << 1
            | (place >= self.home_um) << 2
        )

    def place_at(self, t_ns: int) -> float:
        """Where the table is, µm in the drive's direction."""
        return self.spec.direction * self.axis.position_at(t_ns)

    # ------------------------------------------------------------------ commands

    def move(self, t_ns: int, target: int, profile: Profile) -> None:
        """Go to a position in counts; a running profile is changed on the way."""
        place = (target + self._zero_counts) / self._scale - self.spec.direction * self._encoder.offset
        self._go(t_ns, place, profile)

    def seek(self, t_ns: int, sense: int, profile: Profile) -> None:
        """Go as far as there is way, towards larger counts for `sense` = 1."""
        self._go(t_ns, self._end_um(sense), profile)

    def brake(self, t_ns: int, rate: float) -> int:
        """Come to rest with `rate` (counts/s²); returns when it stands."""
        return self._demand.halt(t_ns, deceleration=self._limited(t_ns, rate / self._scale))

    def let_go(self, t_ns: int) -> None:
        """Without current the table comes to rest by itself, and there is no demand but where it is."""
        if self.axis.moving_at(t_ns):
            self.axis.halt(t_ns, deceleration=self._limited(t_ns, _ABRUPT * self.spec.acceleration_um_s2))
        if self._jammed is not None:
            self._jammed = Axis(self.axis.position_at(t_ns), lag_s=0.0)

    def passes_ns(self, t_ns: int, edge_um: float, sense: int, *, far: bool, until_ns: int | None = None) -> int | None:
        """When what has been going on since `t_ns` has passed the edge of a switch; None if it does not.

        `sense` is in which direction. To the `far` side the switch's hysteresis has to be passed as well. Up to
        `until_ns`, by default the end of the motion, the table must go in one direction.
        """
        beyond_um = edge_um + sense * _HYSTERESIS_UM * far

        def passed(now_ns: int) -> bool:
            return sense * (self.place_at(now_ns) - beyond_um) >= 0.0

        end_ns = self.axis.settled_by_ns() if until_ns is None else until_ns
        return _first_time(passed, t_ns, end_ns) if passed(end_ns) else None

    def leaves_travel_ns(self, t_ns: int) -> int | None:
        """When what has been going on since `t_ns` meets a limit switch; None if it does not."""
        if self._jammed is not None:
            return None
        speed = self._to_place(self.axis.setpoint_at(t_ns)[1])
        if speed != 0.0:
            sense = 1 if speed > 0.0 else -1
            met_ns = self._leaves_ns(t_ns, sense, max(t_ns, self._turn_ns))
            if met_ns is not None:
                return met_ns
        forward = self._to_place(self.axis.setpoint_at(self.end_ns)[0]) > self.place_at(t_ns)
        return self._leaves_ns(t_ns, 1 if forward else -1, None)

    def limit_um(self, sense: int) -> float:
        """Edge of the limit switch on one side."""
        return self.positive_um if sense > 0 else self.negative_um

    # ------------------------------------------------------------------ coordinates

    def define(self, place_um: float, counts: int) -> None:
        """Let a place be called `counts`, to the nearest count."""
        raw = (place_um + self.spec.direction * self._encoder.offset) * self._scale
        self._zero_counts = round(raw) - counts

    def switch_off(self, t_ns: int) -> None:
        """The power is gone: the encoder counts from where the table comes to rest."""
        self.let_go(t_ns)
        self._zero_counts = 0
        self._encoder.offset = -self.axis.setpoint_at(self.axis.profile_end_ns)[0]
        self._read_ns = -1

    # ------------------------------------------------------------------ what goes wrong

    def jam(self, t_ns: int) -> None:
        """Something holds the table: it stands, and the demand goes on."""
        position, _ = self.axis.setpoint_at(t_ns)
        moving = self.axis.moving_at(t_ns)
        self.axis.halt(t_ns, deceleration=1e3 * _ABRUPT * self.spec.acceleration_um_s2)
        self._jammed = Axis(position, lag_s=0.0)
        if moving and self._last_move is not None:
            self._go(t_ns, *self._last_move)

    def release(self, t_ns: int, *, resume: bool) -> None:
        """Nothing holds the table any more; to `resume` is to go where the demand is."""
        self._jammed = None
        if resume and self._last_move is not None:
            self._go(t_ns, *self._last_move)

    @property
    def jammed(self) -> bool:
        """Whether something holds the table."""
        return self._jammed is not None

    # ------------------------------------------------------------------ inside

    @property
    def _demand(self) -> Axis:
        return self.axis if self._jammed is None else self._jammed

    def _lag_um(self, t_ns: int) -> float:
        return self._demand.setpoint_at(t_ns)[0] - self.axis.position_at(t_ns)

    def _go(self, t_ns: int, place_um: float, profile: Profile) -> None:
        place_um = min(max(place_um, self._end_um(-1)), self._end_um(1))
        deceleration = self._limited(t_ns, profile.deceleration / self._scale)
        speed = self._demand.setpoint_at(t_ns)[1]
        self._last_move = (place_um, profile)
        self._turn_ns = t_ns + round(abs(speed) / deceleration * NS_PER_S)
        self._demand.move(
            t_ns,
            self.spec.direction * place_um,
            speed=min(profile.speed / self._scale, self.spec.max_speed_um_s),
            acceleration=profile.acceleration / self._scale,
            deceleration=deceleration,
        )

    def _limited(self, t_ns: int, wanted: float) -> float:
        """The deceleration (µm/s²) that does not run past the mechanical ends."""
        position, speed = self._demand.setpoint_at(t_ns)
        place, velocity = self._to_place(position), self.spec.direction * speed
        room = self._end_um(1) - place if velocity > 0.0 else place - self._end_um(-1)
        return max(wanted, velocity * velocity / (2.0 * max(room, 1.0)))

    def _end_um(self, sense: int) -> float:
        return self.limit_um(sense) + sense * _RUN_OUT_UM

    def _to_place(self, axis_um: float) -> float:
        return self.spec.direction * axis_um

    def _to_counts(self, place_um: float) -> float:
        return (place_um + self.spec.direction * self._encoder.offset) * self._scale - self._zero_counts

    def _leaves_ns(self, t_ns: int, sense: int, until_ns: int | None) -> int | None:
        return self.passes_ns(t_ns, self.limit_um(sense), sense, far=True, until_ns=until_ns)


def _first_time(condition: Callable[[int], bool], low_ns: int, high_ns: int) -> int:
    """When a condition that holds at `high_ns` begins to hold, to a microsecond, found by bisection."""
    while low_ns + _MICROSECOND_NS < high_ns:
        middle_ns = (low_ns + high_ns) // 2
        if condition(middle_ns):
            high_ns = middle_ns
        else:
            low_ns = middle_ns
    return high_ns
