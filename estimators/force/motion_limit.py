"""How fast a tool may press on a specimen that has been identified: the purpose of eq. (21) in Bilen et al., II.B."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.model import SpecimenModel, check_model

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


def speed_limit(model: SpecimenModel, *, max_force_uN: float, depth_um: float) -> SpeedLimit:
    """The largest speed of pressing down to a depth with which the predicted force stays within a bound all the way.

    The slip of eq. (26), which relieves the specimen, is left out, so that the bound is on the safe side. A specimen
    that pulls inwards by itself (b below zero) is taken as undamped.

    Args:
        model: the identified specimen.
        max_force_uN: the bound, > 0.
        depth_um: compression from the undeformed surface at which the tool comes to rest, its stopping distance
            included; ≤ 0 is a touch.

    Raises:
        OutOfRange: an argument is not finite or out of its range, the model is none (see `check_model`), or it was not
            identified so deep.
    """
    check_model(model)
    if not (math.isfinite(max_force_uN) and max_force_uN > 0.0):
        raise OutOfRange(f"a force of {max_force_uN} µN is not a bound", remedy="give a positive force in µN")
    if not math.isfinite(depth_um):
        raise OutOfRange(f"a depth of {depth_um} µm is not finite", remedy="give the depth in µm")
    depth_um = max(depth_um, 0.0)
    if depth_um > model.deepest_um:
        raise OutOfRange(
            f"the tool would come {depth_um:g} µm deep; the specimen is characterised to {model.deepest_um:g} µm",
            remedy="stop earlier, or characterise the specimen to that depth",
        )
    static_uN = _largest_static_uN(model, depth_um)
    if static_uN >= max_force_uN:
        return SpeedLimit(0.0, "static_force")
    damper = model.b_loading_uN_s_per_um
    speed = (max_force_uN - static_uN) / damper if damper > 0.0 else math.inf
    if speed <= model.fastest_um_s:
        return SpeedLimit(speed, "force" if math.isfinite(speed) else "nothing")
    return SpeedLimit(model.fastest_um_s, "characterised_speed")


def _largest_static_uN(model: SpecimenModel, depth_um: float) -> float:
    """Largest force of the springs down to a depth: there, or where a softening spring turns."""
    k1, k2 = model.k1_uN_per_um, model.k2_uN_per_um3
    depths = [depth_um]
    if k1 * k2 < 0.0:
        turn_um = math.sqrt(-k1 / (3.0 * k2))
        if turn_um < depth_um:
            depths.append(turn_um)
    return max(0.0, *((k1 + k2 * x * x) * x for x in depths))
