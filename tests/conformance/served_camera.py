"""A bench whose camera is reached over HTTP, in real time, while the truth stays on this side."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from microdrivers.core.samples import OpticsTruth
from microdrivers.devices.camera import Camera
from tests.conformance.bench import CameraBench, served


@contextmanager
def served_camera(seed: int = 3) -> Iterator[tuple[CameraBench, Any]]:
    """The bench, and the server: `unplug()` and `plug_in()` it."""
    middles: dict[int, int] = {}
    with served("pty", "camera_fine", seed=seed) as (rig, serving):
        truth = serving.simulation.world._truth
        truth.subscribe(lambda sample: middles.update({sample.frame_seq: sample.t_ns}))
        assert truth.sample_type is OpticsTruth
        bench = CameraBench(rig.device("camera_fine", Camera), rig.clock, middles.__getitem__)
        yield bench, serving.endpoints["camera_fine"].control
