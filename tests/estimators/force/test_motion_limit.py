"""The largest speed that keeps a predicted force below a bound: against the model itself, and its order."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.model import SpecimenModel, force_uN
from microdrivers.estimators.force.motion_limit import (
    largest_speed_um_s,
    largest_speeds_um_s,
    largest_stroke_speed_um_s,
    speed_limit,
    stroke_speed_limit,
)

SINGLE = SpecimenModel(4.5161, 1e-4, 27.72, 27.72)


def specimen(k1: float, k2: float, b: float, fastest_um_s: float) -> SpecimenModel:
    return SpecimenModel(k1, k2, b, 0.0, fastest_um_s=fastest_um_s)


models = st.builds(
    specimen,
    st.floats(0.0, 10.0),
    st.floats(-1e-4, 1e-3),
    st.one_of(st.floats(-5.0, 0.0), st.floats(1e-3, 60.0)),
    st.one_of(st.just(math.inf), st.floats(0.1, 50.0)),
)
depths = st.floats(0.0, 150.0)
bounds = st.floats(0.1, 2000.0)


def test_worked_example() -> None:
    # 100 µm deep the springs take 551.61 µN; 138.6 µN more are 5 µm/s.
    assert largest_speed_um_s(SINGLE, max_force_uN=551.61 + 138.6, depth_um=100.0) == pytest.approx(5.0)
    # 20 µm of stopping distance are 120 µm deep: 714.732 µN.
    speed = largest_speed_um_s(SINGLE, max_force_uN=714.732 + 27.72, depth_um=100.0, stopping_distance_um=20.0)
    assert speed == pytest.approx(1.0)


@settings(deadline=None, max_examples=100)
@given(models, bounds, depths, st.floats(0.0, 20.0))
def test_the_model_stays_below_the_bound_and_would_not_faster(
    model: SpecimenModel, bound_uN: float, depth_um: float, stopping_um: float
) -> None:
    limit = speed_limit(model, max_force_uN=bound_uN, depth_um=depth_um, stopping_distance_um=stopping_um)
    assert limit.speed_um_s <= model.fastest_um_s
    assert limit.speed_um_s >= 0.0
    way_um = np.linspace(depth_um, depth_um + stopping_um, 400)
    if math.isfinite(limit.speed_um_s) and limit.limited_by != "static_force":
        assert force_uN(model, way_um, limit.speed_um_s).max() <= bound_uN * (1.0 + 1e-9)
    if limit.limited_by == "force":
        faster = 1.001 * limit.speed_um_s + 1e-6
        # A spring that pulls the tool in takes nothing off the damper's push: it may let go.
        push_uN = np.maximum(force_uN(model, way_um, 0.0), 0.0) + model.b_loading_uN_s_per_um * faster
        assert push_uN.max() > bound_uN * (1.0 - 1e-4)
    if limit.limited_by == "static_force":
        assert force_uN(model, way_um, 0.0).max() >= bound_uN * (1.0 - 1e-4)
        assert limit.speed_um_s == 0.0


@settings(deadline=None, max_examples=60)
@given(models, bounds, bounds, depths, depths, st.floats(0.0, 20.0))
def test_a_larger_bound_allows_no_less_and_a_longer_way_no_more(
    model: SpecimenModel, bound_uN: float, other_uN: float, depth_um: float, other_um: float, stopping_um: float
) -> None:
    low, high = sorted((bound_uN, other_uN))
    near, far = sorted((depth_um, other_um))
    stroke: dict[str, Any] = {"from_um": near, "to_um": far}
    assert largest_speed_um_s(model, max_force_uN=low, depth_um=near) <= largest_speed_um_s(
        model, max_force_uN=high, depth_um=near
    )
    whole = largest_stroke_speed_um_s(model, max_force_uN=low, **stroke)
    assert whole >= largest_stroke_speed_um_s(model, max_force_uN=low, stopping_distance_um=stopping_um, **stroke)
    for x in np.linspace(near, far, 5).tolist():
        assert whole <= largest_speed_um_s(model, max_force_uN=low, depth_um=x) * (1.0 + 1e-9)
    if model.k2_uN_per_um3 >= 0.0:
        deep, shallow = (largest_speed_um_s(model, max_force_uN=low, depth_um=x) for x in (far, near))
        assert deep <= shallow


def test_nothing_moves_where_the_springs_alone_exceed_the_bound() -> None:
    assert speed_limit(SINGLE, max_force_uN=551.6, depth_um=100.0) == (0.0, "static_force")
    assert stroke_speed_limit(SINGLE, max_force_uN=551.6, from_um=0.0, to_um=100.0).speed_um_s == 0.0


def test_softening_spring_is_worst_inside_the_stroke() -> None:
    model = SpecimenModel(4.0, -1e-4, 10.0, 10.0)
    turn_um = math.sqrt(4.0 / 3e-4)
    most = float(force_uN(model, turn_um, 0.0))
    limit = stroke_speed_limit(model, max_force_uN=most + 10.0, from_um=0.0, to_um=190.0)
    assert limit.speed_um_s == pytest.approx(1.0)
    assert largest_speed_um_s(model, max_force_uN=most + 10.0, depth_um=190.0) > 10.0


def test_speeds_and_depths_beyond_the_characterised_ones_only_if_asked() -> None:
    model = SINGLE._replace(fastest_um_s=5.0, deepest_um=100.0)
    assert speed_limit(model, max_force_uN=1500.0, depth_um=50.0) == (5.0, "characterised_speed")
    free = speed_limit(model, max_force_uN=1500.0, depth_um=50.0, beyond_characterised=True)
    assert free.limited_by == "force"
    assert free.speed_um_s > 5.0
    with pytest.raises(OutOfRange, match="characterised to 100 µm"):
        largest_speed_um_s(model, max_force_uN=1500.0, depth_um=95.0, stopping_distance_um=6.0)
    deep = speed_limit(model, max_force_uN=1500.0, depth_um=95.0, stopping_distance_um=6.0, beyond_characterised=True)
    assert deep.limited_by == "force"
    undamped = SpecimenModel(4.0, 0.0, 0.0, 0.0)
    assert speed_limit(undamped, max_force_uN=100.0, depth_um=10.0) == (math.inf, "nothing")


def test_profile_of_speeds_slows_down_on_the_way_in() -> None:
    speeds = largest_speeds_um_s(SINGLE, max_force_uN=600.0, depths_um=np.linspace(0.0, 110.0, 12))
    assert np.all(np.diff(speeds) <= 0.0)
    assert speeds[0] == pytest.approx(600.0 / 27.72)
    assert speeds[-1] == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_force_uN": 0.0},
        {"max_force_uN": math.nan},
        {"depth_um": math.nan},
        {"depth_um": math.inf},
        {"stopping_distance_um": -1.0},
        {"stopping_distance_um": math.nan},
    ],
)
def test_arguments_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    good = {"max_force_uN": 100.0, "depth_um": 10.0, "stopping_distance_um": 0.0}
    with pytest.raises(OutOfRange):
        largest_speed_um_s(SINGLE, **(good | wrong))


def test_a_stroke_that_does_not_load_is_refused() -> None:
    with pytest.raises(OutOfRange, match="does not load"):
        largest_stroke_speed_um_s(SINGLE, max_force_uN=100.0, from_um=20.0, to_um=10.0)


@settings(deadline=None, max_examples=50)
@given(st.floats(-100.0, -0.1), bounds)
def test_above_the_surface_the_tool_is_taken_to_touch_at_once(depth_um: float, bound_uN: float) -> None:
    assume(bound_uN > 0.2)
    expected = largest_speed_um_s(SINGLE, max_force_uN=bound_uN, depth_um=0.0)
    assert largest_speed_um_s(SINGLE, max_force_uN=bound_uN, depth_um=depth_um) == expected
