"""pymodbus drives the AZ drive: Modbus RTU on pseudo-terminals and over TCP, Modbus TCP through the gateway."""

import pytest

from tests.judges.clients import run_client
from tests.judges.served_zoom import served_zoom

# One after the other: they run in real time.
pytestmark = pytest.mark.ports

LINKS = {"RTU on a pseudo-terminal": ("pty", "rtu"), "RTU over TCP": ("tcp", "rtu"), "Modbus TCP": ("tcp", "tcp")}

# A request too soon after a reply is lost on the drive (HP-5142E: 3 ms), so on RTU each call is followed by a pause;
# a gateway keeps it for its hosts. A late reply is no failure here, so time-outs are long where one must come.
CLIENT = """
    import time
    from pymodbus import FramerType, ModbusException
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient
    transport, framing = kind
    host, _, port = where.removeprefix("socket://").rpartition(":")
    patience = dict(timeout=5.0, retries=0)
    if transport == "pty":
        client = ModbusSerialClient(where, framer=FramerType.RTU, baudrate=115200, parity="N", **patience)
    else:
        framer = FramerType.SOCKET if framing == "tcp" else FramerType.RTU
        client = ModbusTcpClient(host, port=int(port), framer=framer, **patience)
    assert client.connect()
    def paused(call, *arguments, **options):
        try:
            return call(*arguments, **{"device_id": 1, **options})
        finally:
            time.sleep(0.01 if framing == "rtu" else 0.0)
    def read(address):
        registers = paused(client.read_holding_registers, address, count=2).registers
        return client.convert_from_registers(registers, client.DATATYPE.INT32)
    def words(*values):
        return [word for value in values for word in client.convert_to_registers(value, client.DATATYPE.INT32)]
    def rest():
        while read(0x7E) & 0x2000:
            pass
        time.sleep(0.05)
"""

WORK = """
    found["idle"] = read(0x7E)
    block = words(0, 1, 1000, 2000, 1_000_000, 1_000_000, 1000, 1)
    found["written"] = paused(client.write_registers, 0x58, block).count
    found["moving"] = read(0x7E)
    rest()
    found["missed by"] = read(0xCC) - 1000
    both = dict(read_address=0x5C, read_count=2, write_address=0x5C, values=words(-70000))
    answer = paused(client.readwrite_registers, **both)
    found["written and read"] = client.convert_from_registers(answer.registers, client.DATATYPE.INT32)
    paused(client.write_registers, 0x58, words(0, 1, 100_000, 1000, 1_000_000, 1_000_000, 1000, 1))
    found["stop"] = paused(client.write_register, 0x7D, 0x20).registers
    rest()
    found["stopped"] = read(0xC6) < 10_000
    paused(client.write_register, 0x7D, 0x00)
    paused(client.write_register, 0x7D, 0x10)
    paused(client.write_register, 0x7D, 0x00)
    rest()
    found["home"] = read(0xC6)
    found["echo"] = paused(client.diag_query_data, b"\\x12\\x34").message.hex()
"""

MISTAKES = """
    found["function"] = paused(client.read_coils, 0, count=8).exception_code
    found["address"] = paused(client.read_holding_registers, 0x0500, count=2).exception_code
    found["value"] = paused(client.diag_query_data, b"\\x12\\x34\\x56\\x78").exception_code
    found["range"] = paused(client.write_registers, 0x60, words(0)).exception_code
    found["reason"] = read(0xAC)
    client.comm_params.timeout_connect = 0.3 if framing == "rtu" else 5.0
    try:
        found["foreign unit"] = paused(client.read_holding_registers, 0x7E, count=2, device_id=7).exception_code
    except ModbusException:
        found["foreign unit"] = "silence"
        client.close()
        assert client.connect()
    client.comm_params.timeout_connect = 5.0
    found["own unit"] = read(0x7E)
"""

# Frames are pymodbus'; the port is used by hand, because its client sends none of these.
BY_HAND = """
    import time, serial, struct
    from pymodbus.framer.rtu import FramerRTU
    from pymodbus.framer.socket import FramerSocket
    from pymodbus.pdu import DecodePDU
    port = serial.serial_for_url(where, baudrate=115200)
    READ_STATUS = bytes((3, 0, 0x7E, 0, 2))
"""

LINE = """
    rtu = FramerRTU(DecodePDU(False))
    def request(pdu, unit=1):
        return rtu.encode(pdu, unit, 0)
    def silence(*pieces):
        for piece in pieces:
            port.write(piece)
            time.sleep(0.15)
        port.timeout = 0
        return port.read(1) == b""
    def reply(data, size):
        port.timeout = 5.0
        port.write(data)
        received = port.read(size)
        time.sleep(0.01)
        length, unit, _, pdu = rtu.decode(received)
        return pdu.hex() if (length, unit) == (size, 1) else received.hex()
    status = request(READ_STATUS)
    alarm = request(bytes((3, 0, 0x80, 0, 2)))
    stop = request(bytes((6, 0, 0x7D, 0, 0x20)))
    found["good"] = reply(status, 9)
    found["bad CRC"] = silence(status[:-1] + bytes((status[-1] ^ 1,)))
    found["after bad CRC"] = reply(status, 9)
    found["foreign unit"] = silence(request(READ_STATUS, 7))
    found["broadcast"] = silence(request(bytes((6, 0, 0x7D, 0, 0x20)), 0))
    found["inputs after broadcast"] = reply(request(bytes((3, 0, 0x7C, 0, 2))), 9)
    found["release"] = reply(request(bytes((6, 0, 0x7D, 0, 0))), 8)
    found["torn by a gap"] = silence(stop[:3], stop[3:])
    found["after torn"] = reply(status, 9)
    found["glued"] = silence(status + stop)
    found["after glued"] = reply(status, 9)
    found["garbage in front"] = silence(bytes((1, 3, 0)) + status)
    found["after garbage"] = reply(status, 9)
    found["garbage apart"] = silence(bytes((0xFF, 0x55)))
    found["after garbage apart"] = reply(status, 9)
    found["no alarm"] = reply(alarm, 9)
    found["three lost"] = [silence(b"lost") for _ in range(3)]
    found["alarm"] = reply(alarm, 9)
    for bits in (0x80, 0):
        reply(request(bytes((6, 0, 0x7D, 0, bits))), 8)
    found["reset"] = reply(alarm, 9)
"""

GATEWAY = """
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
    stop, release = bytes((6, 0, 0x7D, 0, 0x20)), bytes((6, 0, 0x7D, 0, 0))
    pdus = (READ_STATUS, stop, READ_STATUS, release, READ_STATUS)
    found["pipelined"] = ask(*((number, 1, pdu) for number, pdu in enumerate(pdus, 1)))
    found["foreign between"] = ask((6, 1, READ_STATUS), (7, 9, READ_STATUS), (8, 1, READ_STATUS))
    found["no address"] = ask((9, 255, READ_STATUS), (10, 0, READ_STATUS))
    port.write(b"GET / HTTP/1.1\\r\\n\\r\\n" + mbap.encode(READ_STATUS, 1, 11))
    port.timeout = 0.1
    found["out of step"] = port.read(1).hex()
    port.close()
    port.open()
    port.timeout = 5.0
    found["called again"] = ask((12, 1, READ_STATUS))
    port.write(b"garbage")
    time.sleep(0.8)
    found["after a pause"] = ask((13, 1, READ_STATUS))
"""

IDLE = "030400004030"


@pytest.mark.parametrize("link", LINKS)
def test_it_reads_writes_and_moves(link):
    with served_zoom(*LINKS[link]) as (drive, where):
        found = run_client(CLIENT + WORK, LINKS[link], where)
        moves = [text for _, text in drive.log]
    assert moves == ["move 1000", "move 100000", "stop", "zhome"]
    assert found["idle"] == 0x4030
    assert found["written"] == 16
    assert found["moving"] & 0x2000
    assert abs(found["missed by"]) <= 1
    assert found["written and read"] == -70000
    assert found["stop"] == [0x20]
    assert found["stopped"]
    assert found["home"] == 0
    assert "1234" in found["echo"]


@pytest.mark.parametrize("link", LINKS)
def test_mistakes(link):
    with served_zoom(*LINKS[link]) as (drive, where):
        found = run_client(CLIENT + MISTAKES, LINKS[link], where)
    assert [found[kind] for kind in ("function", "address", "value", "range")] == [1, 2, 3, 4]
    assert found["reason"] == 0x8C
    assert found["foreign unit"] == (0x0B if link == "Modbus TCP" else "silence")
    assert found["own unit"] == 0x4030
    assert drive.log == []


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_the_slave_keeps_the_manners_of_its_line(transport):
    with served_zoom(transport) as (drive, where):
        found = run_client(BY_HAND + LINE, transport, where)
        log = [text for _, text in drive.log]
    after = {"good", "after bad CRC", "after torn", "after glued", "after garbage", "after garbage apart"}
    assert {kind: found[kind] for kind in after} == dict.fromkeys(after, IDLE)
    silent = {"bad CRC", "foreign unit", "broadcast", "torn by a gap", "glued", "garbage in front", "garbage apart"}
    assert {kind: found[kind] for kind in silent} == dict.fromkeys(silent, True)
    assert found["inputs after broadcast"] == "030400000020"
    assert found["release"] == "06007d0000"
    assert found["three lost"] == [True, True, True]
    assert [found[kind] for kind in ("no alarm", "alarm", "reset")] == ["030400000000", "030400000084", "030400000000"]
    assert log == ["stop", "alarm 84", "alarm reset"]


def test_the_gateway_keeps_the_manners_of_its_network():
    with served_zoom("tcp", "tcp") as (drive, where):
        found = run_client(BY_HAND + GATEWAY, "tcp", where)
        log = [text for _, text in drive.log]
    stopped = "030400004010"
    assert found["pipelined"] == [
        [1, 1, IDLE],
        [2, 1, "06007d0020"],
        [3, 1, stopped],
        [4, 1, "06007d0000"],
        [5, 1, IDLE],
    ]
    assert found["foreign between"] == [[6, 1, IDLE], [7, 9, "830b"], [8, 1, IDLE]]
    assert found["no address"] == [[9, 255, IDLE], [10, 0, IDLE]]
    assert found["out of step"] == ""
    assert found["called again"] == [[12, 1, IDLE]]
    assert found["after a pause"] == [[13, 1, IDLE]]
    assert log == ["stop"]
