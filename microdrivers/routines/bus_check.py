"""Is a bus that devices share fit for what they do together: load, losses, and what its controller complains of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.samples import Sample
from microdrivers.devices.base import Device
from microdrivers.devices.force_sensor import STALE
from microdrivers.devices.shared_bus import BusFacts, SharesABus
from microdrivers.routines.camera_check import LEAST_RATE_SHARE
from microdrivers.routines.findings import BusDiagnosis
from microdrivers.routines.stream_check import usual_rate_hz

LOAD_TIME_S = 2.1
"""One whole second, as which a bus' load is measured, lies within it wherever that second begins."""

MOST_LOAD = 0.7
"""Share of its time up to which a bus carries what is sent without frames of low priority waiting for long."""

_LESS = "ask for fewer samples, raise the bit rate of all nodes, or spread the devices over several buses"


def buses_of(devices: Iterable[Device[Any]]) -> Mapping[str, Sequence[Device[Any]]]:
    """The devices by the bus that they share, as far as they do."""
    found: dict[str, list[Device[Any]]] = {}
    for device in devices:
        if isinstance(device, SharesABus):
            found.setdefault(device.bus_facts.name, []).append(device)
    return found


def check_bus(name: str, devices: Sequence[Device[Any]]) -> BusDiagnosis | None:
    """Let all open devices of a bus stream at once, at the rates that they are used with, and look at the bus.

    None if no device is open and the bus has carried nothing, since it could not be opened, which its devices say.
    """
    found = BusDiagnosis(name=name, devices=[device.name for device in devices])
    streaming = [device for device in devices if device.link == "open"]
    if streaming:
        _check_load(streaming, found)
    facts = _facts(devices)
    if not streaming and not any(facts.counters.values()):
        return None
    _check_counters(facts, found)
    return found


def _check_load(devices: Sequence[Device[Any]], found: BusDiagnosis) -> None:
    clock = devices[0].clock
    counts: Counter[str] = Counter()

    def count(device: str, sample: Sample) -> None:
        counts[device] += STALE not in sample.flags

    with ExitStack() as streams:
        for device in devices:
            streams.callback(device.topic.subscribe(partial(count, device.name)).cancel)
            try:
                streams.enter_context(device.stream(usual_rate_hz(device)))
            except MicrodriversError as error:
                found.failed(error, f"streaming {device.name} beside the others")
        clock.sleep(LOAD_TIME_S)
        facts = _facts(devices)
    clock.sleep(0.0)  # an error in a source of the clock comes to light in the next wait
    rates_hz = {device.name: counts[device.name] / LOAD_TIME_S for device in devices}
    found.figures |= {"load": facts.load, "stream_hz": rates_hz}
    slow = [device.name for device in devices if rates_hz[device.name] < LEAST_RATE_SHARE * usual_rate_hz(device)]
    text = ", ".join(f"{device} {rate_hz:.0f}" for device, rate_hz in rates_hz.items())
    too_few = f"; too few of {', '.join(slow)}" if slow else ""
    found.judge(not slow, f"all streaming at once, samples/s: {text}{too_few}", _LESS)
    found.judge(
        facts.load <= MOST_LOAD,
        f"meanwhile this rig's frames load it with {facts.load:.0%} of {facts.bitrate / 1000:g} kbit/s",
        _LESS,
    )


def _check_counters(facts: BusFacts, found: BusDiagnosis) -> None:
    found.figures |= {"bitrate": facts.bitrate, "counters": dict(facts.counters)}
    text = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in facts.counters.items())
    found.judge(
        not any(facts.troubles.values()),
        f"since it was opened: {text}",
        "check that all nodes have this bit rate, the cable and its shield, and 60 Ω between CAN_H and CAN_L",
    )


def _facts(devices: Sequence[Device[Any]]) -> BusFacts:
    """The bus as any of its devices tells of it."""
    device: Any = devices[0]
    facts: BusFacts = device.bus_facts
    return facts
