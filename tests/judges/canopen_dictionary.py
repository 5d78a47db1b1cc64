"""An object dictionary of a positioning drive for the `canopen` library, as an EDS file would give it."""

from __future__ import annotations

import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

_U8, _U16, _U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
_I8, _I16, _I32 = datatypes.INTEGER8, datatypes.INTEGER16, datatypes.INTEGER32
_TEXT = datatypes.VISIBLE_STRING

_VARIABLES = {
    0x1000: _U32, 0x1001: _U8, 0x1008: _TEXT, 0x1017: _U16, 0x2000: _TEXT,
    0x603F: _U16, 0x6040: _U16, 0x6041: _U16, 0x605A: _I16, 0x605D: _I16, 0x6060: _I8, 0x6061: _I8, 0x6064: _I32,
    0x6067: _U32, 0x606C: _I32, 0x607A: _I32, 0x607C: _I32, 0x6081: _U32, 0x6083: _U32, 0x6098: _I8, 0x60F4: _I32,
    0x6502: _U32, 0x5FFF: _U32,
}  # fmt: skip
_ARRAYS = {0x1016: _U32, 0x607D: _I32, 0x6099: _U32}


def drive_dictionary() -> canopen.ObjectDictionary:
    """With two transmit and two receive PDOs."""
    dictionary = canopen.ObjectDictionary()
    for index, kind in _VARIABLES.items():
        dictionary.add_object(_variable(f"{index:04X}", index, 0, kind))
    for index, kind in _ARRAYS.items():
        array = ODArray(f"{index:04X}", index)
        array.add_member(_variable("count", index, 0, _U8))
        array.add_member(_variable("value", index, 1, kind))
        dictionary.add_object(array)
    for number in range(2):
        for base in (0x1400, 0x1800):
            record = ODRecord(f"{base + number:04X}", base + number)
            for sub, kind in ((0, _U8), (1, _U32), (2, _U8)) + (((3, _U16), (5, _U16)) if base == 0x1800 else ()):
                record.add_member(_variable(f"sub{sub}", base + number, sub, kind))
            dictionary.add_object(record)
            mapping = ODRecord(f"{base + 0x200 + number:04X}", base + 0x200 + number)
            for sub in range(9):
                mapping.add_member(_variable(f"sub{sub}", base + 0x200 + number, sub, _U32 if sub else _U8))
            dictionary.add_object(mapping)
    return dictionary


def _variable(name: str, index: int, sub: int, kind: int) -> ODVariable:
    variable = ODVariable(name, index, sub)
    variable.data_type = kind
    return variable
