"""Where the specimen is, what the sensors feel of it, and what of it a seed draws."""

from __future__ import annotations

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.contact_samples import ContactTruth, SpecimenTruth
from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.world.mechanics import PRESETS
from microdrivers.fakes.world.specimen import find_probe, nominal_surface_um
from tests.fakes.specimen_bench import build, fine_stage, go, probe_rig, ready


def test_the_probe_meets_the_surface_where_it_should_be_and_feels_a_push_along_its_axis():
    places = []
    for seed in range(8):
        world = build(seed=seed)
        x_um, y_um, z_um = world.specimen.surface_um
        assert (y_um, z_um) == (7500.0, 0.0)
        assert abs(x_um - 7500.0) <= 30.0
        places.append(x_um)
        t_ns = go(world, ready(world), x=x_um - 7950.0 + 1.0)
        assert world.force_uN("probe_force", t_ns) == 0.0
        t_ns = go(world, t_ns, x=x_um - 7950.0 - 20.0, speed=5.0)
        assert world.force_uN("probe_force", t_ns) == pytest.approx(20 * 4.5161, rel=0.05)
        assert world.force_uN("gripper_force", t_ns) == 0.0
    assert len(set(places)) == 8


def test_the_surface_lies_ahead_of_the_place_that_the_rig_file_states():
    rig = probe_rig()
    rig["probe"] = {"force": "probe_force", "ready_um": [-100.0, -20.0, 10.0]}
    assert nominal_surface_um(find_probe(rig)).tolist() == [7790.0, 7480.0, 10.0]
    rig["devices"]["probe_stage"]["axes"]["x"]["travel_um"] = [-450.0, 625.0]
    assert nominal_surface_um(find_probe(rig)).tolist() == [7790.0, 7480.0, 10.0]
    rig["probe"]["ready_um"] = [-400.0, 0.0, 0.0]
    assert nominal_surface_um(find_probe(rig)).tolist() == [7525.0, 7500.0, 0.0]


@pytest.mark.parametrize("ready_um", [0.0, 100.0, 300.0])
def test_a_tip_that_has_just_been_switched_on_is_not_inside_the_specimen(ready_um):
    rig = probe_rig()
    rig["probe"] = {"force": "probe_force", "ready_um": [ready_um, 0.0, 0.0]}
    assert nominal_surface_um(find_probe(rig)).tolist() == [7890.0, 7500.0, 0.0]


def test_a_tip_beside_or_above_passes():
    for aside in ({"y": 205.0}, {"z": 205.0}, {"z": -205.0}):
        world = build()
        t_ns = go(world, go(world, 0, x=-300.0, y=0.0, z=0.0), **aside)
        assert world.force_uN("probe_force", go(world, t_ns, x=-600.0)) == 0.0
    world = build()
    t_ns = go(world, go(world, 0, x=-300.0, y=100.0, z=100.0), x=-600.0)
    assert world.force_uN("probe_force", t_ns) > 0.0


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_mechanics_are_the_presets_to_the_last_digit(preset):
    for seed in (1, 2):
        assert build(seed=seed, specimen={"preset": preset}).specimen.mechanics == PRESETS[preset]


def test_figures_can_be_stated_and_spread():
    own = build(specimen={"preset": "slip_corrected", "k1_uN_per_um": 3.0, "adhesion_uN": 7.0, "slip_um": 0.0})
    expected = PRESETS["slip_corrected"]._replace(k1_uN_per_um=3.0, adhesion_uN=7.0, slip_um=0.0)
    assert own.specimen.mechanics == expected
    spread = [build(seed=seed, specimen={"spread": 0.1}).specimen.mechanics for seed in range(20)]
    for name in ("k1_uN_per_um", "k2_uN_per_um3", "b_loading_uN_s_per_um"):
        ratios = [getattr(one, name) / getattr(PRESETS["single"], name) for one in spread]
        assert len(set(ratios)) == 20
        assert 0.03 < max(ratios) - 1.0 < 0.4
        assert -0.4 < min(ratios) - 1.0 < -0.03
    assert all(one.b_loading_uN_s_per_um == one.b_unloading_uN_s_per_um for one in spread)


@pytest.mark.parametrize(
    "changes",
    [
        {"probe_stage": fine_stage(None)},
        {"probe_force": None, "gripper_force": None},
        {"probe_stage": None, "gripper_stage": None},
        {"probe_force": {"range_uN": [-1, 1], "carried_by": "probe_stage", "axis": [0, 0, 1]}, "gripper_force": None},
    ],
)
def test_without_a_probe_that_could_press_on_it_there_is_none(changes):
    rig = probe_rig(**changes)
    world = build(rig)
    assert world.specimen is None or world.specimen.sensor == "gripper_force"
    assert not rig["devices"].get("probe_force") or world.force_uN("probe_force", NS_PER_S) == 0.0


def test_the_rig_file_can_say_which_sensor_it_is():
    rig = probe_rig(second_force={"range_uN": [-9, 9], "carried_by": "probe_stage", "axis": [1, 0, 0]})
    assert build(rig).specimen.sensor == "probe_force"
    rig["probe"] = {"stage": "probe_stage", "force": "second_force", "camera": "camera"}
    assert build(rig).specimen.sensor == "second_force"


def test_preset_none_takes_it_away():
    assert build(specimen={"preset": "none"}).specimen is None


def test_the_gripper_carries_it_and_brings_it_back():
    world = build()
    surface_um = world.specimen.surface_um[0]
    gripper = world.fine_stage_axes["gripper_stage"]
    assert all(abs(axis.position_at(0)) < 5.001 for axis in gripper.values())
    assert world.specimen.carried_um(0).tolist() == [0.0, 0.0, 0.0]
    t_ns = go(world, ready(world), x=surface_um - 7950.0 - 50.0)
    assert world.force_uN("probe_force", t_ns) > 100.0
    t_ns = go(world, t_ns, stage="gripper_stage", x=-625.0)
    assert world.force_uN("probe_force", t_ns) == 0.0
    t_ns = go(world, t_ns, stage="gripper_stage", x=0.0, y=0.0, z=0.0)
    touch = world.specimen.touch_at(t_ns + 100 * NS_PER_S)
    assert touch.force_uN > 100.0
    assert touch.tip_um == pytest.approx(50.0, abs=5.5)


def test_without_a_gripper_it_stays_where_it_is():
    world = build(probe_rig(gripper_stage=None, gripper_force=None))
    assert world.specimen.holder is None
    assert world.specimen.carried_um(NS_PER_S).tolist() == [0.0, 0.0, 0.0]


def test_a_tilted_holder_pushes_along_its_sensors_axis():
    c, s = 0.9659258262890683, 0.25881904510252074
    stage = fine_stage([7950, 7500, 100]) | {"axes_in_rig": {"x": [c, 0, s], "y": [0, 1, 0], "z": [-s, 0, c]}}
    force = {"range_uN": [-1, 1], "carried_by": "probe_stage", "axis": [c, 0, s], "stiffness_uN_per_um": 1000.0}
    world = build(probe_rig(probe_stage=stage, probe_force=force), specimen={"place_spread_um": 0})
    assert world.specimen.surface_um == pytest.approx([7950 - 450 * c, 7500, 100 - 450 * s])
    t_ns = go(world, 0, x=-440.0, y=0.0, z=0.0)
    assert world.force_uN("probe_force", t_ns) == 0.0
    t_ns = go(world, t_ns, x=-470.0, speed=5.0)
    assert world.specimen.touch_at(t_ns).tip_um == pytest.approx(20.0, abs=0.3)


def test_the_truth_is_told():
    bus = Bus()
    world = build(bus=bus, specimen={"preset": "slip_corrected"})
    specimen = bus.topic("truth/specimen", SpecimenTruth).latest
    assert (specimen.preset, specimen.sensor, specimen.slip_um) == ("slip_corrected", "probe_force", 25.0)
    assert specimen.surface_um == tuple(world.specimen.surface_um)
    truths = []
    bus.topic("truth/contact", ContactTruth).subscribe(truths.append)
    t_ns = go(world, ready(world), x=-500.0, speed=20.0)
    world.view("camera").publish_truth(t_ns, 5)
    world.view("camera_coarse").publish_truth(t_ns, 6)
    assert [(truth.frame_seq, truth.t_ns, truth.in_contact) for truth in truths] == [(5, t_ns, True)]
    truth = truths[0]
    assert truth.deformation_um == pytest.approx(truth.compression_um + truth.slip_um)
    assert truth.tip_um == truth.deformation_um
    assert truth.force_uN == world.force_uN("probe_force", t_ns)
    stage_um = 7950.0 + world.fine_stage_axes["probe_stage"]["x"].position_at(t_ns)
    assert truth.tip_um == pytest.approx(world.specimen.surface_um[0] - stage_um - truth.force_uN / 1000.0, abs=1e-6)
