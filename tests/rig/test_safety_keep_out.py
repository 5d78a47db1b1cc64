"""Keep-out boxes: nothing that is let through enters one, judged by brute force; and what the rig does about them."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import NotReferenced, UnsafeError
from microdrivers.core.units import Range
from microdrivers.devices.motion_plan import MotionPlan
from microdrivers.rig.safety_geometry import deepens, distance_um, entry_of, sweep_meets
from microdrivers.rig.safety_keep_out import MARGIN_UM, KeepOut
from microdrivers.rig.safety_section import KeepOutBox
from tests.rig.guarded_rig import STAGE, guarded_rig

AXES = ("x", "y", "z")
coordinate = st.integers(-800, 800).map(lambda eighths: eighths / 8)  # exact, so that touching is touching
point = st.tuples(coordinate, coordinate, coordinate)


@st.composite
def boxes(draw):
    low = np.array(draw(point))
    size = np.array(draw(st.tuples(*[st.integers(8, 640).map(lambda eighths: eighths / 8)] * 3)))
    return tuple(low.tolist()), tuple((low + size).tolist())


def depth_um(places, low, high):
    """How deep in the box each place is, to its nearest face; negative outside."""
    return np.min(np.minimum(places - np.array(low), np.array(high) - places), axis=-1)


# ---------------------------------------------------------------------- geometry


@settings(max_examples=100)
@given(point, point, boxes())
def test_a_straight_way_enters_a_box_where_sampling_finds_it_inside(start, end, box):
    shares = np.linspace(0.0, 1.0, 501)
    ways = np.array(start) + shares[:, None] * (np.array(end) - np.array(start))
    depths = depth_um(ways, *box)
    entry = entry_of(start, end, *box)
    step_um = math.dist(start, end) / 500
    if entry is None:
        assert depths.max() <= 1e-6
        return
    assert depths.max() > -step_um
    inside = shares[depths > 1e-9]
    if inside.size:
        assert inside[0] - 1.1 / 500 <= entry.share <= inside[0] + 1e-9
    assert entry.point_um == pytest.approx(np.array(start) + entry.share * (np.array(end) - np.array(start)), abs=1e-6)
    assert bool(entry.face) == (depth_um(np.array(start), *box) <= 0.0)
    if entry.face:
        axis = "xyz".index(entry.face[1])
        assert entry.point_um[axis] == pytest.approx(box[entry.face[0] == "+"][axis], abs=1e-6)


@pytest.mark.parametrize(
    ("start", "end", "enters"),
    [
        ((0, 0, 10), (20, 0, 10), False),  # along the surface
        ((0, 0, 10), (0, 0, 20), False),  # away from it
        ((0, 0, 10), (0, 0, 9), True),
        ((0, 0, 5), (0, 0, 5), True),  # nowhere, inside
        ((20, 0, 5), (20, 0, 5), False),
        ((20, 0, 5), (10, 0, 5), False),  # up to the surface
        ((11, 9, 5), (9, 11, 5), False),  # past an edge
    ],
)
def test_on_the_surface_is_not_inside(start, end, enters):
    assert (entry_of(start, end, (-10, -10, 0), (10, 10, 10)) is not None) == enters


@settings(max_examples=60)
@given(point, st.lists(st.tuples(*[st.floats(-60.0, 60.0)] * 3), min_size=3, max_size=3), boxes())
def test_a_sweep_meets_a_box_where_sampling_finds_it_inside(corner, edges, box):
    shares = np.linspace(0.0, 1.0, 17)
    grid = np.array(list(itertools.product(shares, repeat=3)))
    places = np.array(corner) + grid @ np.array(edges)
    found = depth_um(places, *box).max() > 1e-6
    meets = sweep_meets(corner, edges, *box)
    assert meets or not found
    grain = sum(np.linalg.norm(edge) for edge in np.array(edges)) / 16
    if meets and abs(np.linalg.det(np.array(edges))) > 1.0:
        assert depth_um(places, *box).max() > -grain


@settings(max_examples=100)
@given(point, point, boxes())
def test_a_sweep_of_one_edge_is_a_straight_way(start, end, box):
    entry = entry_of(start, end, *box)
    assume(entry is None or entry.share < 1.0 - 1e-6)
    edge = tuple(b - a for a, b in zip(start, end, strict=True))
    nothing = (0.0, 0.0, 0.0)
    if math.hypot(*edge) > 1e-3:
        assert sweep_meets(start, [edge, nothing, nothing], *box) == (entry is not None)


# ---------------------------------------------------------------------- the rule


class TiltedStage:
    """What the rule asks of a stage."""

    name = "probe_stage"
    axis_names = AXES
    referenced = dict.fromkeys(AXES, True)

    def __init__(self, axes, origin_um):
        self.axes_in_rig = dict(zip(AXES, axes, strict=True))
        self.origin_um = origin_um

    def tip_um(self, position):
        directions = np.array([self.axes_in_rig[axis] for axis in AXES])
        return tuple((np.array(self.origin_um) + np.array([position[axis] for axis in AXES]) @ directions).tolist())


unit = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: math.hypot(*v) > 0.2)


@settings(max_examples=100)
@given(st.tuples(unit, unit, unit), point, point, point, boxes(), st.booleans())
def test_what_passes_stays_out_and_what_is_refused_came_near(directions, origin, start, end, box, straight):
    axes = [tuple((np.array(v) / np.linalg.norm(v)).tolist()) for v in directions]
    stage = TiltedStage(axes, origin)
    rule = KeepOut([KeepOutBox(name="box", min_um=box[0], max_um=box[1])])
    positions = [dict(zip(AXES, place, strict=True)) for place in (start, end)]
    sweep = {axis: Range(*sorted(position[axis] for position in positions)) for axis in AXES}
    plan = MotionPlan(kind="move", start=positions[0], targets=positions[1], sweep=sweep, straight=straight)
    shares = np.linspace(0.0, 1.0, 501 if straight else 13)
    if straight:
        places = np.array(start) + shares[:, None] * (np.array(end) - np.array(start))
    else:
        grid = np.array(list(itertools.product(shares, repeat=3)))
        places = np.array([sweep[a].min for a in AXES]) + grid * np.array([sweep[a].max - sweep[a].min for a in AXES])
    depths = depth_um(np.array(origin) + places @ np.array(axes), *box)
    clear_um = distance_um(stage.tip_um(positions[0]), *box)
    margin_um = min(MARGIN_UM, clear_um)
    began_um = depth_um(np.array(stage.tip_um(positions[0])), *box)
    try:
        rule.check(stage, plan)
    except UnsafeError:
        grain_um = 3 * math.dist(start, end) / (500 if straight else 12) + 1e-3
        if straight and began_um > 0.0:
            assert depths.max() > began_um or max(0.0, depths[-1]) >= began_um - 1e-9
        else:
            assert depths.max() > -margin_um - grain_um or not straight
    else:
        if straight and began_um > 0.0:
            assert depths.max() <= began_um + 1e-6
            assert depths[-1] < began_um
        else:
            assert depths.max() <= -margin_um + 1e-3


@settings(max_examples=100)
@given(point, boxes(), st.tuples(*[st.floats(0.02, 0.98)] * 3))
def test_a_straight_way_from_inside_deepens_where_sampling_finds_it_deeper(end, box, shares):
    low, high = np.array(box[0]), np.array(box[1])
    start = low + np.array(shares) * (high - low)
    depths = depth_um(start + np.linspace(0.0, 1.0, 501)[:, None] * (np.array(end) - start), *box)
    deeper = depths.max() > depths[0] + 1e-6
    if deeper:
        assert deepens(tuple(start), end, *box)
    elif deepens(tuple(start), end, *box):  # for less than a step, or by next to nothing
        assert depths.max() + math.dist(start, end) / 500 > depths[0]


SLIDE = {"name": "slide", "min_um": [0, 0, -5000], "max_um": [15000, 15000, -200]}
WALL = {"name": "wall", "min_um": [8000, 7400, -5000], "max_um": [8050, 7600, 300]}


@pytest.fixture
def kept(tmp_path):
    """The probe at (7950, 7500, 0), above a slide and left of a wall."""
    with guarded_rig(tmp_path, safety={"force_guards": "none", "keep_out": [SLIDE, WALL]}) as rig:
        yield rig


def test_a_way_into_a_box_is_refused_with_box_face_and_place_and_nothing_moves(kept):
    with pytest.raises(UnsafeError) as caught:
        kept.stage.move_to(x_um=200.0)
    text = str(caught.value)
    for part in ("probe_stage", "'wall'", "-x face", "(7995.0, 7500.0, 0.0) µm", "22% of the way", "go round it"):
        assert part in text, text
    with pytest.raises(UnsafeError, match=r"'slide' or enter it through its \+z face"):
        kept.stage.start_axis_to("z", -210.0, speed=10.0)
    with pytest.raises(UnsafeError, match="'slide'"):
        kept.stage.move_by(dz_um=-196.0)
    kept.clock.sleep(0.3)
    assert kept.true_x_um() == 0.0
    assert kept.rules() == ["refusal"] * 3
    assert not any(event.kind == "stopped" for event in kept.events)


def test_ways_beside_over_and_up_to_the_margin_are_free(kept):
    kept.stage.move_to(z_um=-194.9)
    kept.stage.move_to(x_um=44.9, z_um=0.0)
    kept.stage.move_to(z_um=306.0)
    kept.stage.move_to(x_um=200.0)
    kept.stage.move_to(z_um=0.0)
    with pytest.raises(UnsafeError, match=r"\+x face"):
        kept.stage.move_to(x_um=0.0)


def test_a_tip_within_the_margin_may_leave_and_not_come_nearer(tmp_path):
    near = {"name": "near", "min_um": [7952, 7000, -100], "max_um": [7990, 8000, 100]}
    with guarded_rig(tmp_path, safety={"force_guards": "none", "keep_out": [near]}) as kept:
        kept.stage.move_to(y_um=20.0)
        with pytest.raises(UnsafeError, match="'near'"):
            kept.stage.start_move_to(x_um=0.5)
        kept.stage.move_to(x_um=-10.0)
        with pytest.raises(UnsafeError, match="'near'"):
            kept.stage.start_move_to(x_um=0.0)


def test_a_refused_move_does_not_replace_the_one_under_way(kept):
    move = kept.stage.start_move_to(x_um=-100.0, speed_um_s=100.0)
    kept.clock.sleep(0.2)
    with pytest.raises(UnsafeError):
        kept.stage.start_move_to(x_um=200.0)
    assert move.wait().x_um == pytest.approx(-100.0, abs=0.2)


def test_a_move_that_replaces_another_is_checked_with_all_that_it_may_pass(kept):
    """It goes from below the wall's top on its left to above it on its right, which a straight way at rest may do."""
    kept.stage.move_to(x_um=0.0, z_um=250.0)
    kept.stage.start_move_to(z_um=400.0, speed_um_s=20.0)
    kept.clock.sleep(2.0)
    with pytest.raises(UnsafeError, match=r"start from rest.* x -?\d.* meets the keep-out box 'wall'") as caught:
        kept.stage.start_move_to(x_um=200.0, z_um=620.0)
    assert "from rest the way is straight" in caught.value.remedy
    kept.stage.start_move_to(x_um=-100.0).wait()
    kept.stage.move_to(x_um=0.0, z_um=290.0)
    kept.stage.move_to(x_um=200.0, z_um=620.0)


def test_where_an_axis_is_not_referenced_nobody_knows_what_it_would_hit(tmp_path):
    with guarded_rig(tmp_path, referenced=False, safety={"force_guards": "none", "keep_out": [SLIDE]}) as kept:
        kept.stage.reference(["z"])
        with pytest.raises(UnsafeError, match=r"axis x, y is not referenced.*keep-out box") as caught:
            kept.stage.move_to(z_um=10.0)
        assert "reference(['x', 'y'])" in caught.value.remedy
        with pytest.raises(NotReferenced):
            kept.stage.move_to(x_um=10.0)


def test_a_tool_is_taken_away_as_far_as_the_boxes_let_it(kept, caplog):
    pose = kept.stage.retract().wait()
    assert pose.x_um == pytest.approx(45.0, abs=0.2)
    assert "only 11 % of retract_um is free" in caplog.text


AROUND = {"name": "around", "min_um": [7900, 7400, -5000], "max_um": [8100, 7600, 100]}
"""The tip at (7950, 7500, 0): 50 µm from the −x face, 100 from the top and from ±y."""


@pytest.fixture
def trapped(tmp_path):
    """The probe within a box, where its references are."""
    with guarded_rig(tmp_path, safety={"force_guards": "none", "keep_out": [AROUND]}) as rig:
        yield rig


@pytest.mark.parametrize("way", [{"dx_um": -60.0}, {"dx_um": -20.0}, {"dz_um": 300.0}, {"dx_um": -20.0, "dy_um": 10.0}])
def test_from_within_a_box_a_straight_way_out_is_free(trapped, way):
    pose = trapped.stage.move_by(**way)
    assert [pose.position[name[1]] for name in way] == pytest.approx(list(way.values()), abs=0.2)


@pytest.mark.parametrize("way", [{"dx_um": 5.0}, {"dx_um": 400.0}, {"dz_um": 20.0}, {"dz_um": -20.0}])
def test_from_within_a_box_no_way_leads_deeper_or_about(trapped, way):
    with pytest.raises(
        UnsafeError, match=r"in the keep-out box 'around' already, at \(79.*does not lead out"
    ) as caught:
        trapped.stage.move_by(**way)
    assert "move_by(dx_um=-60) leads out through its -x face; retract()" in caught.value.remedy
    assert trapped.true_x_um() == 0.0


def test_from_within_a_box_no_way_leads_into_another(tmp_path):
    beside = {"name": "beside", "min_um": [7700, 7400, -5000], "max_um": [7890, 7600, 5000]}
    with guarded_rig(tmp_path, safety={"force_guards": "none", "keep_out": [AROUND, beside]}) as kept:
        with pytest.raises(UnsafeError, match="'beside'"):
            kept.stage.move_by(dx_um=-60.0)
        with pytest.raises(UnsafeError, match="'around'") as caught:
            kept.stage.move_by(dx_um=5.0)
        assert "move_by(dz_um=110)" in caught.value.remedy or "move_by(dy_um=" in caught.value.remedy


def test_a_move_that_does_not_start_from_rest_does_not_lead_out(trapped):
    trapped.stage.start_move_to(z_um=300.0, speed_um_s=20.0)
    trapped.clock.sleep(1.0)
    with pytest.raises(UnsafeError, match="does not start from rest"):
        trapped.stage.start_move_to(z_um=400.0)


def test_from_within_a_box_the_tool_is_taken_away(trapped):
    trapped.stage.retract().wait()
    trapped.stage.move_to(x_um=300.0)


def test_a_search_for_references_that_ends_within_a_box_is_told_with_the_way_out(trapped, caplog):
    assert trapped.rules() == ["keep-out"]
    assert "ended where no tool may be" in trapped.interventions[0].reason
    assert "move_by(dx_um=-60) leads out" in trapped.interventions[0].reason
    trapped.stage.move_by(dx_um=-60.0)
    trapped.stage.reference(["y"])
    assert trapped.rules() == ["keep-out"]


def test_the_tip_is_where_holder_and_axes_say(tmp_path):
    cos, sin = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    stage = {
        "origin_um": [1000.0, 2000.0, 3000.0],
        "axes_in_rig": {"x": [cos, 0.0, -sin], "y": [0, 1, 0], "z": [sin, 0, cos]},
        "retract_um": [0, 0, 200],
    }  # fmt: skip
    box = {"name": "floor", "min_um": [0, 0, 0], "max_um": [5000, 5000, 2900]}
    with guarded_rig(tmp_path, stage=stage, safety={"force_guards": "none", "keep_out": [box]}) as kept:
        assert kept.stage.tip_um({"x": 100.0, "y": 10.0, "z": 0.0}) == pytest.approx(
            (1086.6025, 2010.0, 2950.0), abs=1e-3
        )
        kept.stage.move_to(x_um=180.0)
        with pytest.raises(UnsafeError, match=r"'floor'"):
            kept.stage.move_to(x_um=195.0)
        kept.stage.move_to(x_um=195.0, z_um=10.0)
        assert kept.rig.safety.keep_out.reachable(kept.rig.devices[STAGE]) == ["floor"]
