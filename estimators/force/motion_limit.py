"""How fast a tool may press on a specimen that has been identified: the purpose of eq. (21) in Bilen et al., II.B."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.model import Array, SpecimenModel

LimitedBy = Literal["force", "static_force", "characterised_speed", "nothing"]


class SpeedLimit(NamedTuple):
    """A largest speed, and what it is that limits it.

    Attributes:
        speed_um_s: while loading; 0 where the springs alone exceed the force, infinite where nothing limits it.
        limited_by: `force` (springs and damper reach it), `static_force` (the springs alone reach it),
            `characterised_speed` (the force would allow more, but the model has not been identified there), `nothing`.
    """

    speed_um_s: float
    limited_by: LimitedBy


def speed_limit(
    model: SpecimenModel,
    *,
    max_force_uN: float,
    depth_um: float,
    stopping_distance_um: float = 0.0,
    beyond_characterised: bool = False,
) -> SpeedLimit:
    """The largest speed of loading at a depth with which the predicted force stays within a bound.

    The tool is taken to keep its speed until the end of the stopping distance: it slows down there, so the bound is on
    the safe side. So it is with the slip of eq. (26), which relieves the specimen and is left out. A specimen that
    pulls inwards by itself (b below zero) is taken as undamped.

    Args:
        model: the identified specimen.
        max_force_uN: the bound, > 0.
        depth_um: compression from the undeformed surface; above it, < 0, the tool is taken to touch at once.
        stopping_distance_um: how far the tool still goes once it is told to stop, ≥ 0.
        beyond_characterised: allow depths and speeds at which the model has not been identified.

    Raises:
        OutOfRange: an argument is not finite or out of its range, or the tool would come deeper than the model was
            identified, unless `beyond_characterised`.
    """
    return _limit(model, max_force_uN, depth_um, depth_um, stopping_distance_um, beyond_characterised)


def stroke_speed_limit(
    model: SpecimenModel,
    *,
    max_force_uN: float,
    from_um: float,
    to_um: float,
    stopping_distance_um: float = 0.0,
    beyond_characterised: bool = False,
) -> SpeedLimit:
    """The largest speed that `speed_limit` allows everywhere between two depths, of which `to_um` is the deeper.

    Raises:
        OutOfRange: as `speed_limit`, or `from_um` is the deeper.
    """
    if from_um > to_um:
        raise OutOfRange(
            f"a stroke from {from_um:g} to {to_um:g} µm does not load", remedy="give the smaller depth first"
        )
    return _limit(model, max_force_uN, from_um, to_um, stopping_distance_um, beyond_characterised)


def largest_speed_um_s(
    model: SpecimenModel, *, max_force_uN: float, depth_um: float, stopping_distance_um: float = 0.0
) -> float:
    """`speed_limit` as a number, µm/s, never beyond the speed at which the model was identified.

    Raises:
        OutOfRange: as `speed_limit`.
    """
    return speed_limit(
        model, max_force_uN=max_force_uN, depth_um=depth_um, stopping_distance_um=stopping_distance_um
    ).speed_um_s


def largest_stroke_speed_um_s(
    model: SpecimenModel,
    *,
    max_force_uN: float,
    from_um: float = 0.0,
    to_um: float,
    stopping_distance_um: float = 0.0,
) -> float:
    """`stroke_speed_limit` as a number, µm/s, never beyond the speed at which the model was identified.

    Raises:
        OutOfRange: as `stroke_speed_limit`.
    """
    return stroke_speed_limit(
        model, max_force_uN=max_force_uN, from_um=from_um, to_um=to_um, stopping_distance_um=stopping_distance_um
    ).speed_um_s


def largest_speeds_um_s(
    model: SpecimenModel, *, max_force_uN: float, depths_um: Array, stopping_distance_um: float = 0.0
) -> Array:
    """`largest_speed_um_s` at several depths: the speeds to slow down along on the way in.

    Raises:
        OutOfRange: as `speed_limit`.
    """
    return np.array(
        [
            largest_speed_um_s(
                model, max_force_uN=max_force_uN, depth_um=depth_um, stopping_distance_um=stopping_distance_um
            )
            for depth_um in np.asarray(depths_um, dtype=np.float64).tolist()
        ]
    )


def _limit(
    model: SpecimenModel, max_force_uN: float, from_um: float, to_um: float, stopping_um: float, beyond: bool
) -> SpeedLimit:
    if not (math.isfinite(max_force_uN) and max_force_uN > 0.0):
        raise OutOfRange(f"a force of {max_force_uN} µN is no bound", remedy="give a positive force in µN")
    if not (math.isfinite(from_um) and math.isfinite(to_um)):
        raise OutOfRange(f"a depth of {from_um}, {to_um} µm is not finite", remedy="give the depth in µm")
    if not (math.isfinite(stopping_um) and stopping_um >= 0.0):
        raise OutOfRange(f"a stopping distance of {stopping_um} µm cannot be", remedy="give it in µm, 0 or more")
    deepest_um = max(to_um + stopping_um, 0.0)
    if deepest_um > model.deepest_um and not beyond:
        raise OutOfRange(
            f"the tool would come {deepest_um:g} µm deep; the specimen is characterised to {model.deepest_um:g} µm",
            remedy="stop earlier, characterise the specimen to that depth, or allow beyond_characterised",
        )
    allowed = math.inf if beyond else model.fastest_um_s
    static_uN = _largest_static_uN(model, max(from_um, 0.0), deepest_um)
    if static_uN >= max_force_uN:
        return SpeedLimit(0.0, "static_force")
    damper = model.b_loading_uN_s_per_um
    speed = (max_force_uN - static_uN) / damper if damper > 0.0 else math.inf
    if speed <= allowed:
        return SpeedLimit(speed, "force" if math.isfinite(speed) else "nothing")
    return SpeedLimit(allowed, "characterised_speed")


def _largest_static_uN(model: SpecimenModel, from_um: float, to_um: float) -> float:
    """Largest force of the springs between two depths: at an end, or where a softening spring turns."""
    k1, k2 = model.k1_uN_per_um, model.k2_uN_per_um3
    depths = [from_um, to_um]
    if k1 * k2 < 0.0:
        turn_um = math.sqrt(-k1 / (3.0 * k2))
        if from_um < turn_um < to_um:
            depths.append(turn_um)
    return max(0.0, *((k1 + k2 * x * x) * x for x in depths))
