"""What recording costs and keeps: a minute in real time, kills at random moments, reading and writing.

    python scripts/bench_record.py [--seconds 60] [--kills 50] [--folder DIR]

Synthetic publishers run at real pace: one 1 MP mono8 camera at 30 Hz, force at 1 kHz, three stages at 100 Hz. CPU times
are of the threads that do the work, so that other load on the machine counts as little as it can.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bench_wires.figures import Figure, show
from mcap.reader import make_reader

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock, SystemClock
from microdrivers.core.samples import FineStageSample, ForceSample, Frame, Sample
from microdrivers.recording.header import describe_recording
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.recording.repair import repair

SHAPE = (1024, 1024)
STAGES = ("stage_a", "stage_b", "stage_c")
PICTURES = [np.random.default_rng(seed).integers(0, 255, SHAPE, np.uint8) for seed in range(7)]
for picture in PICTURES:
    picture.flags.writeable = False


def force(seq: int, t_ns: int) -> ForceSample:
    """The force sample with that number: all of its content follows from it."""
    return ForceSample(t_ns=t_ns, device="cell", seq=seq, force_uN=seq / 7, raw_uN=seq / 3, tare_uN=-0.0)


def pose(seq: int, t_ns: int) -> FineStageSample:
    """The pose with that number."""
    return FineStageSample(
        t_ns=t_ns, device="stage", seq=seq, x_um=seq / 7, y_um=-seq / 3, z_um=0.1 * seq, moving=seq % 2 == 0,
        on_target=True, referenced=True,
    )  # fmt: skip


def frame(seq: int, t_ns: int) -> Frame:
    """The frame with that number."""
    return Frame(
        t_ns=t_ns, device="camera", seq=seq, image=PICTURES[seq % 7], exposure_ms=5.0, frame_id=seq,
        principal_point_px=(511.5, 511.5),
    )  # fmt: skip


def start_publishers(bus: Bus, clock: Clock, *, frames: bool) -> list[int]:
    """Publish at real pace; returns a list that counts what was published."""
    published = [0]
    lock = threading.Lock()

    def start(name: str, rate_hz: float, kind: type[Sample], make: Callable[[int, int], Sample]) -> None:
        topic = bus.topic(name, kind)
        start_ns, seq = clock.now_ns(), [0]

        def publish() -> None:
            # A late thread makes up for it: the number of samples is that of real time.
            while start_ns + seq[0] * 1e9 / rate_hz <= clock.now_ns():
                topic.publish(make(seq[0], clock.now_ns()))
                seq[0] += 1
                with lock:
                    published[0] += 1

        clock.every(1 / rate_hz, publish, name=name)

    start("force", 1000, ForceSample, force)
    for name in STAGES:
        start(name, 100, FineStageSample, pose)
    if frames:
        start("camera", 30, Frame, frame)
    return published


def cpu_s(thread: threading.Thread) -> float:
    """CPU time that a thread of this process has used."""
    return int(Path(f"/proc/self/task/{thread.native_id}/schedstat").read_text(encoding="utf-8").split()[0]) / 1e9


def minute(file: Path, seconds: float) -> tuple[int, int, float]:
    """Record in real time: published, dropped, the recorder thread's share of a core."""
    bus, clock = Bus(), SystemClock()
    with Recorder(file, bus=bus, clock=clock, header=describe_recording(source="fake")) as recorder:
        [thread] = [thread for thread in threading.enumerate() if thread.name == "recorder"]
        published = start_publishers(bus, clock, frames=True)
        begin_ns, before_s = clock.now_ns(), cpu_s(thread)
        clock.sleep(seconds)
        share = (cpu_s(thread) - before_s) / ((clock.now_ns() - begin_ns) / 1e9)
        clock.close()
    return published[0], sum(count.dropped for count in recorder.counts.values()), share


def queue_us(folder: Path) -> float:
    """What a publisher pays for being recorded in real time, µs a sample."""
    samples = [force(seq, seq) for seq in range(20_000)]

    def publish(recorded: bool) -> float:
        bus, clock = Bus(), SystemClock()
        topic = bus.topic("force", ForceSample)
        recorder = Recorder(folder / "queue.mcap", bus=bus, clock=clock, header=describe_recording(source="fake"))
        if not recorded:
            recorder.close()
        begin = time.thread_time()
        for sample in samples:
            topic.publish(sample)
        used = time.thread_time() - begin
        recorder.close()
        clock.close()
        recorder.file.unlink()
        return used / len(samples) * 1e6

    return min(publish(True) for _ in range(3)) - min(publish(False) for _ in range(3))


def write_us(folder: Path) -> float:
    """A sample written inline, as on a simulated clock, µs of CPU, chunks and CRC included."""
    bus, clock = Bus(), SimulatedClock()
    topic = bus.topic("force", ForceSample)
    count = 50_000
    samples = [force(seq, seq) for seq in range(count)]
    with Recorder(folder / "inline.mcap", bus=bus, clock=clock, header=describe_recording(source="fake")):
        begin = time.thread_time()
        for sample in samples:
            topic.publish(sample)
            clock._global_ns += 1_000_000
        return (time.thread_time() - begin) / count * 1e6


def read_rates(file: Path, seconds: float) -> tuple[float, float, float]:
    """Thousands of samples a second without frames, × real time without and with frames."""
    recording = Recording(file)
    begin = time.process_time()
    count = sum(1 for _ in recording.samples(["force", *STAGES]))
    without_s = time.process_time() - begin
    begin = time.process_time()
    for _ in recording.samples():
        pass
    with_s = time.process_time() - begin
    return count / without_s / 1000, seconds / without_s, seconds / with_s


def kill_once(folder: Path, *, frames: bool, moment: random.Random) -> tuple[float, bool, bool]:
    """Kill a recording program: seconds lost, all delivered as written, the repaired file passes."""
    file, out = folder / "killed.mcap", folder / "repaired.mcap"
    for old in (file, out):
        old.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        bus, clock = Bus(), SystemClock()
        Recorder(file, bus=bus, clock=clock, header=describe_recording(source="fake"))
        start_publishers(bus, clock, frames=frames)
        clock.sleep(60)
        os._exit(1)
    time.sleep(moment.uniform(0.4, 1.6))
    killed_ns = time.monotonic_ns()
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    recording = Recording(file)
    last_ns, good = 0, True
    for topic, sample in recording.samples():
        last_ns = max(last_ns, sample.t_ns)
        make = {"force": force, "camera": frame}.get(topic, pose)
        expected = make(sample.seq, sample.t_ns)
        for name in type(sample).__struct_fields__:
            one, other = getattr(sample, name), getattr(expected, name)
            good &= name == "order" or bool(np.array_equal(one, other, equal_nan=name.startswith("target_")))
    report = repair(file, out)
    with out.open("rb") as stream:
        passes = sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == sum(
            report.messages.values()
        )
    again = folder / "again.mcap"
    again.unlink(missing_ok=True)
    passes &= repair(out, again).losses == []
    return (killed_ns - last_ns) / 1e9, good, passes


def main() -> int:
    """Print the table; exit status 1 if a figure falls short."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    rows: list[Figure] = []
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        moment = random.Random(1)
        for frames in (False, True) if arguments.kills else ():
            kills = [kill_once(folder, frames=frames, moment=moment) for _ in range(arguments.kills)]
            lost_s = max(lost for lost, _, _ in kills)
            what = f"{len(kills)} × SIGKILL, {'with' if frames else 'without'} frames"
            rows.append(Figure(f"{what}: lost", "≤ 0.2 s", f"{lost_s:.3f} s", lost_s <= 0.2))
            corrupt, refused = sum(not good for _, good, _ in kills), sum(not passes for *_, passes in kills)
            rows.append(
                Figure(
                    f"{what}: corrupt delivered, repaired refused",
                    "0, 0",
                    f"{corrupt}, {refused}",
                    not corrupt + refused,
                )
            )
        file = folder / "minute.mcap"
        published, dropped, share = minute(file, arguments.seconds)
        rows.append(
            Figure(f"{arguments.seconds:g} s in real time: dropped of {published}", "0", f"{dropped}", dropped == 0)
        )
        rows.append(Figure("  the recorder's share of a core", "≤ 0.25", f"{share:.3f}", share <= 0.25))
        thousands, without, with_frames = read_rates(file, arguments.seconds)
        rows.append(
            Figure("reading, without frames", "≥ 150 k samples/s", f"{thousands:.0f} k samples/s", thousands >= 150)
        )
        rows.append(Figure("reading, without frames", "≥ 100 × real time", f"{without:.0f} ×", without >= 100))
        rows.append(Figure("reading, with frames", "≥ 20 × real time", f"{with_frames:.0f} ×", with_frames >= 20))
        written = write_us(folder)
        rows.append(Figure("writing a sample, chunks and CRC included", "≤ 30 µs", f"{written:.1f} µs", written <= 30))
        rows.append(
            Figure("what a publisher pays in real time", "≤ 3 µs", f"{(paid := queue_us(folder)):.1f} µs", paid <= 3)
        )
    return show(rows)


if __name__ == "__main__":
    sys.exit(main())
