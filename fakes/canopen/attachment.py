"""Puts emulated nodes on the bus that a rig file names; devices with the same interface and channel share it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import pydantic

from microdrivers.devices.drivers import Emulation, EmulationRequest, Endpoint, ServeRequest
from microdrivers.fakes.can import Medium, forget_medium, shared_medium
from microdrivers.fakes.canopen.node import CanOpenNode

SettingsT = TypeVar("SettingsT", bound=pydantic.BaseModel)

SERVED_TIMEOUT_S = 1.0
"""How long a host has to wait for a served emulator: it runs as a program among others, in Python."""


class Connection(pydantic.BaseModel, extra="ignore", frozen=True):
    """The bus as the rig file names it."""

    interface: str
    channel: str | int
    bitrate: int = 500_000
    timeout_s: float = 0.3

    @property
    def medium_name(self) -> str:
        """How the emulated bus is called."""
        return f"{self.interface}:{self.channel}"


@dataclass(frozen=True, kw_only=True)
class NodeEmulation(Emulation):
    """A running emulator of CANopen nodes.

    Attributes:
        medium: the bus that they are on.
        devices: what lies behind the nodes, to look behind the scenes and to disturb: a drive per axis, an amplifier.
    """

    medium: Medium
    devices: Mapping[str, Any] = field(default_factory=dict)


def attach_nodes(
    request: EmulationRequest,
    connection: Connection,
    nodes: Sequence[CanOpenNode],
    devices: Mapping[str, Any],
    *,
    served: Mapping[str, Any] | None = None,
) -> NodeEmulation:
    """Switch the nodes on; `served` are further settings that hold where they are served.

    Raises:
        ConfigError: the bus has another bit rate already. OutOfRange: there is no such bit rate.
    """
    name = connection.medium_name
    medium = shared_medium(name, clock=request.clock, bitrate=connection.bitrate, seed=request.seed)
    attached = list(nodes)
    for node in nodes:
        node.settle_in(medium.lock, medium.refresh)
        medium.attach(node)

    def close() -> None:
        if not attached:
            return
        while attached:
            medium.detach(attached.pop())
        forget_medium(name, medium)

    def serve(where: ServeRequest) -> Endpoint:
        from microdrivers.fakes.can.serving import serve_medium

        endpoint = serve_medium(request.name, medium, where)
        patient = {"timeout_s": max(connection.timeout_s, SERVED_TIMEOUT_S)}
        connected = {"connection": {**endpoint.overrides["connection"], **patient}}
        return replace(endpoint, overrides={**(served or {}), **connected})

    return NodeEmulation(
        overrides={"connection": {"interface": "microdrivers", "channel": name}},
        close=close,
        serve=serve,
        medium=medium,
        devices=devices,
    )
