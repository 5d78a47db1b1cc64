"""The largest speed that keeps a predicted force below a bound: against the model itself, and its order."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import OutOfRange
from microdrivers.estimators.force.model import SpecimenModel, force_uN
from microdrivers.estimators.force.motion_limit import speed_limit

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
    limit = speed_limit(SINGLE, max_force_uN=551.61 + 138.6, depth_um=100.0)
    assert limit.speed_um_s == pytest.approx(5.0)
    assert limit.limited_by == "force"


@settings(deadline=None, max_examples=100)
@given(models, bounds, depths)
def test_the_model_stays_below_the_bound_all_the_way_and_would_not_faster(
    model: SpecimenModel, bound_uN: float, depth_um: float
) -> None:
    limit = speed_limit(model, max_force_uN=bound_uN, depth_um=depth_um)
    assert limit.speed_um_s <= model.fastest_um_s
    assert limit.speed_um_s >= 0.0
    way_um = np.linspace(0.0, depth_um, 400)
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
@given(models, bounds, bounds, depths, depths)
def test_a_larger_bound_allows_no_less_and_a_deeper_way_no_more(
    model: SpecimenModel, bound_uN: float, other_uN: float, depth_um: float, other_um: float
) -> None:
    low, high = sorted((bound_uN, other_uN))
    near, far = sorted((depth_um, other_um))
    speed = speed_limit(model, max_force_uN=low, depth_um=near).speed_um_s
    assert speed <= speed_limit(model, max_force_uN=high, depth_um=near).speed_um_s
    assert speed >= speed_limit(model, max_force_uN=low, depth_um=far).speed_um_s


def test_nothing_moves_where_the_springs_alone_exceed_the_bound() -> None:
    assert speed_limit(SINGLE, max_force_uN=551.6, depth_um=100.0) == (0.0, "static_force")


def test_a_softening_spring_is_worst_on_the_way() -> None:
    model = SpecimenModel(4.0, -1e-4, 10.0, 10.0)
    turn_um = math.sqrt(4.0 / 3e-4)
    most = float(force_uN(model, turn_um, 0.0))
    assert speed_limit(model, max_force_uN=most + 10.0, depth_um=190.0).speed_um_s == pytest.approx(1.0)
    assert speed_limit(model, max_force_uN=most + 10.0, depth_um=50.0).speed_um_s > 10.0


def test_nothing_is_said_beyond_the_characterised_speeds_and_depths() -> None:
    model = SINGLE._replace(fastest_um_s=5.0, deepest_um=100.0)
    assert speed_limit(model, max_force_uN=1500.0, depth_um=50.0) == (5.0, "characterised_speed")
    assert speed_limit(model, max_force_uN=600.0, depth_um=100.0).limited_by == "force"
    with pytest.raises(OutOfRange, match="characterised to 100 µm"):
        speed_limit(model, max_force_uN=1500.0, depth_um=101.0)
    undamped = SpecimenModel(4.0, 0.0, 0.0, 0.0)
    assert speed_limit(undamped, max_force_uN=100.0, depth_um=10.0) == (math.inf, "nothing")


@pytest.mark.parametrize(
    ("max_force_uN", "depth_um"),
    [(0.0, 10.0), (math.nan, 10.0), (math.inf, 10.0), (100.0, math.nan), (100.0, math.inf)],
)
def test_arguments_that_make_no_sense_are_refused(max_force_uN: float, depth_um: float) -> None:
    with pytest.raises(OutOfRange):
        speed_limit(SINGLE, max_force_uN=max_force_uN, depth_um=depth_um)


def test_a_depth_above_the_surface_is_a_touch() -> None:
    touch = speed_limit(SINGLE, max_force_uN=100.0, depth_um=0.0)
    assert touch.speed_um_s == pytest.approx(100.0 / 27.72)
    assert speed_limit(SINGLE, max_force_uN=100.0, depth_um=-20.0) == touch


@pytest.mark.parametrize("name", ["k1_uN_per_um", "b_loading_uN_s_per_um", "fastest_um_s", "deepest_um"])
def test_a_model_that_is_none_allows_no_speed(name: str) -> None:
    with pytest.raises(OutOfRange, match=name):
        speed_limit(SINGLE._replace(**{name: math.nan}), max_force_uN=500.0, depth_um=60.0)
