"""The Modbus side of emulated devices, whatever they are: an RTU slave, and a TCP gateway in front of one."""

from microdrivers.fakes.modbus.attachment import SlaveLine, attach_slave
from microdrivers.fakes.modbus.functions import (
    Function,
    ModbusException,
    diagnose,
    read_registers,
    read_write_registers,
    write_register,
    write_registers,
)
from microdrivers.fakes.modbus.gateway import TcpGateway
from microdrivers.fakes.modbus.rtu import ModbusDevice, RtuSlave, SlaveTiming, crc16, frame

__all__ = [
    "Function",
    "ModbusDevice",
    "ModbusException",
    "RtuSlave",
    "SlaveLine",
    "SlaveTiming",
    "TcpGateway",
    "attach_slave",
    "crc16",
    "diagnose",
    "frame",
    "read_registers",
    "read_write_registers",
    "write_register",
    "write_registers",
]
