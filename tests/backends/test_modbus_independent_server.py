"""The master against an independent server: pymodbus' own, over TCP, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.modbus.master import ModbusMaster, ModbusRefusal, framing_of
from microdrivers.backends.modbus.settings import ModbusConnection
from microdrivers.backends.oriental_az.link import az_timing
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import LinkLost

pytestmark = pytest.mark.xdist_group("real_time")

SERVER = """
    import asyncio, sys
    from pymodbus import FramerType
    from pymodbus.server import ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    async def serve():
        registers = SimData(0, count=256, values=0, datatype=DataType.REGISTERS)
        framer = FramerType.RTU if sys.argv[1] == "rtu" else FramerType.SOCKET
        server = ModbusTcpServer(SimDevice(1, [registers]), framer=framer, address=("127.0.0.1", 0))
        await server.serve_forever(background=True)
        print(server.transport.sockets[0].getsockname()[1], flush=True)
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)

    asyncio.run(serve())
"""


@contextmanager
def served(framing: str) -> Iterator[tuple[subprocess.Popen[str], ModbusMaster]]:
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(SERVER), framing]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        port = int(server.stdout.readline())
        values = {"port": f"socket://127.0.0.1:{port}", "framing": framing, "timeout_s": 2.0}
        connection = ModbusConnection.model_validate(values)
        framed = framing_of(connection, az_timing(connection.baudrate))
        clock = SystemClock()
        line = SerialLine(connection, clock=clock, gap_s=framed.gap_s)
        line.open()
        yield server, ModbusMaster(line, framed, unit_id=1, silence_remedy="")
        line.close()
        clock.close()
        server.kill()


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
def test_reads_writes_refusals_and_a_post(framing: str) -> None:
    with served(framing) as (server, modbus):
        modbus.write_block(0x58, [0, 1, 0xFFFF, 0xFFFE])
        assert modbus.read(0x58, 4).values == (0, 1, 0xFFFF, 0xFFFE)
        modbus.write(0x59, 0x1234)
        for posted in ((0x5678,), (7, 8)):
            modbus.post(0x5A, posted)
            assert modbus.read(0x59, 3).values[: 1 + len(posted)] == (0x1234, *posted)
        with pytest.raises(ModbusRefusal, match="exception 02"):
            modbus.read(0x0500, 2)
        server.kill()
        server.wait(10)
        with pytest.raises(LinkLost):
            modbus.read(0x58, 2)
