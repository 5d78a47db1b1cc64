"""The specimen in its holder, and the probe that can press on it: where they are, and what is felt."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.fakes.world.approach import Approach, Coordinate, Place, Term
from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.embryo import Embryo
from microdrivers.fakes.world.indentation import Indentation, Touch
from microdrivers.fakes.world.mechanics import PRESETS, Contact, Mechanics
from microdrivers.fakes.world.settings import SpecimenWorld

Array = npt.NDArray[np.float64]
Stages = Mapping[str, Mapping[str, Axis]]

_SHARE_OF_WAY = 0.72
"""Of the probe's way from its zero to the end of its travel, until it meets the surface."""

_AHEAD_UM, _SHARE_OF_REST = 60.0, 0.5
"""Of the tip at its place before the specimen, where the rig file states that: the surface, but only up to this share
of the way that is left until the travel ends."""

_REACH_UM = 200.0
_MOST_UPRIGHT = 0.7
_AXES = ("x", "y", "z")


class Tool(NamedTuple):
    """A fine stage whose tool's tip has a known place: `origin_um`, in the rig's frame, with all axes at 0.

    Attributes:
        ways: columns are the directions of its axes in the rig's frame.
        travel_um: rows are the ends of its axes' travel.
    """

    name: str
    origin_um: Array
    ways: Array
    travel_um: Array


class Probe(NamedTuple):
    """A force sensor that can press on a specimen.

    Attributes:
        direction: a unit vector in the rig's frame, into it.
        ready_um: where the tip is before it, in the rig's frame; None if the rig file does not say.
    """

    sensor: str
    tool: Tool
    direction: Array
    stiffness_uN_per_um: float
    ready_um: Array | None


def find_probe(rig: Mapping[str, Any]) -> Probe | None:
    """The sensor that the rig file's section `probe` names, else the first one that could do; None if none can.

    It must be carried by a fine stage with `origin_um`, and push sideways rather than down.
    """
    devices = rig.get("devices", {})
    stated = rig.get("probe") or {}
    named, ready = stated.get("force"), stated.get("ready_um")
    for name, section in devices.items():
        carrier = section.get("carried_by")
        if "range_uN" not in section or named not in (None, name) or carrier not in devices:
            continue
        tool = _tool(carrier, devices[carrier])
        axis = np.array(section.get("axis") or (0.0, 0.0, 1.0), dtype=np.float64)
        length = float(np.linalg.norm(axis))
        if tool is not None and length > 0.0 and abs(axis[2]) < _MOST_UPRIGHT * length:
            ready_um = None if ready is None else tool.origin_um + tool.ways @ np.array(ready, dtype=np.float64)
            stiffness = float(section.get("stiffness_uN_per_um") or math.inf)
            return Probe(name, tool, -axis / length, stiffness, ready_um)
    return None


def find_holder(rig: Mapping[str, Any], probe: Probe) -> Tool | None:
    """The fine stage whose tool's tip (`origin_um`) is behind the specimen, and holds it; None if there is none."""
    surface_um = nominal_surface_um(probe)
    for name, section in rig.get("devices", {}).items():
        tool = _tool(name, section)
        if tool is not None and probe.direction @ (tool.origin_um - surface_um) > 0.0:
            return tool
    return None


def _tool(name: str, section: Mapping[str, Any]) -> Tool | None:
    axes, origin = section.get("axes") or {}, section.get("origin_um")
    if set(axes) != set(_AXES) or origin is None:
        return None
    ways = section.get("axes_in_rig") or {}
    fallback = dict(zip(_AXES, np.eye(3).tolist(), strict=True))
    columns = [ways.get(axis) or fallback[axis] for axis in _AXES]
    travel = [axes[axis].get("travel_um") or (-625.0, 625.0) for axis in _AXES]
    return Tool(name, np.array(origin, dtype=np.float64), np.array(columns, dtype=np.float64).T, np.array(travel))


def draw_mechanics(settings: SpecimenWorld, random: np.random.Generator) -> Mechanics:
    """The preset's figures, those of the world file in their place, spread as it says; the preset is not `none`."""
    stated = {name: getattr(settings, name) for name in Mechanics._fields}
    own = PRESETS[settings.preset]._replace(**{name: value for name, value in stated.items() if value is not None})
    spread = np.exp(settings.spread * random.standard_normal(3))
    damping = float(spread[2])
    return own._replace(
        k1_uN_per_um=own.k1_uN_per_um * float(spread[0]),
        k2_uN_per_um3=own.k2_uN_per_um3 * float(spread[1]),
        b_loading_uN_s_per_um=own.b_loading_uN_s_per_um * damping,
        b_unloading_uN_s_per_um=own.b_unloading_uN_s_per_um * damping,
    )


class Specimen:
    """One specimen before one probe. It is carried by its holder, and remembers how it has been pressed.

    Attributes:
        sensor: the force sensor's name.
        mechanics: its true figures.
        embryo: what it looks like.
        surface_um: where its undeformed surface was at first, in the rig's frame, on the probe's line.

    Args:
        stages: the axes of all fine stages.
        origin_ns: when it is put there.
    """

    def __init__(
        self,
        settings: SpecimenWorld,
        probe: Probe,
        holder: Tool | None,
        stages: Stages,
        *,
        seed: int,
        origin_ns: int,
    ) -> None:
        random = np.random.default_rng((seed, 23))
        self.sensor = probe.sensor
        self.probe = probe
        self.holder = holder
        self.mechanics = draw_mechanics(settings, random)
        place_um = float(random.uniform(-1.0, 1.0)) * settings.place_spread_um
        self.embryo = Embryo(settings, random)
        self.surface_um = nominal_surface_um(probe) + place_um * probe.direction
        self._stages = stages
        aside = np.cross([0.0, 0.0, 1.0], probe.direction)
        aside /= np.linalg.norm(aside)
        self._basis = np.column_stack([probe.direction, aside, np.cross(probe.direction, aside)])
        self._held_um = np.zeros(3)
        self._held_um = self.carried_um(origin_ns)
        self._approach = self._make_approach(probe.tool, holder)
        self._indentation = Indentation(
            Contact(self.mechanics, stiffness_uN_per_um=probe.stiffness_uN_per_um), self._approach, origin_ns=origin_ns
        )

    def touch_at(self, t_ns: int) -> Touch:
        """The contact."""
        return self._indentation.at(t_ns)

    def tip_at(self, t_ns: int, touch: Touch) -> Place:
        """Where the probe's tip is: the stage's place, less what the sensor's spring gives in."""
        place = self._approach.place_at(t_ns)
        return place._replace(along_um=place.along_um - touch.force_uN / self.probe.stiffness_uN_per_um)

    def carried_um(self, t_ns: int) -> Array:
        """How far the holder has carried the specimen, in the rig's frame."""
        return np.zeros(3) if self.holder is None else self._travel_um(self.holder, t_ns) - self._held_um

    def holder_tip_um(self, t_ns: int) -> Array | None:
        """Where the holder's tip is, in the rig's frame."""
        return None if self.holder is None else self.holder.origin_um + self._travel_um(self.holder, t_ns)

    def in_rig(self, places_um: Array, t_ns: int) -> Array:
        """Places seen from the surface (N×3 along, aside, up) in the rig's frame."""
        return np.asarray(places_um @ self._basis.T + self.surface_um + self.carried_um(t_ns))

    def _travel_um(self, tool: Tool, t_ns: int) -> Array:
        axes = self._stages[tool.name]
        return np.asarray(tool.ways @ np.array([axes[axis].position_at(t_ns) for axis in _AXES]))

    def _make_approach(self, tool: Tool, holder: Tool | None) -> Approach:
        origin = (tool.origin_um - self.surface_um + self._held_um) @ self._basis
        parts = [(1.0, tool)] if holder is None else [(1.0, tool), (-1.0, holder)]
        coordinates = []
        for column, start_um in zip(self._basis.T, origin.tolist(), strict=True):
            shares = [
                (self._stages[part.name][axis], sign * float(share))
                for sign, part in parts
                for axis, share in zip(_AXES, column @ part.ways, strict=True)
            ]
            coordinates.append(Coordinate(start_um, tuple(Term(axis, share) for axis, share in shares if share)))
        along, aside, up = coordinates
        return Approach(along, aside, up, self.embryo.radius_um, _REACH_UM)


def nominal_surface_um(probe: Probe) -> Array:
    """Where on the probe's line, in the rig's frame, the surface of a specimen should be."""
    shares = probe.direction @ probe.tool.ways
    leading = int(np.abs(shares).argmax())
    way_um = float((shares[leading] * probe.tool.travel_um[leading]).max())
    if probe.ready_um is None:
        return np.asarray(probe.tool.origin_um + _SHARE_OF_WAY * way_um * probe.direction)
    ready_um = float(probe.direction @ (probe.ready_um - probe.tool.origin_um))
    # With its axes at 0, as after power-on, the tip must not be inside.
    start_um = max(ready_um, 0.0)
    ahead_um = min(_AHEAD_UM, _SHARE_OF_REST * (way_um - start_um))
    return np.asarray(probe.ready_um + (start_um - ready_um + ahead_um) * probe.direction)
