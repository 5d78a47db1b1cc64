"""What can be refused of an experiment before anything moves."""

from __future__ import annotations

from collections.abc import Mapping

from microdrivers.core.errors import OutOfRange, UnsafeError
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig import Rig
from microdrivers.routines.force.press_settings import PressSettings
from microdrivers.routines.force.way import ProbingWay

_ROUNDING = 1.0 + 1e-6


def check_press(
    rig: Rig, stage: FineStage, sensor: ForceSensor, settings: PressSettings, start_um: Mapping[str, float] | None
) -> None:
    """Refuse what stage, force guard or keep-out boxes forbid, as far as it is known; nothing moves.

    Args:
        rig: with the guard and the boxes.
        stage: carries the sensor.
        sensor: presses.
        settings: of the experiment.
        start_um: where the probe will be before the specimen, in the stage's axes; None if that is not known.

    Raises:
        OutOfRange: the speed is not allowed, or the travel is too short. UnsafeError: a keep-out box is in the way.
    """
    way = ProbingWay(stage, sensor, start_um or {})
    axes_um_s, guard_um_s = way.largest_speed_um_s, rig.safety.max_speed_um_s(sensor.name) / way.path_per_um
    if settings.speed_um_s > _ROUNDING * min(axes_um_s, guard_um_s):
        whose = "its force guard allows (max_speed_um_s)" if guard_um_s < axes_um_s else "its axes allow"
        raise OutOfRange(
            f"the probe at {settings.speed_um_s:g} µm/s would be faster than {whose}: "
            f"{min(axes_um_s, guard_um_s):.4g} µm/s on this way",
            device=stage.name,
            remedy="press more slowly: --speed-um-s; or change the rig file",
        )
    if start_um is None:
        return
    ahead_um, behind_um = way.longest_um(), way.longest_um(back=True)
    approach_um = settings.approach_um(ahead_um)
    if approach_um <= 0.0 or behind_um < settings.free_travel_um:
        raise OutOfRange(
            f"from the probe's place before the specimen the stage's travel goes on for {ahead_um:.0f} µm, of which "
            f"{settings.depth_um:g} µm are to be pressed, and back for {behind_um:.0f} µm, of which "
            f"{settings.free_travel_um:g} µm are needed",
            device=stage.name,
            remedy="choose a place nearer to the middle of the travel (ready_um in the rig file)"
            + (", or press less deeply" if behind_um >= settings.free_travel_um else ""),
        )
    farthest_um = max(approach_um, settings.depth_um)
    require_free(rig, stage, way, -settings.free_travel_um, farthest_um, by_depth=settings.depth_um > approach_um)


def require_free(rig: Rig, stage: FineStage, way: ProbingWay, *places_um: float, by_depth: bool) -> None:
    """Refuse a way, from its start to the first place and on to the others, that a keep-out box blocks.

    Args:
        rig: with the boxes.
        stage: that moves.
        way: its way.
        places_um: on that way.
        by_depth: the last place is so far only because the specimen is to be pressed so deeply.

    Raises:
        UnsafeError: one does.
    """
    try:
        for plan in way.plans(*places_um):
            rig.safety.keep_out.check_way(stage, plan)
    except UnsafeError as error:
        raise UnsafeError(
            f"the way on which the probe looks for the specimen and presses is not free: {error.what}",
            device=stage.name,
            remedy="correct ready_um or the box in the rig file, or use another place"
            + (", or press less deeply" if by_depth else ""),
        ) from error
