"""A closed terminal ends a command as Ctrl-C does."""

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


def served(rig_file, **streams):
    temporary = rig_file.parent / "temporary"
    temporary.mkdir()
    command = [sys.executable, "-m", "microdrivers", "serve", str(rig_file)]
    return temporary, subprocess.Popen(
        command, stdin=subprocess.DEVNULL, env=os.environ | {"TMPDIR": str(temporary)}, **streams
    )


def test_serve_cleans_up_when_it_is_hung_up(rig_file):
    temporary, process = served(rig_file, stdout=subprocess.PIPE, text=True)
    with process:
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
    temporary, process = served(rig_file, stdout=theirs, stderr=theirs)
    os.close(theirs)
    with process:
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
