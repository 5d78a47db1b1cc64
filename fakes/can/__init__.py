"""An emulated CAN bus: frames that take their time, nodes on one side and hosts' ports on the other.

python-can opens it as `can.Bus(interface="microdrivers", channel=NAME)`; `serve_medium` puts it on an adapter's serial
port or on a SocketCAN interface. Nothing here imports python-can before it is needed.
"""

from microdrivers.fakes.can.arrival import Arrival
from microdrivers.fakes.can.frame import Due, Frame, frame_bits
from microdrivers.fakes.can.medium import BITRATES, Medium, Temper
from microdrivers.fakes.can.port import Port, PortError
from microdrivers.fakes.can.registry import forget_medium, medium_named, shared_medium
from microdrivers.fakes.can.serving import serve_medium
from microdrivers.fakes.can.slcan import SlcanAdapter
from microdrivers.fakes.can.timeline import NEVER_NS, CanNode

__all__ = [
    "BITRATES",
    "NEVER_NS",
    "Arrival",
    "CanNode",
    "Due",
    "Frame",
    "Medium",
    "Port",
    "PortError",
    "SlcanAdapter",
    "Temper",
    "forget_medium",
    "frame_bits",
    "medium_named",
    "serve_medium",
    "shared_medium",
]
