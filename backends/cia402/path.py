"""A straight way in several axes, from drives that know only their own."""

from __future__ import annotations

import math
from collections.abc import Mapping

from microdrivers.backends.cia402.drive import Drive


def write_path(
    drives: Mapping[str, Drive], targets: Mapping[str, float], speeds: Mapping[str, float]
) -> dict[str, int]:
    """Tell each drive where to go and how; returns the targets in counts. Nothing moves yet.

    From rest, speeds (µm/s) and accelerations share one ratio, so that all axes start, cruise and arrive together:
    their profiles are one profile at different scales. Speeds are whole counts/s, which bends a path by half a count
    for each second that it takes. Axes that are still moving come from another path: each brakes and goes on as fast
    as it may, since one that has but a little way to go could not brake with its share.

    Raises:
        SdoAbort: a drive refuses a value. LinkError: see `SdoClient`.
    """
    limits = {axis: drives[axis].map.spec for axis in targets}
    if any(drives[axis].watch.moving for axis in targets):
        path_speed = math.hypot(*speeds.values())
        speeds = {axis: min(path_speed, spec.max_speed) for axis, spec in limits.items()}
        accelerations = {axis: spec.acceleration for axis, spec in limits.items()}
    else:
        rise_s = max(speeds[axis] / spec.acceleration for axis, spec in limits.items())
        accelerations = {axis: speeds[axis] / rise_s for axis in targets}
    counts = {}
    for axis, target in targets.items():
        drive = drives[axis]
        counts[axis] = drive.map.counts(target)
        velocity, acceleration = drive.rates(
            target=counts[axis], speed_um_s=speeds[axis], acceleration_um_s2=accelerations[axis]
        )
        drive.write_profile(target=counts[axis], velocity=velocity, acceleration=acceleration)
    return counts
