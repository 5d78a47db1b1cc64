"""Alarms of the drive, in plain words, and what to do about each (Oriental Motor HP-5142E, "Alarms list")."""

from __future__ import annotations

from typing import NamedTuple

from microdrivers.core.errors import DeviceFault, Moved

HOMING_INCOMPLETE = 0x4A
COMMUNICATION_TIMEOUT = 0x85


class Alarm(NamedTuple):
    """One alarm. `resettable` is false where only switching the drive off and on clears it."""

    text: str
    remedy: str
    resettable: bool = True


_WIRING = "switch the drive off and check motor, cable and connectors"
_LOAD = "reduce the load, or the speed and acceleration in the rig file; check that the zoom ring turns freely"

ALARMS: dict[int, Alarm] = {
    0x10: Alarm("position deviation: the motor did not follow its command", _LOAD),
    0x20: Alarm("overcurrent", _WIRING, resettable=False),
    0x21: Alarm("the drive is too hot", "improve its ventilation"),
    0x22: Alarm("overvoltage", "check the supply; reduce the load or the acceleration"),
    0x25: Alarm("undervoltage", "check the main supply"),
    0x26: Alarm("the motor is too hot", "let it cool; reduce load or current"),
    0x28: Alarm("encoder error", _WIRING, resettable=False),
    0x29: Alarm("internal circuit error", "have the drive repaired", resettable=False),
    0x2A: Alarm("no communication with the encoder", _WIRING, resettable=False),
    0x30: Alarm("overload", _LOAD),
    0x31: Alarm("overspeed", _LOAD),
    0x41: Alarm("the drive's stored data is damaged", "initialise its parameters", resettable=False),
    0x42: Alarm("encoder error at power-on", _WIRING, resettable=False),
    0x44: Alarm("the encoder's stored data is damaged", _WIRING, resettable=False),
    0x45: Alarm("the motor does not belong to this drive", "check both model names", resettable=False),
    HOMING_INCOMPLETE: Alarm(
        "homing incomplete: the drive's coordinates are not established",
        "bring the zoom to its zero mark and set the home position there once (P-PRESET, or homing with the maker's "
        "software)",
    ),
    0x60: Alarm("both limit sensors are active", "check the sensors' wiring and logic"),
    0x61: Alarm("the limit sensors are swapped", "check the sensors' wiring"),
    0x62: Alarm("homing error", "check the load and where the sensors sit"),
    0x63: Alarm("no home sensor between the limits", "place the home sensor between the limit sensors"),
    0x66: Alarm("a limit sensor was reached", "turn the motor off the sensor; check curve and zoom_range"),
    0x67: Alarm("a software limit was reached", "compare curve and zoom_range with the drive's limits"),
    0x70: Alarm("operation data error", "check speed, acceleration, current and curve in the rig file"),
    0x81: Alarm("network bus error", "check the network module and its supply"),
    0x84: Alarm(
        "too many bad frames on RS-485, one after the other",
        "check wiring, termination, baud rate and parity, and that no other master speaks on the line",
    ),
    COMMUNICATION_TIMEOUT: Alarm(
        "the drive heard nothing from the host for longer than its communication time-out",
        "find out whether the host was stopped or suspended, or the cable pulled; if it was only slow, lengthen "
        "communication_timeout_s in the rig file",
    ),
    0xF0: Alarm("processor error", "have the drive repaired if it comes back", resettable=False),
    0xF3: Alarm("processor overload", "switch off extended functions of the drive", resettable=False),
}  # fmt: skip


def alarm_fault(code: int, *, moved: Moved, during: str = "", communication_timeout_s: float = 0.0) -> DeviceFault:
    """The error for an alarm that is on; `during` begins the sentence.

    `communication_timeout_s` is the drive's, if it has one.
    """
    alarm = ALARMS.get(code, Alarm("unknown to this driver", "look it up in the drive's manual"))
    then = "clear_fault()" if alarm.resettable else "switch the drive off and on, and open the rig again"
    text = alarm.text
    if code == COMMUNICATION_TIMEOUT and communication_timeout_s:
        text += f" ({communication_timeout_s:g} s)"
    return DeviceFault(
        f"{during}alarm {code:02X}h is on: {text}",
        code=code, text=text, remedy=f"{alarm.remedy}; then {then}", moved=moved,
    )  # fmt: skip
