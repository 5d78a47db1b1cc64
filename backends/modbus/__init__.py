"""A Modbus master over serial lines (RTU) and TCP, on the rig's clock; see docs/decisions/0011."""
