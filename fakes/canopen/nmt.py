"""Network management: the states of a node, and the commands that change them (CiA 301, 7.2.8)."""

from __future__ import annotations

from enum import IntEnum

RESET_NODE, RESET_COMMUNICATION = 0x81, 0x82


class NmtState(IntEnum):
    """The states, as a heartbeat tells them."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


COMMANDED_STATES = {0x01: NmtState.OPERATIONAL, 0x02: NmtState.STOPPED, 0x80: NmtState.PRE_OPERATIONAL}
