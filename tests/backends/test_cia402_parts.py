"""Settings, counts, states and what may be said of an axis."""

from __future__ import annotations

import json
from typing import Any

import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.cia402 import FineStageSettings
from microdrivers.backends.cia402.axis_map import AxisMap
from microdrivers.backends.cia402.axis_watch import AxisWatch, Reading
from microdrivers.backends.cia402.settings import FineAxis
from microdrivers.backends.cia402.states import Control, State, next_control_word, state_of
from microdrivers.core.units import Range
from tests.backends.cia402_bench import AXIS, NODES
from tests.backends.cia402_peer import ACK, ENABLED, QUICK, REACHED, SOD, Profile

MS = 1_000_000


def _rig_section(**changes: Any) -> dict[str, Any]:
    plain = AXIS | {"travel_um": [-625, 625]}
    return {
        "connection": {"interface": "socketcan", "channel": "can0"},
        "axes": {axis: plain | {"node_id": node_id} for axis, node_id in NODES.items()},
        "reference_order": ["z", "x", "y"],
    } | changes


def _axes(**changes: Any) -> dict[str, Any]:
    axes: dict[str, Any] = _rig_section()["axes"]
    axes["y"] |= changes
    return axes


def test_a_rig_section_is_read():
    text = json.dumps(_rig_section(axes_in_rig={"x": [0, 1, 0], "y": [-1, 0, 0]}, retract_um=[0, 0, 500]))
    found = FineStageSettings.model_validate_json(text)
    assert found.connection.bitrate == 500_000
    assert found.axes_in_rig.y == (-1.0, 0.0, 0.0)
    assert found.heartbeat_ms == 100


@pytest.mark.parametrize(
    ("method", "direction", "end_um"),
    [(17, 1, -100.0), (1, 1, -100.0), (18, 1, 600.0), (2, 1, 600.0), (17, -1, 600.0), (18, -1, -100.0), (37, 1, None)],
)
def test_a_search_at_a_limit_switch_ends_at_that_end_of_the_travel(method, direction, end_um):
    changes = {"homing_method": method, "direction": direction, "travel_um": [-100, 600]}
    found = FineStageSettings.model_validate_json(json.dumps(_rig_section(axes=_axes(**changes))))
    assert found.homing_ends_um == {"x": -625.0, "z": -625.0} | ({} if end_um is None else {"y": end_um})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"axes": _axes(node_id=11)}, r"different node ids, not \[11, 11, 13\]"),
        ({"axes": _axes(node_id=127)}, "less than or equal to 126"),
        ({"axes": _axes(travel_um=[0, 0])}, r"travel_um must rise: \[lowest, highest\], not \[0, 0\]"),
        ({"axes": _axes(travel_um=[5, -5])}, "travel_um must rise"),
        ({"axes": _axes(tolerance_um=0.02)}, "finer than half a count of 0.05 µm"),
        ({"axes": _axes(travel_um=[0, 2e9])}, "32 bits"),
        ({"axes": _axes(acceleration_um_s2=2e9)}, "do not fit"),
        ({"axes": _axes(homing_method=0)}, "homing_method 0 is none of CiA 402"),
        ({"axes": _axes(homing_method=31)}, "homing_method 31 is none of CiA 402"),
        ({"axes": _axes(homing_method=-129)}, "homing_method -129 is none of CiA 402"),
        ({"axes": _axes(homing_speeds_um_s=[100, 0])}, "must be positive"),
        ({"axes": _axes(direction=2)}, "direction"),
        ({"reference_order": ["z", "z", "y"]}, "once each"),
        ({"axes_in_rig": {"x": [1, 1, 0]}}, "axes_in_rig.x must have length 1, not 1.414"),
        ({"axes_in_rig": {"x": [0, 1, 0]}}, "in one plane"),
        ({"retract_um": [0, 0, 0]}, "leads nowhere"),
        ({"heartbeat_ms": 0}, "heartbeat_ms"),
        ({"connection": {"interface": "socketcan", "channel": "can0", "bitrate": 12345}}, "bitrate"),
        ({"connection": {"interface": "socketcan", "channel": "can0", "typo": 1}}, "typo"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(changes: dict[str, Any], says: str):
    with pytest.raises(pydantic.ValidationError, match=says):
        FineStageSettings.model_validate_json(json.dumps(_rig_section(**changes)))


@settings(deadline=None, max_examples=200)
@given(
    position=st.floats(-625.0, 625.0),
    scale=st.sampled_from([1.0, 20.0, 145.6, 1 / 3]),
    direction=st.sampled_from([1, -1]),
)
def test_targets_are_the_nearest_counts_inside_the_travel(position: float, scale: float, direction: int):
    axis = FineAxis.model_validate(
        AXIS | {"node_id": 1, "counts_per_um": scale, "direction": direction, "tolerance_um": 2.0}
    )
    counts = AxisMap.from_settings(axis)
    target = counts.counts(position)
    assert counts.lowest <= target <= counts.highest
    assert abs(counts.position_um(target) - position) <= (1.0 if abs(position) > 624 else 0.5) / scale + 1e-9
    assert -625 - 1e-6 <= counts.position_um(counts.lowest) <= 625 + 1e-6
    assert counts.highest - counts.lowest >= 1250 * scale - 2
    assert (counts.position_um(target) - counts.position_um(target - 1)) * direction > 0


def test_a_mirrored_axis_mirrors_its_limits():
    axis = FineAxis.model_validate(AXIS | {"node_id": 1, "direction": -1, "travel_um": Range(-100.0, 600.0)})
    counts = AxisMap.from_settings(axis)
    assert (counts.lowest, counts.highest) == (-12_000, 2_000)
    assert counts.counts(-100.0) == 2_000


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x0250, State.SWITCH_ON_DISABLED), (0x0231, State.READY), (0x0233, State.SWITCHED_ON),
        (0x0237, State.OPERATION_ENABLED), (0x0637, State.OPERATION_ENABLED), (0x1237, State.OPERATION_ENABLED),
        (0x0218, State.FAULT), (0x021F, State.FAULT_REACTION), (0x0217, State.QUICK_STOP_ACTIVE),
        (0x0200, State.NOT_READY), (0x0270, State.SWITCH_ON_DISABLED), (0x0238, State.FAULT), (0x0222, None),
    ],
)  # fmt: skip
def test_states_are_read_as_the_sheet_says(word: int, state: State | None):
    assert state_of(word) is state


def test_the_way_to_operation_enabled():
    words = [
        next_control_word(state)
        for state in (State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON, State.QUICK_STOP_ACTIVE)
    ]
    assert words == [Control.SHUTDOWN, Control.SWITCH_ON, Control.ENABLE, Control.ENABLE]
    assert all(next_control_word(state) is None for state in (State.FAULT, State.NOT_READY, None))


# ---------------------------------------------------------------------- the watch


def _moved(watch: AxisWatch) -> None:
    watch.see(0, Reading(ENABLED | REACHED, 0, 1))
    watch.enabled()
    watch.commanded(1000)


def test_an_axis_is_on_target_only_when_the_drive_has_taken_that_target():
    watch = AxisWatch(tolerance=3)
    _moved(watch)
    watch.see(1 * MS, Reading(ENABLED | REACHED, 1000, 1))  # still says so of the last one
    assert (watch.moving, watch.on_target) == (True, False)
    watch.acknowledged()
    watch.see(2 * MS, Reading(ENABLED | ACK, 500, 1))
    assert (watch.moving, watch.on_target) == (True, False)
    watch.see(3 * MS, Reading(ENABLED | REACHED, 996, 1))  # the drive's window is wider than ours
    assert (watch.moving, watch.on_target) == (False, False)
    watch.see(4 * MS, Reading(ENABLED | REACHED, 997, 1))
    assert watch.on_target


def test_a_reading_in_another_mode_says_nothing_of_the_target():
    watch = AxisWatch(tolerance=3)
    _moved(watch)
    watch.acknowledged()
    watch.see(2 * MS, Reading(ENABLED | REACHED, 1000, 6))
    assert not watch.on_target


def test_after_a_stop_an_axis_moves_until_it_was_seen_at_rest():
    watch = AxisWatch(tolerance=3)
    _moved(watch)
    watch.ended(5 * MS)
    assert watch.target is None
    for t_ms, position, moving in ((6, 500, True), (8, 520, True), (12, 521, True), (18, 521, False), (30, 600, True)):
        watch.see(t_ms * MS, Reading(QUICK, position, 1))
        assert watch.moving is moving, t_ms
    assert not watch.dropped


def test_a_drive_that_switches_itself_off_has_dropped():
    watch = AxisWatch(tolerance=3)
    _moved(watch)
    watch.acknowledged()
    watch.see(2 * MS, Reading(SOD, 500, 1))
    assert watch.dropped
    assert not watch.on_target


def test_a_fresh_axis_is_taken_to_rest():
    watch = AxisWatch(tolerance=3)
    watch.see(1, Reading(SOD, 77, 0))
    assert (watch.moving, watch.on_target, watch.braking) == (False, False, False)


@settings(deadline=None, max_examples=100)
@given(
    start=st.floats(-1e4, 1e4), way=st.floats(-2e4, 2e4), velocity=st.floats(1, 2e4), acceleration=st.floats(100, 2e5)
)
def test_the_peers_profile_ends_where_it_should(start: float, way: float, velocity: float, acceleration: float):
    profile = Profile(start, start + way, velocity, acceleration)
    assert profile.at(profile.duration_s)[0] == pytest.approx(start + way, abs=1e-6)
    assert profile.at(profile.duration_s * 0.999)[0] == pytest.approx(start + way, abs=abs(way) * 0.01 + 1e-6)
    assert abs(profile.at(profile.duration_s / 2)[1]) <= velocity + 1e-9
