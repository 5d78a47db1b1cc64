"""A CiA 402 drive as the sheet describes it, for tests of the backend; see `canopen_peer`."""

from __future__ import annotations

import math

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from tests.backends.canopen_peer import PeerNode

SOD, READY, ON, ENABLED, QUICK, FAULT = 0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x0218
REACHED, LIMIT, ACK, ERROR = 1 << 10, 1 << 11, 1 << 12, 1 << 13


class Profile:
    """A trapezoid from rest, or (target None) the braking from a speed; counts and seconds since its start.

    `after` comes first, to its end.
    """

    def __init__(
        self, start: float, target: float | None, velocity: float, acceleration: float, *, after: Profile | None = None
    ) -> None:
        self.after = after
        self.start, self.acceleration = start, acceleration
        if target is None:
            self.sign, self.velocity = math.copysign(1.0, velocity), abs(velocity)
            self.distance = self.velocity**2 / (2 * acceleration)
            self.rise_s, self.duration_s = 0.0, self.velocity / acceleration
            return
        self.sign, self.distance = math.copysign(1.0, target - start), abs(target - start)
        self.velocity = min(velocity, math.sqrt(self.distance * acceleration))
        self.rise_s = self.velocity / acceleration
        cruise_s = (self.distance / self.velocity - self.rise_s) if self.velocity else 0.0
        self.duration_s = 2 * self.rise_s + cruise_s

    def at(self, seconds: float) -> tuple[float, float]:
        """Position and velocity."""
        if self.after is not None:
            if seconds < self.after.duration_s:
                return self.after.at(seconds)
            seconds -= self.after.duration_s
        if seconds >= self.duration_s:
            return self.start + self.sign * self.distance, 0.0
        if seconds < self.rise_s:
            way, speed = self.acceleration * seconds**2 / 2, self.acceleration * seconds
        else:
            left = self.duration_s - seconds
            braking = min(left, self.velocity / self.acceleration)
            way = self.distance - self.acceleration * braking**2 / 2 - self.velocity * (left - braking)
            speed = self.acceleration * braking
        return self.start + self.sign * way, self.sign * speed


class PeerDrive(PeerNode):
    """A drive. Spite, beside that of `PeerNode`: `no_acknowledge`, `homing_error`, `homing_s`, `quick_stop_options`."""

    def __init__(self, node_id: int, *, device_type: int = 0x00020192, home: int = 0) -> None:
        super().__init__(node_id, _dictionary(node_id, device_type))
        self.read_only = {(0x6041, 0), (0x6061, 0), (0x6064, 0), (0x1000, 0)}
        self.word = SOD
        self.control = 0
        self.exact = 1234.0
        self.home = home
        self.homed = False
        self.no_acknowledge = False
        self.homing_error = False
        self.homing_s = 0.2
        self.quick_stop_options = (2, 6)
        self.starts: list[tuple[int, int]] = []
        self._profile = Profile(self.exact, self.exact, 1.0, 1.0)
        self._begun_ns = 0
        self._bits = REACHED
        self._homing_until_ns: int | None = None
        self.on_write, self.on_read = self._write, self._read

    def position_at(self, t_ns: int) -> float:
        """Where the axis really is, in counts."""
        return self._profile.at((t_ns - self._begun_ns) / NS_PER_S)[0]

    def velocity_at(self, t_ns: int) -> float:
        return self._profile.at((t_ns - self._begun_ns) / NS_PER_S)[1]

    def fail(self, t_ns: int, code: int, *, quietly: bool = False) -> None:
        """Trip: brake, fault, emergency message."""
        self._brake(t_ns)
        self.word, self._bits = FAULT, 0
        self.put(0x603F, 0, code)
        if not quietly:
            self.emergency(t_ns, code)

    # ------------------------------------------------------------------ motion

    def step(self, t_ns: int) -> None:
        self.exact, velocity = self._profile.at((t_ns - self._begun_ns) / NS_PER_S)
        if self._homing_until_ns is not None and t_ns >= self._homing_until_ns:
            self._homing_until_ns = None
            self._bits = REACHED | ERROR
            if not self.homing_error:
                self.homed = True
                self._go(t_ns, Profile(self.home, self.home, 1.0, 1.0))
                self._bits = REACHED
        mode = self.number(0x6060, 0, signed=True)
        if mode == 1 and self.word == ENABLED and velocity == 0:
            before = self._profile.after
            moving_s = self._profile.duration_s + (before.duration_s if before is not None else 0.0)
            settled_ns = round(moving_s * NS_PER_S) + self.number(0x6068, 0) * NS_PER_MS
            if t_ns - self._begun_ns >= settled_ns:
                self._bits |= REACHED
        if self.word == QUICK and velocity == 0 and self.number(0x605A, 0, signed=True) == 2:
            self.word = SOD

    def host_lost(self, t_ns: int) -> None:
        self.fail(t_ns, 0x8130)

    def boot(self, t_ns: int) -> None:
        super().boot(t_ns)
        self._go(t_ns, Profile(self.position_at(t_ns), self.position_at(t_ns), 1.0, 1.0))
        fresh = _dictionary(self.id, self.number(0x1000, 0))
        self.objects.clear()
        self.objects.update(fresh)
        self.word, self._bits, self.homed, self.control = SOD, REACHED, False, 0
        self._consumer_ns = 0

    def _go(self, t_ns: int, profile: Profile) -> None:
        self._profile, self._begun_ns = profile, t_ns
        self.exact = profile.at(0.0)[0]

    def _brake(self, t_ns: int) -> None:
        position, velocity = self._profile.at((t_ns - self._begun_ns) / NS_PER_S)
        if velocity:
            self._go(t_ns, Profile(position, None, velocity, self.number(0x6085, 0)))
        self._homing_until_ns = None

    # ------------------------------------------------------------------ objects

    def _read(self, index: int, sub: int, t_ns: int) -> None:
        self.step(t_ns)
        if index == 0x6041:
            bits = self._bits
            if self.number(0x6060, 0, signed=True) == 6:
                running = self._homing_until_ns is not None
                bits = 0 if running else self._bits & (REACHED | ERROR) | (ACK if self.homed else 0)
            self.objects[0x6041, 0] = (self.word | bits).to_bytes(2, "little")
        elif index == 0x6061:
            self.objects[0x6061, 0] = self.objects[0x6060, 0]
        elif index == 0x6064:
            self.put(0x6064, 0, round(self.exact))

    def _write(self, index: int, sub: int, data: bytes, t_ns: int) -> None:
        if index == 0x605A and self.number(0x605A, 0, signed=True) not in self.quick_stop_options:
            self.put(0x605A, 0, 2)
        if index == 0x6060:
            self._bits &= ~ACK
        if index == 0x6040:
            self._command(int.from_bytes(data, "little"), t_ns)

    def _command(self, control: int, t_ns: int) -> None:
        rising, self.control = control & ~self.control, control
        if self.word == FAULT:
            if rising & 0x80:
                self.word, self._bits = SOD, REACHED
            return
        if control & 0x02 == 0:
            self.word = SOD
        elif control & 0x04 == 0:
            self._brake(t_ns)
            self._bits &= ~ACK
            self.word = QUICK if self.word in (ENABLED, QUICK) else SOD
        elif control & 0x0F == 0x06:
            self.word = READY
        elif control & 0x0F == 0x07:
            self.word = ON if self.word in (READY, ON, ENABLED) else self.word
        elif control & 0x0F == 0x0F:
            if self.word == QUICK and self.number(0x605A, 0, signed=True) == 6:
                self._go(t_ns, Profile(self.exact, self.exact, 1.0, 1.0))
            elif self.word not in (READY, ON, ENABLED):
                return
            self.word = ENABLED
            self._operate(control, rising, t_ns)

    def _operate(self, control: int, rising: int, t_ns: int) -> None:
        mode = self.number(0x6060, 0, signed=True)
        if not control & 0x10:
            self._bits &= ~ACK if mode == 1 else ~0
        if not rising & 0x10:
            return
        if mode == 6:
            self.homed = False
            self._homing_until_ns = t_ns + round(self.homing_s * NS_PER_S)
            self._go(t_ns, Profile(self.exact, self.exact - 2000, 5000.0, 1e6))
        elif mode == 1 and not self.no_acknowledge:
            target = self.number(0x607A, 0, signed=True)
            low, high = self.number(0x607D, 1, signed=True), self.number(0x607D, 2, signed=True)
            if low < high and self.homed and not low <= target <= high:
                self._bits |= LIMIT
                return
            self.starts.append((t_ns, target))
            velocity = self.velocity_at(t_ns)
            braking = Profile(self.exact, None, velocity, self.number(0x6084, 0)) if velocity else None
            start = braking.at(math.inf)[0] if braking is not None else self.exact
            self._go(t_ns, Profile(start, target, self.number(0x6081, 0), self.number(0x6083, 0), after=braking))
            self._bits = (self._bits | ACK) & ~REACHED


def _dictionary(node_id: int, device_type: int) -> dict[tuple[int, int], bytes]:
    def word(value: int, size: int = 4) -> bytes:
        return value.to_bytes(size, "little")

    objects = {
        (0x1000, 0): word(device_type), (0x1001, 0): b"\0", (0x1008, 0): b"FAKE-DRIVE-402", (0x1016, 1): word(0),
        (0x1017, 0): word(0, 2), (0x1018, 0): b"\4", (0x1018, 1): word(0xFC), (0x1018, 2): word(0x1387),
        (0x1018, 3): word(1), (0x1018, 4): word(1000 + node_id), (0x603F, 0): word(0, 2), (0x6040, 0): word(0, 2),
        (0x6041, 0): word(SOD, 2), (0x605A, 0): word(2, 2), (0x6060, 0): b"\0", (0x6061, 0): b"\0",
        (0x6064, 0): word(0), (0x6067, 0): word(10), (0x6068, 0): word(0, 2), (0x607A, 0): word(0),
        (0x607C, 0): word(0), (0x607D, 1): word(0), (0x607D, 2): word(0), (0x607F, 0): word(10_000_000),
        (0x6081, 0): word(1000), (0x6083, 0): word(1000), (0x6084, 0): word(1000), (0x6085, 0): word(1_000_000),
        (0x6098, 0): b"\x11", (0x6099, 1): word(1000), (0x6099, 2): word(100), (0x6502, 0): word(0x21),
    }  # fmt: skip
    for offset in range(4):
        for base, first in ((0x1400, 0x200), (0x1800, 0x180)):
            objects[base + offset, 1] = word(first + 0x100 * offset + node_id | 0x40000000 * (base == 0x1800))
            objects[base + offset, 2] = b"\xff"
        for base in (0x1600, 0x1A00):
            objects[base + offset, 0] = b"\0"
            for place in range(1, 5):
                objects[base + offset, place] = word(0)
    return objects
