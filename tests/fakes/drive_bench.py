"""An emulated servo drive on the bench."""

from __future__ import annotations

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.canopen import PROMPT, Temper
from microdrivers.fakes.cia402 import AT_ONCE, AxisSpec, Motion, Reaction, ServoDrive
from microdrivers.fakes.world.axis import Axis
from tests.fakes.canopen_bench import NodeBench

NODE = 5
SPEC = AxisSpec(
    counts_per_um=20.0, travel_um=(-625.0, 625.0), max_speed_um_s=1000.0, acceleration_um_s2=10_000.0, home_um=50.0
)
SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE, RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x80
PP, HM = 1, 6


class DriveBench(NodeBench):
    """A drive at −10 µm that reacts at once; counts are 50 nm."""

    def __init__(
        self,
        *,
        spec: AxisSpec = SPEC,
        at_um: float = -10.0,
        lag_s: float = 0.002,
        noise_um: float = 0.0,
        temper: Temper = PROMPT,
        reaction: Reaction = AT_ONCE,
        name: str = "FAKE-DRIVE-402",
        seed: int = 1,
    ) -> None:
        self.axis = Axis(at_um, lag_s=lag_s)
        motion = Motion(self.axis, spec, seed=seed, offset_um=-at_um, noise_um=noise_um)
        self.drive = ServoDrive(motion, node_id=NODE, seed=seed, name=name, temper=temper, reaction=reaction)
        super().__init__(self.drive.node)

    # ------------------------------------------------------------------ shorthand

    def control(self, word: int) -> int:
        """Write the control word; the status word that follows."""
        assert self.write(0x6040, word, 2) == 0
        return self.status()

    def status(self) -> int:
        return self.read(0x6041)

    def mode(self, mode: int) -> None:
        assert self.write(0x6060, mode, 1) == 0
        assert self.read(0x6061) == mode

    def position(self) -> int:
        return self.read(0x6064, signed=True)

    def um(self) -> float:
        """Where the table truly is."""
        return self.axis.position_at(self.t_ns)

    def enable(self, mode: int = PP) -> None:
        self.mode(mode)
        for word in (SHUTDOWN, SWITCH_ON, ENABLE) if self.status() & 0x6F != 0x27 else (ENABLE,):
            self.control(word)
        assert self.status() & 0x6F == 0x27

    def home(self, method: int = 37) -> int:
        """Home, and wait for the end; the status word then."""
        self.enable(HM)
        assert self.write(0x6098, method, 1) == 0
        self.control(ENABLE | 0x10)
        self.until(lambda: self.status() & 0x3400 != 0, limit_s=30.0)
        self.until(lambda: bool(self.status() & 0x400), limit_s=2.0)
        status = self.status()
        self.control(ENABLE)
        return status

    def move(self, target: int, *, bits: int = 0x20, size: int = 4) -> int:
        """Hand a set-point over; the status word right after it."""
        assert self.write(0x607A, target, size) == 0
        status = self.control(ENABLE | 0x10 | bits)
        self.control(ENABLE | bits)
        return status

    def until(self, condition: object, *, limit_s: float = 5.0, step_ms: float = 1.0) -> None:
        """Wait until something holds."""
        assert callable(condition)
        end_ns = self.t_ns + round(limit_s * NS_PER_S)
        while not condition():
            assert self.t_ns < end_ns, f"status {self.status():04X}, position {self.position()}, log {self.texts()}"
            self.wait_ms(step_ms)

    def until_reached(self) -> None:
        self.until(lambda: bool(self.status() & 0x400))

    def texts(self) -> list[str]:
        return [text for _, text in self.drive.log]


def ready_drive(*, homed: bool = True, **options: object) -> DriveBench:
    """A drive under power in profile position mode; at 0 counts, −10 µm."""
    bench = DriveBench(**options)  # type: ignore[arg-type]
    if homed:
        bench.home(37)
    bench.enable(PP)
    return bench
