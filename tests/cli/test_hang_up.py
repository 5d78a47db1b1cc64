"""A closed terminal ends a command as Ctrl-C does."""

import contextlib
import os
import pty
import signal
import subprocess
import sys

import pytest
import yaml

from microdrivers.configs import shipped_rig

pytestmark = [
    pytest.mark.xdist_group("real_time"),
    pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there are no terminals that hang up"),
]


@pytest.fixture
def rig_file(tmp_path):
    data = yaml.safe_load(shipped_rig("microscope").read_text(encoding="utf-8"))
    del data["microscope"], data["devices"]["camera_fine"]
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


@pytest.fixture(autouse=True)
def hang_ups_are_not_ignored():
    """Programs inherit it if they are: the tests may have been started with nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@contextlib.contextmanager
def served(rig_file, **streams):
    temporary = rig_file.parent / "temporary"
    temporary.mkdir()
    command = [sys.executable, "-m", "microdrivers", "serve", str(rig_file)]
    environment = os.environ | {"TMPDIR": str(temporary)}
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment, **streams) as process:
        try:
            yield temporary, process
        finally:
            process.kill()  # one that has not ended would keep the tests waiting


def test_serve_cleans_up_when_it_is_hung_up(rig_file):
    with served(rig_file, stdout=subprocess.PIPE, text=True) as (temporary, process):
        for line in process.stdout:
            if line.startswith("serving"):
                break
        assert list(temporary.iterdir())
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGHUP)  # as a shell and the system both do
        assert process.wait(30) == 0
    assert not list(temporary.iterdir())


def test_a_terminal_that_is_gone_keeps_nothing_from_being_cleaned(rig_file):
    ours, theirs = pty.openpty()
    with served(rig_file, stdout=theirs, stderr=theirs) as (temporary, process):
        os.close(theirs)
        said = b""
        while b"serving" not in said:
            said += os.read(ours, 4096)
        os.close(ours)
        process.send_signal(signal.SIGHUP)
        assert process.wait(30) == 0
    assert not list(temporary.iterdir())


def test_a_command_under_nohup_goes_on(monkeypatch, run):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert run("check", shipped_rig("microscope")).exit_code == 0
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
