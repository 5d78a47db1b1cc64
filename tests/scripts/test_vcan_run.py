"""`scripts/vcan-run` as far as it can be tested without a guest."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scripts.vcan_run import native, uml
from scripts.vcan_run.cli import main
from scripts.vcan_run.job import GuestFailed, Job, NotUsable
from scripts.vcan_run.kernel_modules import ModuleTree
from scripts.vcan_run.session import Session
from scripts.vcan_run.setup import Cache, set_up_qemu

TOOL = Path(__file__).parents[2] / "scripts" / "vcan-run"
GUEST = Path(__file__).parents[2] / "scripts" / "vcan_run" / "guest"


def job(*command, limit_s=30, modules=()):
    return Job(
        command=command, limit_s=limit_s, memory_mib=64, modules=modules, show_boot_log=False, virtual_time=False
    )  # fmt: skip


def run_tool(*arguments, **environment):
    return subprocess.run(
        [sys.executable, TOOL, *arguments], env={**os.environ, **environment}, capture_output=True, text=True
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give a command"),
        (["--"], "give a command"),
        (["-b", "nonsense", "--", "true"], "invalid choice: 'nonsense'"),
        (["-t", "0", "--", "true"], "positive whole number"),
        (["-m", "much", "--", "true"], "invalid"),
        (["--nonsense", "true"], "unrecognized arguments"),
        (["--setup"], "expected one argument"),
        (["--setup", "native"], "invalid choice: 'native'"),
        (["--setup", "uml", "--", "true"], "or --setup"),
    ],
)
def test_wrong_use_is_told_and_ends_with_2(arguments, words, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("backend", ["uml", "qemu"])
def test_a_backend_that_is_not_set_up_names_the_remedy(backend, tmp_path):
    done = run_tool("-b", backend, "--", "true", MICRODRIVERS_VM_CACHE=str(tmp_path))
    assert done.returncode == 2
    assert f"vcan-run --setup {backend}" in done.stderr


def test_only_debian_can_be_set_up(tmp_path):
    done = run_tool("--setup", "uml", MICRODRIVERS_VM_CACHE=str(tmp_path), PATH=str(tmp_path))
    assert done.returncode == 2
    assert "only Debian and Ubuntu" in done.stderr
    assert not list(tmp_path.iterdir())


def test_only_root_can_install_qemu(monkeypatch, tmp_path):
    for tool in ("apt-get", "dpkg-deb"):
        (tmp_path / tool).touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("MICRODRIVERS_VM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(NotUsable, match=r"only root can install it: sudo apt-get install .*qemu-system-x86"):
        set_up_qemu(Cache())


def test_without_a_network_the_remedy_is_named(monkeypatch, tmp_path):
    tools, cache = tmp_path / "tools", tmp_path / "cache"
    tools.mkdir()
    for tool in ("apt-get", "dpkg-deb"):
        (tools / tool).write_text("#!/bin/sh\necho 'Temporary failure resolving' >&2\nexit 100\n")
        (tools / tool).chmod(0o755)
    done = run_tool("--setup", "uml", MICRODRIVERS_VM_CACHE=str(cache), PATH=str(tools))
    assert done.returncode == 2
    assert "Temporary failure resolving" in done.stderr
    told = done.stderr.splitlines()[-1]
    assert "apt cannot download busybox-static" in told
    assert f"without a network, copy the folder {cache}" in told
    assert not cache.exists() or not list(cache.iterdir())


def test_a_guest_stays_on_one_of_the_processors_that_we_may_use():
    assert uml.idlest_processor() in os.sched_getaffinity(0)


def test_the_cache_lies_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.delenv("MICRODRIVERS_VM_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert Cache().folder == tmp_path / "microdrivers" / "vm"
    monkeypatch.setenv("MICRODRIVERS_VM_CACHE", str(tmp_path / "here"))
    assert Cache().folder == tmp_path / "here"


# ---------------------------------------------------------------------- native


def test_a_command_on_this_kernel_keeps_its_status_and_streams(capfd):
    assert native.run(job("sh", "-c", 'echo "$VCAN_RUN"; echo wrong >&2; cat; exit 7')) == 7
    assert capfd.readouterr() == ("native\n", "wrong\n")


def test_a_command_that_a_signal_ends_has_the_shells_status():
    assert native.run(job("sh", "-c", "kill -KILL $$")) == 137


def test_a_command_that_runs_too_long_is_ended_with_all_that_it_started(capfd):
    assert native.run(job("sh", "-c", "trap 'echo ended; exit' TERM; sleep 1000 & wait", limit_s=1)) == 124
    assert capfd.readouterr().out == "ended\n"


def test_a_command_that_does_not_exist_is_wrong_use():
    with pytest.raises(NotUsable, match="cannot run no-such-command: No such file"):
        native.run(job("no-such-command"))


# ---------------------------------------------------------------------- guests


@pytest.fixture
def tree(tmp_path):
    (tmp_path / "modules.dep").write_text(
        "kernel/net/can/can.ko.xz:\n"
        "kernel/net/can/can-raw.ko.xz: kernel/net/can/can.ko.xz\n"
        "kernel/drivers/can/dev.ko.xz:\n"
        "kernel/drivers/can/sja1000.ko.xz: kernel/drivers/can/dev.ko.xz\n"
        "kernel/drivers/can/kvaser_pci.ko.xz: kernel/drivers/can/sja1000.ko.xz kernel/drivers/can/dev.ko.xz\n"
    )
    return ModuleTree(tmp_path)


def test_modules_are_loaded_after_those_that_they_need_and_once(tree, tmp_path):
    files = tree.load_order(["kvaser-pci", "sja1000"], where_present=["can_raw", "vcan"])
    assert [file.relative_to(tmp_path).name.partition(".")[0] for file in files] == [
        "can", "can-raw", "dev", "sja1000", "kvaser_pci",
    ]  # fmt: skip


def test_a_module_that_the_kernel_lacks_is_named(tree):
    with pytest.raises(NotUsable, match="no module 'vivid'"):
        tree.load_order(["vivid"])


@pytest.fixture
def open_session(tmp_path, monkeypatch):
    monkeypatch.setenv("MICRODRIVERS_VM_CACHE", str(tmp_path))

    def open_it(*command, **limits):
        return Session(job(*command, **limits), "uml", Cache(), ["/some/vcan.ko"])

    return open_it


def test_the_guest_runs_the_command_as_the_caller_would(open_session, monkeypatch, tmp_path):
    odd = "two\nlines, 'quotes', $HOME \udcff"
    here = tmp_path / "it's a folder"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("ODD", odd)
    program = "import os, sys; print(ascii([sys.argv[1:], os.environ['ODD'], os.getcwd(), os.environ['VCAN_RUN']]))"
    with open_session(sys.executable, "-c", program, "a b", "", "*") as session:
        done = subprocess.run(["sh", session.folder / "command"], cwd="/", env={}, capture_output=True, text=True)
        assert done.stdout.strip() == ascii([["a b", "", "*"], odd, str(here), "uml"])
    assert not session.folder.exists()


def test_output_is_passed_on_apart_and_the_status_is_the_commands(open_session, capfd):
    with open_session("anything") as session:
        out, err = session.outputs
        machine = f"echo right >/dev/fd/{out}; echo wrong >/dev/fd/{err}; echo boot message; echo 7 >status"
        assert session.run(["sh", "-c", machine]) == 7
    assert capfd.readouterr() == ("right\n", "wrong\n")


def test_a_guest_that_fails_tells_what_its_kernel_said(open_session):
    with open_session("anything") as session, pytest.raises(GuestFailed) as caught:
        session.run(["sh", "-c", "echo all is well; echo Kernel panic; echo cannot load vcan.ko >failure; exit 3"])
    assert str(caught.value).splitlines() == [
        "the uml guest ended without the command's exit status (its own: 3)",
        "  cannot load vcan.ko",
        "  Kernel panic",
    ]


def test_an_interrupted_run_ends_the_machine(open_session, monkeypatch, tmp_path):
    ended = tmp_path / "ended"

    def interrupt(self, process):
        while not (session.folder / "ready").exists():
            assert process.poll() is None
        time.sleep(0.5)  # `timeout` passes a signal on only once its own fork has returned
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "_wait", interrupt)
    with open_session("anything") as session, pytest.raises(KeyboardInterrupt):
        session.run(["sh", "-c", f"trap 'touch {ended}; exit' TERM; touch ready; while :; do sleep 0.01; done"])
    assert ended.exists()


@pytest.mark.parametrize("script", sorted(GUEST.glob("*.sh")), ids=lambda path: path.name)
def test_the_guests_scripts_can_be_parsed(script):
    assert subprocess.run(["sh", "-n", script], capture_output=True, text=True).stderr == ""
