"""What a tool on a fine stage feels."""

import pytest

from microdrivers.fakes.world.settings import ToolsWorld
from microdrivers.fakes.world.tools import Tools

AXIS = {"travel_um": [-625, 625]}
DEVICES = {
    "zoom": {"curve": [[0, 0.75], [10_000, 11.25]]},
    "sample_stage": {"axes": {"x": {}, "y": {}, "theta": {}}},
    "probe_stage": {"axes": {"x": AXIS, "y": AXIS, "z": AXIS}},
    "probe_force": {
        "range_uN": [-2000, 2000],
        "carried_by": "probe_stage",
        "axis": [0, 0, 1],
        "stiffness_uN_per_um": 1000.0,
    },
    "bench_force": {"range_uN": [-2000, 2000]},
}


def pressed(depth_um: float) -> float:
    """Force when the tip stands so deep in the obstacle (negative: away from it)."""
    tools = Tools(DEVICES, ToolsWorld(obstacle_um=200.0, obstacle_stiffness_uN_per_um=50.0), seed=4)
    axis = tools.axes["probe_stage"]["z"]
    end_ns = axis.move(0, -200.0 - depth_um, speed=1000.0, acceleration=1e5)
    return tools.force_uN("probe_force", end_ns + 10**9)


def test_the_obstacle_pushes_and_never_pulls():
    assert pressed(-0.5) == 0.0
    assert pressed(0.0) == pytest.approx(0.0, abs=1e-9)
    series = 1 / (1 / 50 + 1 / 1000)
    assert pressed(1.0) == pytest.approx(series)
    assert pressed(10.0) == pytest.approx(10 * series)


def test_a_sensor_that_nothing_carries_feels_nothing():
    tools = Tools(DEVICES, ToolsWorld(), seed=4)
    assert tools.force_uN("bench_force", 0) == 0.0
    assert tools.force_uN("unknown", 0) == 0.0


def test_only_stages_with_x_y_z_are_fine_stages_and_a_seed_places_them():
    first, again, other = (Tools(DEVICES, ToolsWorld(), seed=seed) for seed in (4, 4, 5))
    assert set(first.axes) == {"probe_stage"}

    def places(tools):
        return [axis.position_at(0) for axis in tools.axes["probe_stage"].values()]

    assert places(first) == places(again) != places(other)
    assert all(-625 <= place <= 625 for place in places(first))
    for axis in ("x", "y", "z"):
        shown = first.axes["probe_stage"][axis].position_at(0) + first.power_on_offset_um["probe_stage"][axis]
        assert shown == 0.0
