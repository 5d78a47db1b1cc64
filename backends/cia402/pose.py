"""From what three drives report at one instant to a sample of the stage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from microdrivers.backends.canopen.synced_pdos import SyncSet
from microdrivers.backends.cia402.drive import Drive
from microdrivers.core.samples import FineStageSample

FAULT_FLAG = "FAULT"

_NO_FLAGS: frozenset[str] = frozenset()
_FAULT_FLAGS = frozenset({FAULT_FLAG})


def pose_sample(
    drives: Sequence[Drive], found: SyncSet, *, targets_um: Mapping[str, float], at_fault: bool, device: str, seq: int
) -> FineStageSample:
    """The pose in µm. The stage is on target when an axis holds one and all that hold one are there.

    Args:
        drives: of x, y and z, with the readings of this set.
        found: the set: when it was taken.
        targets_um: by axis, the last that were commanded; they count as long as the drives hold them.
        at_fault: whether there is a fault that nobody has cleared.
        device: the stage.
        seq: number of the sample.
    """
    places_um, held_um = [], []
    moving, holds, on_target, referenced = False, False, True, True
    for drive in drives:
        watch, reading = drive.watch, drive.reading
        places_um.append(math.nan if reading is None else drive.map.position_um(reading.position))
        moving = moving or watch.moving
        referenced = referenced and drive.referenced
        if watch.target is None:
            held_um.append(math.nan)
        else:
            held_um.append(targets_um[drive.axis])
            holds, on_target = True, on_target and watch.on_target
    return FineStageSample(
        t_ns=found.t_ns,
        dt_ns=found.dt_ns,
        t_source="midpoint",
        device=device,
        seq=seq,
        flags=_FAULT_FLAGS if at_fault else _NO_FLAGS,
        x_um=places_um[0],
        y_um=places_um[1],
        z_um=places_um[2],
        target_x_um=held_um[0],
        target_y_um=held_um[1],
        target_z_um=held_um[2],
        moving=moving,
        on_target=holds and on_target,
        referenced=referenced,
    )
