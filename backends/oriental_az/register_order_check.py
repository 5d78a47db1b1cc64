"""Does the drive put 32-bit values into registers as the rig file says?

Parameter 1384h, "Byte & word order (Modbus)", holds 0 to 3 and is itself such a value: the place of its one byte that
is not zero tells the order in use (Oriental Motor HP-5142E, "Setting of RS-485 communication").
"""

from __future__ import annotations

import logging

from microdrivers.backends.modbus.master import ModbusMaster, ModbusRefusal
from microdrivers.backends.modbus.register_order import RegisterOrder
from microdrivers.core.errors import ConfigError, UnsupportedError

BYTE_AND_WORD_ORDER = 0x1384

ORDERS = (
    RegisterOrder("high-first", "big"),
    RegisterOrder("low-first", "big"),
    RegisterOrder("high-first", "little"),
    RegisterOrder("low-first", "little"),
)
"""By value of the parameter."""

_SLAVE_ERROR = 4
_REMEDY = "check connection and unit_id in the rig file"

_log = logging.getLogger(__name__)


def check_register_order(modbus: ModbusMaster, order: RegisterOrder, *, name: str) -> None:
    """Compare the rig file's order with the drive's, as far as the drive tells.

    A drive whose parameter was changed to 0 and that was not switched off since says 0 and still uses the old order;
    that cannot be seen.

    Raises:
        ConfigError: they differ.
        UnsupportedError: what answers is no AZ drive.
        LinkError: there is no sound answer.
    """
    try:
        registers = modbus.read(BYTE_AND_WORD_ORDER, 2).values
    except ModbusRefusal as refusal:
        if refusal.exception_code == _SLAVE_ERROR:
            raise
        raise UnsupportedError(f"this is no AZ drive: {refusal.what}", remedy=_REMEDY) from refusal
    possible = [known for known in ORDERS if known.from_registers(*registers) in range(len(ORDERS))]
    if not possible:
        raise UnsupportedError(
            f"this is no AZ drive: where that has its byte & word order, 0 to 3, there is {registers[0]:04X}h "
            f"{registers[1]:04X}h (register {BYTE_AND_WORD_ORDER:04X}h)",
            remedy=_REMEDY,
        )
    in_use = possible[0]
    stored = in_use.from_registers(*registers)
    if in_use != order:
        raise ConfigError(
            f"the drive has {_words(in_use)} (parameter {BYTE_AND_WORD_ORDER:04X}h is {stored}), the rig file has "
            f"{_words(order)}",
            key=f"{name}.word_order",
            remedy=f"write {_words(in_use)} into the rig file, or set the drive's parameter to {ORDERS.index(order)} "
            "and switch it off and on",
        )
    if ORDERS[stored] != in_use:
        _log.warning("%s: when the drive is next switched off and on, it will have %s", name, _words(ORDERS[stored]))


def _words(order: RegisterOrder) -> str:
    return f"word_order: {order.words} and byte_order: {order.bytes}"
