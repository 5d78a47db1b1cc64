"""Boxes that no tool's tip may enter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from microdrivers.core.errors import UnsafeError
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.motion_plan import MotionPlan
from microdrivers.rig.safety_geometry import (
    Point,
    deepens,
    depth_um,
    distance_um,
    entry_of,
    sweep_meets,
    ways_to_faces_um,
)
from microdrivers.rig.safety_section import KeepOutBox

MARGIN_UM = 5.0
"""How far a coordinated move may leave the straight line, lost motion and noise of the encoders included."""

_CLEAR_UM = 2 * MARGIN_UM
"""How far beyond a face a way out ends that is named to somebody."""

_RETRACT = "retract() takes the tool away and is always allowed"


class KeepOut:
    """The keep-out boxes of a rig, for all fine stages.

    What is checked is the tip, `FineStage.tip_um`, and nothing else of the tool: a box has to be larger by what
    protrudes. A straight move is checked along its line, any other one with all that its axes may pass through. Boxes
    are kept at a distance of `MARGIN_UM`; a tip that is nearer already, after a search for references for instance,
    may not come nearer still. A search for references goes to unknown places and is not checked. A tip that it has left
    inside a box may leave on a straight way that gets nowhere deeper into a box than it begins, and ends less deep in
    one of those that it begins in.
    """

    def __init__(self, boxes: Sequence[KeepOutBox]) -> None:
        self._boxes = tuple(boxes)

    def __bool__(self) -> bool:
        return bool(self._boxes)

    def check(self, stage: FineStage, plan: MotionPlan) -> None:
        """Let pass what enters no box.

        Raises:
            UnsafeError: the way leads into a box, or where the tip is, is not known.
        """
        if not self._boxes or plan.kind != "move":
            return
        unknown = [axis for axis, known in stage.referenced.items() if not known]
        if unknown:
            unknown.sort(key=stage.reference_order.index)
            raise UnsafeError(
                f"axis {', '.join(unknown)} is not referenced, so it is not known whether the tool would enter a "
                "keep-out box",
                remedy=f"make sure that the way is free, then reference({unknown!r})",
            )
        self.check_way(stage, plan)

    def check_way(self, stage: FineStage, plan: MotionPlan) -> None:
        """As `check`, for a way whose start is known, whether or not the stage has been there.

        Raises:
            UnsafeError: the way leads into a box.
        """
        start = stage.tip_um(plan.start)
        if plan.straight:
            self._check_begin(stage, plan)
        for box in self._boxes:
            low, high = self._kept(box, start)
            if plan.straight:
                self._check_line(stage, plan, box, low, high)
            elif sweep_meets(*_swept(stage, plan), low, high):
                raise UnsafeError(
                    f"the stage does not start from rest, so the tip may pass through all of {_intervals(plan)}, which "
                    f"meets the keep-out box {box.name!r} ({_extent(box)})",
                    remedy=f"wait until the move under way has ended: from rest the way is straight; {_RETRACT}",
                )

    def free_share(self, stage: FineStage, plan: MotionPlan) -> float:
        """How much of a straight way is free; all of it if it begins in a box, since it leads out."""
        start, end = stage.tip_um(plan.start), stage.tip_um(plan.end)
        entries = (entry_of(start, end, *self._kept(box, start)) for box in self._boxes)
        return min((entry.share for entry in entries if entry is not None and entry.face), default=1.0)

    def reachable(self, stage: FineStage) -> list[str]:
        """Names of the boxes that the tip can reach within the stage's travel."""
        travel = MotionPlan(
            kind="move", start={}, targets={}, straight=False, sweep={axis: stage.limits[axis] for axis in stage.axes}
        )
        corner, edges = _swept(stage, travel)
        return [box.name for box in self._boxes if sweep_meets(corner, edges, box.min_um, box.max_um)]

    def trapped(self, stage: FineStage, position_um: Mapping[str, float]) -> UnsafeError | None:
        """What is to be said of a tip that is inside a box when the axes are at this position; None if it is not."""
        tip = stage.tip_um(position_um)
        box = next(iter(self._around(tip)), None)
        if box is None:
            return None
        return UnsafeError(
            f"the tip is in the keep-out box {box.name!r}, at {_written(tip)} µm in the rig's frame ({_extent(box)})",
            device=stage.name,
            remedy=self._remedy(stage, position_um, box),
        )

    def _around(self, tip: Point) -> list[KeepOutBox]:
        return [box for box in self._boxes if depth_um(tip, box.min_um, box.max_um) > 0.0]

    def _check_begin(self, stage: FineStage, plan: MotionPlan) -> None:
        """Let a way that begins inside boxes pass if it leads out."""
        start, end = stage.tip_um(plan.start), stage.tip_um(plan.end)
        around = self._around(start)
        if not around or self._leads_out(start, end):
            return
        box = around[0]
        raise UnsafeError(
            f"the tip is in the keep-out box {box.name!r} already, at {_written(start)} µm in the rig's frame "
            f"({_extent(box)}), and this way does not lead out of it",
            remedy=self._remedy(stage, plan.start, box),
        )

    def _leads_out(self, start: Point, end: Point) -> bool:
        around = [(box.min_um, box.max_um) for box in self._around(start)]
        return not any(deepens(start, end, *each) for each in around) and any(
            max(0.0, depth_um(end, *each)) < depth_um(start, *each) for each in around
        )

    def _remedy(self, stage: FineStage, position_um: Mapping[str, float], box: KeepOutBox) -> str:
        """How to get out of a box, through the nearest face that can be reached on a way that is let through."""
        correct = f"correct the box, or origin_um of {stage.name}, in the rig file"
        start = stage.tip_um(position_um)
        for face, way_um in sorted(ways_to_faces_um(start, box.min_um, box.max_um).items(), key=lambda each: each[1]):
            signed_um = (way_um + _CLEAR_UM) * (1.0 if face[0] == "+" else -1.0)
            shares = {axis: stage.axes_in_rig[axis]["xyz".index(face[1])] for axis in stage.axis_names}
            shifts = {axis: round(signed_um * share, 1) for axis, share in shares.items()}
            targets = {axis: position_um[axis] + shift for axis, shift in shifts.items()}
            if any(targets[axis] not in stage.limits[axis] for axis in targets if shifts[axis]):
                continue
            end = stage.tip_um(targets)
            blocked = any(entry_of(start, end, *self._kept(other, start)) for other in self._boxes if other is not box)
            if self._leads_out(start, end) and not self._around(end) and not blocked:
                asked = ", ".join(f"d{axis}_um={shift:g}" for axis, shift in shifts.items() if shift)
                return f"move_by({asked}) leads out through its {face} face; {_RETRACT}; or {correct}"
        return f"{_RETRACT}; or {correct}"

    def _check_line(self, stage: FineStage, plan: MotionPlan, box: KeepOutBox, low: Point, high: Point) -> None:
        start = stage.tip_um(plan.start)
        entry = entry_of(start, stage.tip_um(plan.end), low, high)
        if entry is None or not entry.face:
            return  # what begins inside has been judged
        raise UnsafeError(
            f"the tip would come too near to the keep-out box {box.name!r} or enter it through its {entry.face} face, "
            f"after {entry.share:.0%} of the way at {_written(entry.point_um)} µm in the rig's frame ({_extent(box)}, "
            f"kept at {MARGIN_UM:g} µm)",
            remedy="go round it in several moves, each of which is checked along its straight line",
        )

    def _kept(self, box: KeepOutBox, tip: Point) -> tuple[Point, Point]:
        """The box with its margin, or with as much of it as the tip leaves."""
        margin = min(MARGIN_UM, max(0.0, distance_um(tip, box.min_um, box.max_um) - 1e-6))
        (a, b, c), (d, e, f) = box.min_um, box.max_um
        return (a - margin, b - margin, c - margin), (d + margin, e + margin, f + margin)


def _swept(stage: FineStage, plan: MotionPlan) -> tuple[Point, list[Point]]:
    """One corner of what the axes may pass through, and the edges from it, in the rig's frame."""
    corner = stage.tip_um({axis: plan.sweep[axis].min for axis in stage.axis_names})
    edges = []
    for axis in stage.axis_names:
        length = plan.sweep[axis].max - plan.sweep[axis].min
        dx, dy, dz = stage.axes_in_rig[axis]
        edges.append((length * dx, length * dy, length * dz))
    return corner, edges


def _intervals(plan: MotionPlan) -> str:
    return ", ".join(f"{axis} {_span(limits)} µm" for axis, limits in plan.sweep.items())


def _span(limits: Sequence[float]) -> str:
    return f"{limits[0]:.1f} to {limits[1]:.1f}"


def _extent(box: KeepOutBox) -> str:
    sides: Mapping[str, tuple[float, float]] = {
        axis: (a, b) for axis, a, b in zip("xyz", box.min_um, box.max_um, strict=True)
    }
    return ", ".join(f"{axis} {_span(span)}" for axis, span in sides.items())


def _written(point: Point) -> str:
    return f"({', '.join(f'{value:.1f}' for value in point)})"
