"""minimalmodbus and pymodbus read the analogue-input module: RTU on a pseudo-terminal and over TCP, Modbus TCP."""

import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.devices.drivers import ServeRequest
from tests.fakes.analogue_bench import ForceOnlyWorld, attach, module_behind
from tests.judges.clients import run_client

# One after the other: they run in real time.
pytestmark = pytest.mark.ports


@contextmanager
def served_module(transport, framing="rtu", **settings):
    """A module whose probe is pushed with 40 µN, that is 3.3 V, and where clients find it."""
    clock = SystemClock()
    emulation = attach(clock, ForceOnlyWorld(40.0), connection={"framing": framing}, **settings)
    with tempfile.TemporaryDirectory() as folder:
        endpoint = emulation.serve(ServeRequest(transport=transport, bind="127.0.0.1", folder=Path(folder)))
        try:
            yield module_behind(), endpoint.where
        finally:
            endpoint.close()
            emulation.close()
            clock.close()


# It keeps the silence between frames by itself. It waits for as many bytes as a good reply has, so an exception costs
# a time-out; where a reply must come, it may be late.
MINIMALMODBUS = """
    import minimalmodbus, serial
    port = serial.serial_for_url(where, baudrate=115200, timeout=5.0)
    module = minimalmodbus.Instrument(port, 1)
    def error_of(call, *arguments, **options):
        try:
            call(*arguments, **options)
        except (minimalmodbus.ModbusException, OSError) as error:
            return type(error).__name__ + ": " + str(error)
    found["inputs"] = module.read_registers(0, 8, functioncode=4)
    found["ranges"] = module.read_registers(ranges, 8)
    module.write_register(ranges, other, functioncode=6)
    found["other range"] = [module.read_register(ranges), module.read_register(0, functioncode=4)]
    module.write_registers(ranges, [normal, other])
    found["both ranges"] = module.read_registers(ranges, 2)
    port.timeout = 0.2
    found["one bad range"] = error_of(module.write_registers, ranges, [other, 0x77])
    found["function"] = error_of(module.read_bit, 0)
    found["address"] = error_of(module.read_register, 8, functioncode=4)
    found["foreign unit"] = error_of(minimalmodbus.Instrument(port, 7).read_register, 0, functioncode=4)
    port.timeout = 5.0
    found["own unit"] = module.read_register(0, functioncode=4)
    found["ranges at last"] = module.read_registers(ranges, 2)
"""

CODES = {"waveshare-8ch": (0x1000, 0, 2), "adam-4117": (0x00C8, 8, 9)}
# 3.3 V in the normal and the other range: mV and µA; offset binary over ±10 V and ±5 V.
WORDS = {"waveshare-8ch": (3300, 13_200), "adam-4117": (43_581, 54_395)}


@pytest.mark.parametrize(("transport", "model"), [("pty", "waveshare-8ch"), ("tcp", "adam-4117")])
def test_minimalmodbus(transport, model):
    _, normal, other = CODES[model]
    names = f"    ranges, normal, other = {CODES[model]}\n"
    with served_module(transport, model=model) as (_, where):
        found = run_client(names + MINIMALMODBUS.removeprefix("\n"), transport, where)
    first, in_other_range = WORDS[model]
    assert found["inputs"][0] == pytest.approx(first, abs=1)
    unused = 0 if model == "waveshare-8ch" else 0x8000
    assert all(abs(word - unused) < 20 for word in found["inputs"][1:])
    assert found["ranges"] == [normal] * 8
    assert found["other range"] == [other, pytest.approx(in_other_range, abs=4)]
    assert found["both ranges"] == found["ranges at last"] == [normal, other]
    assert found["function"] == "IllegalRequestError: Slave reported illegal function"
    assert found["address"] == "IllegalRequestError: Slave reported illegal data address"
    assert found["one bad range"] == "IllegalRequestError: Slave reported illegal data value"
    assert found["foreign unit"].startswith("NoResponseError")
    assert found["own unit"] == found["inputs"][0]


PYMODBUS = """
    import time, serial
    from pymodbus import FramerType, ModbusException
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient
    transport, framing = kind
    host, _, number = where.removeprefix("socket://").rpartition(":")
    patience = dict(timeout=5.0, retries=0)
    if transport == "pty":
        client = ModbusSerialClient(where, framer=FramerType.RTU, baudrate=115200, parity="N", **patience)
    else:
        framer = FramerType.SOCKET if framing == "tcp" else FramerType.RTU
        client = ModbusTcpClient(host, port=int(number), framer=framer, **patience)
    assert client.connect()
    # On RTU a request too soon after a reply is lost: the line needs 3.5 characters of silence.
    def paused(call, *arguments, **options):
        try:
            return call(*arguments, **{"device_id": 1, **options})
        finally:
            time.sleep(0.005 if framing == "rtu" else 0.0)
    found["inputs"] = paused(client.read_input_registers, 0, count=8).registers
    found["written"] = paused(client.write_registers, 0x1000, [1] * 8).count
    found["set"] = paused(client.write_register, 0x1000, 4).registers
    found["ranges"] = paused(client.read_holding_registers, 0x1000, count=8).registers
    found["code"] = paused(client.read_input_registers, 0, count=1).registers
    paused(client.write_registers, 0x1000, [0] * 8)
    refusals = {
        "function": paused(client.read_coils, 0, count=8),
        "echo": paused(client.diag_query_data, b"\\x12\\x34"),
        "address": paused(client.read_input_registers, 1, count=8),
        "read only": paused(client.write_register, 0, 1),
        "value": paused(client.write_register, 0x1007, 5),
    }
    found["refused"] = {name: reply.exception_code for name, reply in refusals.items()}
    client.comm_params.timeout_connect = 0.15 if framing == "rtu" else 5.0
    try:
        found["foreign unit"] = paused(client.read_input_registers, 0, count=1, device_id=7).exception_code
    except ModbusException:
        found["foreign unit"] = "silence"
    client.close()
    port = serial.serial_for_url(where, baudrate=115200)
    READ = bytes((4, 0, 0, 0, 1))
"""

# Frames are pymodbus'; the port is used by hand, because its client sends none of these.
LINE = """
    from pymodbus.framer.rtu import FramerRTU
    from pymodbus.pdu import DecodePDU
    rtu = FramerRTU(DecodePDU(False))
    def silence(*pieces):
        for piece in pieces:
            port.write(piece)
            time.sleep(0.1)
        port.timeout = 0
        return port.read(1) == b""
    def reading():
        port.timeout = 5.0
        port.write(good)
        received = port.read(7)
        time.sleep(0.005)
        length, unit, _, pdu = rtu.decode(received)
        return pdu.hex() if (length, unit) == (7, 1) else received.hex()
    good = rtu.encode(READ, 1, 0)
    found["golden"] = rtu.encode(bytes((4, 0, 0, 0, 8)), 1, 0).hex()
    found["good"] = reading()
    found["silent"], found["after"] = {}, {}
    for name, pieces in {
        "bad CRC": [good[:-1] + bytes((good[-1] ^ 1,))],
        "torn by a gap": [good[:3], good[3:]],
        "glued": [good + good],
        "garbage in front": [bytes((1, 3, 0)) + good],
        "much garbage": [bytes(range(256)) + bytes(44)],
    }.items():
        found["silent"][name] = silence(*pieces)
        found["after"][name] = reading()
"""

GATEWAY = """
    from pymodbus.framer.socket import FramerSocket
    from pymodbus.pdu import DecodePDU
    mbap = FramerSocket(DecodePDU(False))
    port.timeout = 5.0
    def ask(*requests):
        port.write(b"".join(mbap.encode(pdu, unit, transaction) for transaction, unit, pdu in requests))
        received, replies = b"", []
        while len(replies) < len(requests):
            received += port.read(max(1, 8 - len(received)))
            length, unit, transaction, pdu = mbap.decode(received)
            if length:
                replies.append((transaction, unit, pdu.hex()))
                received = received[length:]
        return replies
    pdus = (READ, bytes((6, 16, 0, 0, 4)), READ, bytes((6, 16, 0, 0, 9)), bytes((6, 16, 0, 0, 0)), READ)
    found["pipelined"] = ask(*((number, 1, pdu) for number, pdu in enumerate(pdus, 1)))
    found["foreign between"] = ask((7, 1, READ), (8, 9, READ), (9, 255, READ))
    port.write(b"GET / HTTP/1.1\\r\\n\\r\\n" + mbap.encode(READ, 1, 10))
    port.close()
    port.open()
    port.timeout = 5.0
    found["after garbage"] = ask((11, 1, READ))
"""

READING = "04020ce4"


def check_client(found, foreign_unit):
    assert found["inputs"][0] == 3300
    assert all(word < 20 for word in found["inputs"][1:])
    assert (found["written"], found["set"]) == (8, [4])
    assert found["ranges"] == [4, 1, 1, 1, 1, 1, 1, 1]
    assert found["code"] == [2703]
    assert found["refused"] == {"function": 1, "echo": 1, "address": 2, "read only": 2, "value": 3}
    assert found["foreign unit"] == foreign_unit


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_pymodbus_on_a_line(transport):
    with served_module(transport) as (module, where):
        found = run_client(PYMODBUS + LINE, (transport, "rtu"), where)
    check_client(found, "silence")
    assert found["golden"] == "010400000008f1cc"
    assert found["good"] == READING
    assert found["silent"] == dict.fromkeys(found["silent"], True)
    assert found["after"] == dict.fromkeys(found["silent"], READING)
    assert len(found["silent"]) == 5
    assert module.range_codes == [0] * 8


def test_pymodbus_on_a_network():
    with served_module("tcp", "tcp") as (module, where):
        found = run_client(PYMODBUS + GATEWAY, ("tcp", "tcp"), where)
    check_client(found, 0x0B)
    assert found["pipelined"] == [
        [1, 1, READING],
        [2, 1, "0610000004"],
        [3, 1, "04020a8f"],
        [4, 1, "8603"],
        [5, 1, "0610000000"],
        [6, 1, READING],
    ]
    assert found["foreign between"] == [[7, 1, READING], [8, 9, "840b"], [9, 255, READING]]
    assert found["after garbage"] == [[11, 1, READING]]
    assert module.range_codes == [0] * 8
