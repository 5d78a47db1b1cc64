"""The tools on fine stages: where each tip is, what it touches, and what its sensor feels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.settings import ToolsWorld

_AXES = ("x", "y", "z")
_DEFAULT_TRAVEL_UM = (-625.0, 625.0)
_DEFAULT_DIRECTION = (0.0, 0.0, 1.0)
_HOLDER_SHARE = 0.04
"""What holds a specimen stands nearer the middle of its travel by this factor: there it has been loaded."""


class Tools:
    """Fine stages and force sensors of a rig file; see `ToolsWorld` for what is around them.

    A section with axes x, y and z is a fine stage, one with `range_uN` a force sensor; `carried_by` names the stage
    that it sits on. A tool that goes down too far presses on the obstacle, which pushes it up, a linear spring without
    adhesion: the obstacle and the sensor's own spring in series. The sensor feels its axis' share of that push.

    Args:
        holder: the stage whose tool holds a specimen, if one does.

    Attributes:
        axes: of each fine stage, by its name and x, y, z; stage coordinates, µm.
        home_um: where the home switches are.
        power_on_offset_um: what the encoders show beyond the truth before they are referenced.
    """

    def __init__(self, devices: Mapping[str, Any], world: ToolsWorld, *, seed: int, holder: str = "") -> None:
        self._world = world
        self._holder = holder
        self._sensors = {name: section for name, section in devices.items() if "range_uN" in section}
        self.axes: dict[str, dict[str, Axis]] = {}
        self.home_um: dict[str, dict[str, float]] = {}
        self.power_on_offset_um: dict[str, dict[str, float]] = {}
        random = np.random.default_rng((seed, 11))
        for name, section in devices.items():
            if set(section.get("axes") or {}) == set(_AXES):
                self._place(name, section, random)

    def _place(self, name: str, section: Mapping[str, Any], random: np.random.Generator) -> None:
        start, home = {}, {}
        for axis in _AXES:
            low, high = section["axes"][axis].get("travel_um", _DEFAULT_TRAVEL_UM)
            home[axis] = low
            start[axis] = float(random.uniform(low + 0.4 * (high - low), low + 0.6 * (high - low)))
            if name == self._holder:
                middle = 0.5 * (low + high)
                start[axis] = middle + _HOLDER_SHARE * (start[axis] - middle)
        lag_s = self._world.servo_lag_ms / 1000.0
        self.axes[name] = {axis: Axis(start[axis], lag_s=lag_s) for axis in _AXES}
        self.home_um[name] = home
        # An incremental encoder counts from where it was switched on.
        self.power_on_offset_um[name] = {axis: -start[axis] for axis in _AXES}

    def force_uN(self, sensor: str, t_ns: int) -> float:
        """True force along a sensor's axis, positive if its tip is pushed that way."""
        section = self._sensors.get(sensor, {})
        stage = section.get("carried_by")
        share = float(section.get("axis", _DEFAULT_DIRECTION)[2])
        if stage not in self.axes or share == 0.0:
            return 0.0
        depth_um = -self.axes[stage]["z"].position_at(t_ns) - self._world.obstacle_um
        own = float(section.get("stiffness_uN_per_um") or math.inf)
        series = 1.0 / (1.0 / self._world.obstacle_stiffness_uN_per_um + 1.0 / own)
        return share * series * max(0.0, depth_um)
