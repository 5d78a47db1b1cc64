"""What the tests of recordings share: a bus on a simulated clock, a recorder on it, and how samples are compared."""

import struct

import numpy as np
import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import DeviceEvent, ForceSample, Frame
from microdrivers.recording.header import RecordingHeader
from microdrivers.recording.recorder import Recorder


def bits(value):
    """What must be the same: a float's bits, an array's type, shape and bytes."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    return value


class Stage:
    """A bus, its clock, and all that was published on it."""

    def __init__(self, folder):
        self.clock = SimulatedClock()
        self.bus = Bus()
        self.file = folder / "run.mcap"
        self.published = []

    def recorder(self, **options):
        header = RecordingHeader(source="fake", seed=3, command="test", created_utc="2026-01-01")
        return Recorder(self.file, bus=self.bus, clock=self.clock, header=header, **options)

    def publish(self, topic, sample):
        self.bus.topic(topic, type(sample)).publish(sample)
        self.published.append((topic, sample))

    def force(self, seq, topic="force"):
        t_ns = self.clock.now_ns()
        self.publish(topic, ForceSample(t_ns=t_ns, device="cell", seq=seq, force_uN=seq / 7, raw_uN=-0.0))

    def frame(self, seq, shape=(40, 60), dtype=np.uint8):
        image = (np.arange(shape[0] * shape[1]) % 199).reshape(shape).astype(dtype) + np.asarray(seq, dtype)
        image.flags.writeable = False
        self.publish(
            "camera",
            Frame(
                t_ns=self.clock.now_ns(), device="camera", seq=seq, image=image, exposure_ms=5.0, frame_id=seq + 9,
                principal_point_px=(29.5, float("nan")),
            ),
        )  # fmt: skip

    def event(self, kind="opened"):
        self.publish("force/event", DeviceEvent(t_ns=self.clock.now_ns(), device="cell", kind=kind, reason="µ"))

    def run(self, *, seconds=0.5, frames=True):
        """1 kHz of force and 20 Hz of frames."""
        for index in range(round(seconds * 1000)):
            self.clock.sleep(0.001)
            self.force(index)
            if frames and index % 50 == 0:
                self.frame(index // 50)


@pytest.fixture
def stage(tmp_path):
    return Stage(tmp_path)


@pytest.fixture
def same():
    def compare(one, other):
        names = type(one).__struct_fields__
        return type(one) is type(other) and all(bits(getattr(one, n)) == bits(getattr(other, n)) for n in names)

    return compare


@pytest.fixture
def recorded(stage):
    """A recording of half a second, closed, with an attachment."""
    with stage.recorder() as recorder:
        recorder.attach("rig.yaml", b"name: test\n", "application/yaml")
        stage.run()
    return stage
