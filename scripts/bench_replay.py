"""How fast recordings are replayed and analysed, beside what must be reached.

    python scripts/bench_replay.py [--recordings 200] [--folder DIR]

Replay is judged by the processor time of the best of several rounds, so that other programs on the machine count less;
the median and the wall time stand beside it. A round is what `calibrate optics --replay FILE` does with the file, from
opening it to the last estimate, the notes on its flaws included; without tracking, what `replay FILE` publishes.
Python's start, all imports and the report take the same time for recordings of any length: they are in the line "the
whole command" alone. The recorded time, from the first sample to the last one, is that of the emulated rig.
The batch needs two free cores: the load of the machine is shown with it. Its recordings are hard links to a few short
calibrations of different worlds.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bench_wires.figures import Figure, show

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.recording.header import describe_recording
from microdrivers.recording.playback import open_replay
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.rig import open_rig
from microdrivers.routines.analysis import find_recordings
from microdrivers.routines.optics import CircleExperiment, CircleSettings, OpticsReplay, calibrate_optics

FRAMES = 100
"""As by default."""
BATCH_FRAMES = 60
WORLDS = 4


class Took(NamedTuple):
    """Processor and wall seconds."""

    cpu_s: float
    wall_s: float


def timed(call: Callable[[], object]) -> Took:
    """How long a call takes."""
    cpu, wall = time.process_time(), time.perf_counter()
    call()
    return Took(time.process_time() - cpu, time.perf_counter() - wall)


def record(file: Path, *, seed: int, frames: int) -> float:
    """Record an emulated calibration; seconds of recorded time."""
    clock = SimulatedClock()
    with open_rig(shipped_rig(), fake=True, seed=seed, clock=clock, devices="microscope") as rig:
        source = CircleExperiment(rig, CircleSettings(frames=frames))
        with Recorder(file, bus=rig.bus, clock=clock, header=describe_recording(source="fake", seed=seed)) as recorder:
            calibrate_optics(source, on_host=lambda name, inbox: recorder.follow_arrivals(name, inbox.arrivals))
    return span_s(file)


def span_s(file: Path) -> float:
    """From the first to the last sample, recorded time."""
    with Recording(file) as recording:
        ends = [(topic.first_t_ns, topic.last_t_ns) for topic in recording.topics.values() if topic.count]
    return (max(last for _, last in ends) - min(first for first, _ in ends)) / 1e9


def track(file: Path) -> int:
    """Replay with tracker and estimator; number of frames."""
    with Recording(file) as recording:
        return len(calibrate_optics(OpticsReplay(recording)).estimates)


def track_by_command(file: Path) -> Took:
    """The whole command with its start and its report."""
    command = ["calibrate", "optics", "--replay", str(file), "--out", str(file.with_suffix(""))]
    before, begin = os.times(), time.perf_counter()
    subprocess.run([sys.executable, "-m", "microdrivers", *command], check=True, capture_output=True)
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return Took(cpu_s, time.perf_counter() - begin)


def publish(file: Path, leave_out: tuple[str, ...] = ()) -> None:
    """Replay onto a bus."""
    with open_replay(file, leave_out=leave_out) as playback:
        playback.run()


def minute(file: Path, seconds: float) -> None:
    """1 kHz force, three stages and a camera of an emulated workstation."""
    command = ["record", str(shipped_rig("workstation")), "--fake", "--for", str(seconds), "--out", str(file)]
    subprocess.run([sys.executable, "-m", "microdrivers", *command], check=True, capture_output=True)


def analyse(folder: Path, table: Path, jobs: int) -> float:
    """Wall seconds of the command."""
    begin = time.monotonic()
    command = ["analyse", str(folder), "--jobs", str(jobs), "--out", str(table)]
    subprocess.run([sys.executable, "-m", "microdrivers", *command], check=True, capture_output=True)
    return time.monotonic() - begin


def killed_and_resumed(folder: Path, table: Path) -> bool:
    """Whether it was killed in the middle; then goes on to the end."""
    journal = table.with_name(f"{table.name}.journal")
    command = [sys.executable, "-m", "microdrivers", "analyse", str(folder), "--jobs", "2", "--out", str(table)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wanted = 1 + len(find_recordings([folder])) // 2
    while process.poll() is None and (not journal.exists() or len(journal.read_bytes().splitlines()) <= wanted):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    in_the_middle = journal.exists()
    analyse(folder, table, 2)
    return in_the_middle


def main() -> int:
    """Print the table; exit status 1 if a figure falls short."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    rows: list[Figure] = []

    def add_speed(what: str, must: float, recorded_s: float, call: Callable[[], object], *, times: int) -> Took:
        call()
        rounds = sorted(timed(call) for _ in range(times))
        best, median = rounds[0], rounds[times // 2]
        factor = recorded_s / best.cpu_s
        others = f"median {recorded_s / median.cpu_s:.0f} ×, {recorded_s / best.wall_s:.0f} × by the wall clock"
        rows.append(Figure(what, f"≥ {must:g} ×", f"{factor:.0f} × ({others})", factor >= must))
        return best

    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        file = folder / "optics.mcap"
        recorded_s = record(file, seed=1, frames=FRAMES)
        frames = track(file)
        best = add_speed(f"replay with tracking, {frames} frames", 20, recorded_s, lambda: track(file), times=10)
        each = f"{1e3 * best.cpu_s / frames:.2f} ms a frame, of {1e3 * recorded_s / frames:.1f} ms recorded"
        rows.append(Figure("  processor time", "", f"{best.cpu_s:.3f} s of {recorded_s:.2f} s: {each}"))
        whole = track_by_command(file)
        told = f"{whole.cpu_s:.1f} s ({whole.wall_s:.1f} s by the wall clock)"
        rows.append(Figure("  the whole command, start and report included", "", told))
        dense = folder / "minute.mcap"
        minute(dense, arguments.seconds)
        recorded_s = span_s(dense)
        add_speed(
            "replay without frames, 1 kHz force, stages", 100, recorded_s, lambda: publish(dense, ("camera*",)), times=5
        )
        add_speed("replay with frames, no tracking", 20, recorded_s, lambda: publish(dense), times=2)
        dense.unlink()
        runs = folder / "runs"
        runs.mkdir()
        for number in range(min(WORLDS, arguments.recordings)):
            record(runs / f"{number:03d}.mcap", seed=number, frames=BATCH_FRAMES)
        for number in range(WORLDS, arguments.recordings):
            (runs / f"{number:03d}.mcap").hardlink_to(runs / f"{number % WORLDS:03d}.mcap")
        one_s, two_s = analyse(runs, folder / "1.csv", 1), analyse(runs, folder / "2.csv", 2)
        what = f"{arguments.recordings} recordings, --jobs 2 against --jobs 1"
        load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        told = f"{one_s / two_s:.2f} × ({one_s:.1f} s, {two_s:.1f} s; {load})"
        rows.append(Figure(what, "≥ 1.7 ×", told, one_s / two_s >= 1.7))
        middle = killed_and_resumed(runs, folder / "3.csv")
        tables = {(folder / f"{number}.csv").read_bytes() for number in (1, 2, 3)}
        rows.append(
            Figure(
                "tables of 1 and 2 jobs, killed and resumed",
                "identical",
                "identical" if len(tables) == 1 else "different",
                len(tables) == 1,
            )
        )
        rows.append(Figure("  it was killed in the middle", "yes", "yes" if middle else "no", middle))
    return show(rows)


if __name__ == "__main__":
    sys.exit(main())
