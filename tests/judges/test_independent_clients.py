"""Independent client libraries drive the emulators over ports of the operating system, as a vendor's software would.

Each client has a process of its own: pipython keeps state in its classes, and all of them block.
"""

import json
import subprocess
import sys
import textwrap

import pytest

from tests.conformance.bench import served

# One after the other: they run in real time.
pytestmark = pytest.mark.xdist_group("real_time")

PIPYTHON = """
    from pipython import GCSDevice, pitools, GCSError
    from pipython.pidevice.interfaces.piserial import PISerial
    from pipython.pidevice.interfaces.pisocket import PISocket
    gateway = PISerial(port=where, baudrate=115200) if kind == "pty" else PISocket(host=where[0], port=where[1])
    stage = GCSDevice(gateway=gateway)
    found["identification"] = stage.qIDN().strip()
    found["axes"] = stage.axes
    pitools.startup(stage, stages=None, refmodes=["FRF"] * 3)
    found["referenced"] = list(stage.qFRF().values())
    stage.MOV({"1": 7.6, "2": 7.4})
    pitools.waitontarget(stage, axes=["1", "2"])
    found["position"] = stage.qPOS(["1", "2"])
    def code_of(call):
        try:
            call()
        except GCSError as error:
            return error.val
        return 0
    found["out of limits"] = code_of(lambda: stage.MOV("1", 99.0))
    found["unknown axis"] = code_of(lambda: stage.send("MOV 9 1"))
    found["unknown command"] = code_of(lambda: stage.send("XYZ 1"))
    stage.SVO("3", False)
    found["servo off"] = code_of(lambda: stage.MOV("3", 1.0))
    stage.MOV("1", 9.0)
    found["halted"] = code_of(lambda: stage.HLT("1"))
    stage.MOV("1", 9.0)
    stage.StopAll(noraise=True)
    found["moving after #24"] = any(stage.IsMoving().values())
"""

# Neither client keeps the 3 ms that the drive needs between its reply and the next request (HP-5142E), so each call
# is followed by a pause.
MINIMALMODBUS = """
    import time, minimalmodbus, serial
    def paused(call, *arguments, **options):
        try:
            return call(*arguments, **options)
        finally:
            time.sleep(0.01)
    drive = minimalmodbus.Instrument(where, 1)
    drive.serial.baudrate, drive.serial.parity, drive.serial.timeout = 115200, serial.PARITY_NONE, 0.3
    found["idle"] = paused(drive.read_register, 0x007F)
    target = paused(drive.read_long, 0x00CC, signed=True) + 2000
    block = [0, 0, 0, 1, target >> 16 & 0xFFFF, target & 0xFFFF, 0, 20000, 15, 16960, 15, 16960, 0, 1000, 0, 1]
    paused(drive.write_registers, 0x0058, block)
    found["moving"] = paused(drive.read_register, 0x007F)
    time.sleep(0.3)
    found["missed by"] = paused(drive.read_long, 0x00CC, signed=True) - target
    try:
        paused(drive.read_register, 0x0500)
    except minimalmodbus.IllegalRequestError as error:
        found["undefined address"] = str(error)
    stranger = minimalmodbus.Instrument(where, 7)
    stranger.serial = drive.serial
    try:
        paused(stranger.read_register, 0x007F)
    except minimalmodbus.NoResponseError:
        found["foreign unit"] = "silence"
"""

PYMODBUS = """
    import time
    from pymodbus import FramerType
    from pymodbus.client import ModbusSerialClient
    client = ModbusSerialClient(where, framer=FramerType.RTU, baudrate=115200, parity="N", timeout=0.5, retries=0)
    assert client.connect()
    found["status"] = client.read_holding_registers(0x007E, count=2, device_id=1).registers
    time.sleep(0.01)
    found["exception"] = client.read_holding_registers(0x0500, count=2, device_id=1).exception_code
    time.sleep(0.01)
    found["function"] = client.read_coils(0, count=8, device_id=1).exception_code
    client.close()
"""


def run_client(code, kind, where):
    """Run a client's script in a process of its own; what it found."""
    known = f"import json\nfound, kind, where = {{}}, {kind!r}, {where!r}"
    script = f"{known}\n{textwrap.dedent(code)}\nprint(json.dumps(found))"
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    return json.loads(ran.stdout.splitlines()[-1])


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_pipython_drives_the_gcs_controller(transport):
    with served(transport, "sample_stage") as (rig, serving):
        rig.devices["sample_stage"].close()  # one host at a time
        where = serving.endpoints["sample_stage"].where
        host, _, port = where.removeprefix("socket://").rpartition(":")
        found = run_client(PIPYTHON, transport, where if transport == "pty" else (host, int(port)))
    assert "C-884" in found["identification"]
    assert found["axes"] == ["1", "2", "3"]
    assert all(found["referenced"])
    assert found["position"] == pytest.approx({"1": 7.6, "2": 7.4}, abs=2e-4)
    assert found["out of limits"] == 7
    assert found["unknown axis"] in (15, 23)
    assert found["unknown command"] == 2
    assert found["servo off"] == 5
    assert found["halted"] == 10
    assert not found["moving after #24"]


def test_minimalmodbus_drives_the_az_drive():
    with served("pty", "zoom") as (rig, serving):
        rig.devices["zoom"].close()
        found = run_client(MINIMALMODBUS, "pty", serving.endpoints["zoom"].where)
    assert found["idle"] & 0x4020 == 0x4020
    assert found["moving"] & 0x2000
    assert abs(found["missed by"]) <= 1
    assert "illegal data address" in found["undefined address"]
    assert found["foreign unit"] == "silence"


def test_pymodbus_reads_the_az_drive():
    with served("pty", "zoom") as (rig, serving):
        rig.devices["zoom"].close()
        found = run_client(PYMODBUS, "pty", serving.endpoints["zoom"].where)
    assert found["status"][1] & 0x4020 == 0x4020
    assert found["exception"] == 2
    assert found["function"] == 1
