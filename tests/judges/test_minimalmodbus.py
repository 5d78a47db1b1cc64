"""minimalmodbus drives the AZ drive over Modbus RTU, on pseudo-terminals and over TCP."""

import pytest

from microdrivers.fakes.oriental_az.register_map import BYTE_WORD_ORDER
from tests.judges.clients import run_client
from tests.judges.served_zoom import served_zoom

# One after the other: they run in real time.
pytestmark = pytest.mark.ports

# It does not keep the 3 ms that the drive needs between its reply and the next request (HP-5142E), so each call is
# followed by a pause.
PAUSED = """
    import time, minimalmodbus, serial
    port = serial.serial_for_url(where, baudrate=115200, timeout=2.0)
    drive = minimalmodbus.Instrument(port, 1)
    def paused(call, *arguments, **options):
        try:
            return call(*arguments, **options)
        finally:
            time.sleep(0.01)
    def error_of(call, *arguments, **options):
        try:
            paused(call, *arguments, **options)
        except (minimalmodbus.ModbusException, OSError) as error:
            return type(error).__name__ + ": " + str(error)
"""

DIRECT_DATA = """
    found["idle"] = paused(drive.read_register, 0x007F)
    target = paused(drive.read_long, 0x00CC, signed=True) + 2000
    block = [0, 0, 0, 1, target >> 16 & 0xFFFF, target & 0xFFFF, 0, 4000, 15, 16960, 15, 16960, 0, 1000, 0, 1]
    paused(drive.write_registers, 0x0058, block)
    found["moving"] = paused(drive.read_register, 0x007F)
    while paused(drive.read_register, 0x007F) & 0x2000:
        pass
    time.sleep(0.05)
    found["missed by"] = paused(drive.read_long, 0x00CC, signed=True) - target
    paused(drive.write_register, 0x007D, 0x0010, functioncode=6)
    paused(drive.write_register, 0x007D, 0x0000, functioncode=6)
    while paused(drive.read_register, 0x007F) & 0x2000:
        pass
    found["home"] = paused(drive.read_long, 0x00C6, signed=True)
    found["inputs"] = paused(drive.read_register, 0x007D)
"""

# It waits for as many bytes as a good reply has, so an exception costs a time-out.
MISTAKES = """
    port.timeout = 0.3
    found["function"] = error_of(drive.read_bit, 0)
    found["address"] = error_of(drive.read_register, 0x0500)
    found["value"] = error_of(drive._perform_command, 3, b"\\x00\\x7e\\x00\\x00")
    found["range"] = error_of(drive.write_long, 0x0060, 0)
    stranger = minimalmodbus.Instrument(port, 7)
    found["foreign unit"] = error_of(stranger.read_register, 0x007F)
    found["own unit"] = error_of(drive.read_register, 0x007F)
"""

ORDERS = """
    name = {0: "BIG", 1: "LITTLE_SWAP", 2: "BIG_SWAP", 3: "LITTLE"}[int(order)]
    order = getattr(minimalmodbus, "BYTEORDER_" + name)
    paused(drive.write_long, 0x005C, -70000, signed=True, byteorder=order)
    found["read back"] = paused(drive.read_long, 0x005C, signed=True, byteorder=order)
    found["outputs"] = paused(drive.read_long, 0x007E, byteorder=order)
"""


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_direct_data_and_return_to_home(transport):
    with served_zoom(transport) as (drive, where):
        found = run_client(PAUSED + DIRECT_DATA, transport, where)
        moves = [text for _, text in drive.log]
    assert found["idle"] & 0x4020 == 0x4020
    assert found["moving"] & 0x2000
    assert abs(found["missed by"]) <= 1
    assert moves[0].startswith("move ")
    assert moves[1:] == ["zhome"]
    assert found["home"] == 0
    assert found["inputs"] == 0


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_mistakes(transport):
    with served_zoom(transport) as (drive, where):
        found = run_client(PAUSED + MISTAKES, transport, where)
    assert found["function"] == "IllegalRequestError: Slave reported illegal function"
    assert found["address"] == "IllegalRequestError: Slave reported illegal data address"
    assert found["value"] == "IllegalRequestError: Slave reported illegal data value"
    assert found["range"] == "SlaveReportedException: Slave reported device failure"
    assert found["foreign unit"].startswith("NoResponseError")
    assert found["own unit"] is None
    assert drive.log == []


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_byte_and_word_orders_are_those_it_knows(order):
    with served_zoom("pty") as (drive, where):
        drive.set_up(BYTE_WORD_ORDER, order)
        found = run_client(f'    order = "{order}"\n' + PAUSED.removeprefix("\n") + ORDERS, "pty", where)
    assert found == {"read back": -70000, "outputs": 0x4030}
