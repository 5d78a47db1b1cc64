"""pipython, the maker's own library, drives the GCS controllers over ports of the operating system."""

import pytest

from tests.fakes.gcs_bench import BenchWorld, chained_settings, served_emulator, stage_settings
from tests.judges.clients import run_client

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

CONNECT = """
    import time
    from pipython import GCSDevice, pitools, GCSError
    from pipython.pidevice.interfaces.piserial import PISerial
    from pipython.pidevice.interfaces.pisocket import PISocket
    gateway = PISerial(port=where, baudrate=115200) if kind == "pty" else PISocket(host=where[0], port=where[1])
    stage = GCSDevice(gateway=gateway)
    found["identification"] = stage.qIDN().strip()
    found["device name"] = stage.devname
    found["axes"] = stage.axes
    def code_of(call):
        try:
            call()
        except GCSError as error:
            return error.val
        return 0
"""

THREE_AXES = """
    pitools.startup(stage, stages=["M-111.1DG", "M-111.1DG", "M-116.DG"], refmodes=["FRF"] * 3)
    found["referenced"] = list(stage.qFRF().values())
    stage.MOV({"1": 7.55, "2": 7.45})
    pitools.waitontarget(stage, axes=["1", "2"])
    found["position"] = stage.qPOS(["1", "2"])
    stage.MVR("1", -0.00005)
    pitools.waitontarget(stage, axes="1")
    found["target"] = stage.qMOV("1")["1"]
    found["on target"] = list(stage.qONT().values())
    found["status"] = stage.qSRG("1", 1)["1"][1]
    found["settling window"] = stage.qSPA("1", 0x36)["1"][0x36]
    found["codes"] = {
        "out of limits": code_of(lambda: stage.MOV("1", 99.0)),
        "unknown axis": code_of(lambda: stage.send("MOV 9 1")),
        "unknown command": code_of(lambda: stage.send("XYZ 1")),
        "position with reference mode": code_of(lambda: stage.POS("1", 7.5)),
    }
    stage.SVO("3", False)
    found["codes"]["servo off"] = code_of(lambda: stage.MOV("3", 1.0))
    stage.VEL("1", 0.1)
    stage.MOV("1", 7.45)
    found["moving"] = stage.IsMoving()["1"]
    found["codes"]["HLT"] = code_of(lambda: stage.HLT("1"))
    stage.MOV("1", 7.45)
    found["codes"]["#24"] = code_of(stage.StopAll)
    time.sleep(0.05)
    found["moving after #24"] = any(stage.IsMoving().values())
    found["error afterwards"] = stage.qERR()
    gateway.close()
"""

LIMIT_SWITCHES = """
    pitools.startup(stage, stages=None, refmodes=["FNL", "FPL", None])
    found["referenced"] = list(stage.qFRF().values())
    found["position"] = stage.qPOS(["1", "2"])
    found["limits"] = [stage.qTMN("1")["1"], stage.qTMX("2")["2"]]
    found["status"] = [stage.qSRG(axis, 1)[axis][1] & 0x5 for axis in ("1", "2")]
    found["ready"] = stage.IsControllerReady()
    stage.RON("1", False)
    found["reference mode off"] = code_of(lambda: stage.FNL("1"))
    stage.SPA("2", 0x32, 1)
    found["no limit switches"] = code_of(lambda: stage.FPL("2"))
    stage.SPA("2", 0x14, 0)
    found["no reference switch"] = code_of(lambda: stage.FRF("2"))
    stage.POS("1", 3.0)
    found["declared position"] = stage.qPOS("1")["1"]
    gateway.close()
"""

CHAIN = """
    pitools.startup(stage, stages=["M-111.1DG"], refmodes=["FRF"])
    found["referenced"] = stage.qFRF("1")["1"]
    stage.MOV("1", 7.55)
    pitools.waitontarget(stage)
    found["position"] = stage.qPOS("1")["1"]
    found["codes"] = [
        code_of(lambda: stage.MOV("1", 99.0)),
        code_of(lambda: stage.send("MOV 2 7.5")),
        code_of(lambda: stage.send("MOV 1 7.5 2 7.5")),
        code_of(lambda: stage.HLT("1")),
    ]
    gateway.close()

    import serial
    port = serial.Serial(where, 115200, timeout=1.0)
    def ask(request):
        port.write(request.encode("latin-1"))
        return port.read_until().decode("latin-1")
    def all_of(request, last):
        port.write(request.encode("latin-1"))
        return port.read_until(last.encode("latin-1")).decode("latin-1")
    found["before"] = [ask(request) for request in ("2 *IDN?\\n", "3 0 *IDN?\\n", "2 FRF?\\n", "3 \\x04\\n", "3 \\x04")]
    found["help"] = all_of("3 HLP?\\n", "end of help\\n")
    found["begun"] = ask("2 SVO 1 1\\n2 FRF 1\\n2 ERR?\\n") + ask("2 \\x07\\n")
    while ask("2 \\x07") != "0 2 \\xb1\\n":
        time.sleep(0.05)
    requests = ("2 FRF? 1\\n", "2 POS? 1\\n", "3 FRF? 1\\n", "2 MOV 1 99\\n2 ERR?\\n")
    found["after"] = [ask(request) for request in requests]
    port.write(b"2 SPA 1 0x3F 0\\n1 CSV?\\n2 CSV?\\n3 CSV?\\n")
    found["together"] = sorted(port.read_until().decode("latin-1") for _ in range(3))
"""


def short_stage(settings):
    """0.2 mm of travel, so that no move takes long."""
    for axis in ("x", "y"):
        settings["axes"][axis]["travel_um"] = [7400, 7600]
    return settings


def near_the_switches():
    return BenchWorld(start={"x": 7480.0, "y": 7520.0, "theta": 0.1})


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_pipython_drives_the_controller_of_three_axes(transport):
    with served_emulator(short_stage(stage_settings()), near_the_switches(), transport) as where:
        found = run_client(CONNECT + THREE_AXES, transport, where)
    assert found["device name"] == "C-884.4DC"
    assert found["axes"] == ["1", "2", "3"]
    assert found["referenced"] == [True, True, True]
    assert found["position"] == pytest.approx({"1": 7.55, "2": 7.45}, abs=2e-4)
    assert found["target"] == pytest.approx(7.54995, abs=1e-7)
    assert found["on target"] == [True, True, True]
    assert found["status"] == 0x9002
    assert found["settling window"] == 3
    assert found["codes"] == {
        "out of limits": 7,
        "unknown axis": 15,
        "unknown command": 2,
        "position with reference mode": 34,
        "servo off": 5,
        "HLT": 10,
        "#24": 10,
    }
    assert found["moving"]
    assert not found["moving after #24"]
    assert found["error afterwards"] == 0


def test_pipython_references_at_the_limit_switches():
    with served_emulator(short_stage(stage_settings()), near_the_switches(), "pty") as where:
        found = run_client(CONNECT + LIMIT_SWITCHES, "pty", where)
    assert found["referenced"] == [True, True, False]
    assert found["position"] == pytest.approx({"1": 7.4, "2": 7.6}, abs=2e-4)
    assert found["limits"] == [7.4, 7.6]
    assert found["status"] == [0x1, 0x4]
    assert found["ready"]
    assert found["reference mode off"] == 50
    assert found["no limit switches"] == 32
    assert found["no reference switch"] == 31
    assert found["declared position"] == pytest.approx(3.0, abs=2e-4)


def test_pipython_drives_the_first_of_a_chain_and_bytes_the_others():
    with served_emulator(short_stage(chained_settings()), near_the_switches(), "pty") as where:
        found = run_client(CONNECT + CHAIN, "pty", where)
    assert found["identification"] == "(c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,0115500620,1.2.0.0"
    assert found["device name"] == "C-863.12"
    assert found["axes"] == ["1"]
    assert found["referenced"]
    assert found["position"] == pytest.approx(7.55, abs=2e-4)
    assert found["codes"] == [7, 15, 24, 10]
    assert found["before"] == [
        "0 2 (c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,0119012345,1.2.0.0\n",
        "0 3 (c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,0115500622,1.2.0.0\n",
        "0 2 1=0\n",
        "0 3 0x0002\n",
        "0 3 0x0002\n",
    ]
    assert found["help"].startswith("0 3 The following commands are valid: \n")
    assert found["help"].count("0 3 ") == 1
    assert found["begun"] == "0 2 0\n0 2 \xb0\n"
    assert found["after"] == ["0 2 1=1\n", "0 2 1=7.5000000\n", "0 3 1=0\n", "0 2 7\n"]
    assert found["together"] == ["0 1 2.0\n", "0 2 2.0\n", "0 3 2.0\n"]
