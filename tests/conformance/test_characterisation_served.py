"""A force characterisation over ports: another process serves the emulators, and threads bring the samples."""

import subprocess
import sys

import msgspec
import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SystemClock, utc_now
from microdrivers.devices.fine_stage import FineStage
from microdrivers.recording.header import describe_recording
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.rig import open_rig
from microdrivers.routines.force import (
    Characterisation,
    IndentationReplay,
    PressExperiment,
    PressSettings,
    build_result,
)
from microdrivers.routines.provenance import describe_run

# With the machine to themselves, by `make test-ports`: they run in real time, drives and host watching each other.
pytestmark = pytest.mark.ports


@pytest.fixture
def served_rig(tmp_path):
    """The workstation's probe and camera on ports, the probe at 200 readings/s; another process serves them."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    wanted = ("sample_stage", "zoom", "camera_fine", "probe_stage", "probe_force")
    data["devices"] = {name: data["devices"][name] for name in wanted}
    data["devices"]["probe_force"]["rate_hz"] = 200
    data["devices"]["camera_fine"]["sensor_size_px"] = [320, 240]
    file, pointing = tmp_path / "probe.yaml", tmp_path / "served.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    command = [sys.executable, "-m", "microdrivers", "serve", str(file), "--write", str(pointing), "--for", "300"]
    with subprocess.Popen([*command, "--seed", "2"], stdout=subprocess.PIPE, text=True) as serving:
        try:
            while not serving.stdout.readline().startswith("serving"):
                assert serving.poll() is None
            yield pointing
        finally:
            serving.terminate()


def bits(samples):
    """All that a sample says, NaN included; its place on the bus says nothing."""
    return [msgspec.msgpack.encode(msgspec.structs.replace(sample, order=-1)) for sample in samples]


def test_a_threaded_run_on_ports_replays_to_the_same_bits(served_rig, tmp_path):
    file = tmp_path / "run.mcap"
    clock = SystemClock()
    with (
        open_rig(served_rig, clock=clock, devices="probe") as rig,
        Recorder(file, bus=rig.bus, clock=clock, header=describe_recording(source="fake")) as recorder,
    ):
        stage = rig.device("probe_stage", FineStage)
        stage.reference(stage.reference_order)
        source = PressExperiment(rig, PressSettings(speed_um_s=20.0, depth_um=30.0, rest_s=0.5))
        characterisation = Characterisation(
            source, on_host=lambda host, inbox: recorder.follow_arrivals(host, inbox.arrivals)
        )
        run = characterisation.run()
    assert run.complete
    assert len(run.first.samples) > 30
    with Recording(file) as recording:
        assert recording.losses == []
        assert all(topic.dropped == 0 for topic in recording.topics.values())
        again = Characterisation(IndentationReplay(recording)).run()
    for before, after in ((run.first, again.first), (run.check, again.check)):
        assert after.arrivals == before.arrivals
        assert bits(after.samples) == bits(before.samples)
        assert bits(after.deformations) == bits(before.deformations)
        assert bits(after.estimates) == bits(before.estimates)
        assert bits(after.forces) == bits(before.forces)
    provenance = describe_run({"source": "test", "clock": "system"}, command="test", now=utc_now())
    assert build_result(again, provenance) == build_result(run, provenance)
