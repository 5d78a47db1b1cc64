"""Commands run in an empty folder, on emulators that tests may interfere with."""

import re

import pytest
from click.testing import CliRunner

import microdrivers.rig
from microdrivers.cli.main import main
from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SystemClock
from microdrivers.fakes.wire import wire_named
from microdrivers.rig import build_rig


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments, stdin=None):
        asked = [str(argument) for argument in arguments]
        return CliRunner().invoke(main, asked, catch_exceptions=False, input=stdin)

    return call


@pytest.fixture
def prepared(monkeypatch):
    """Interfere with every rig that a command builds, before it is opened; returns the emulators that it met."""

    def install(prepare=lambda rig: None, **drivers):
        emulators = []

        def build(*arguments, **options):
            rig = build_rig(*arguments, **options)
            for name, driver in drivers.items():
                rig.devices[name] = driver(name, rig.simulation.settings_of(name), clock=rig.clock, bus=rig.bus)
            prepare(rig)
            emulators.append(wire_named("sample_stage").emulator)
            return rig

        monkeypatch.setattr(microdrivers.rig, "build_rig", build)
        return emulators

    return install


@pytest.fixture
def bench(tmp_path):
    """A rig whose wires hang on emulators in real time, and a rig file that reaches them without --fake."""
    slow = re.sub(r"speed_steps_s: \d+", "speed_steps_s: 2000", shipped_rig("microscope").read_text(encoding="utf-8"))
    original = tmp_path / "slow.yaml"
    original.write_text(slow, encoding="utf-8")
    rig = build_rig(original, fake=True, clock=SystemClock())
    file = tmp_path / "bench.yaml"
    ports = {"/dev/ttyUSB0": "fake://sample_stage", "/dev/ttyUSB1": "fake://zoom"}
    for port, url in ports.items():
        slow = slow.replace(port, url)
    file.write_text(slow, encoding="utf-8")
    yield rig, file
    rig.close()
