"""The life of a rig: opens all or nothing, reports every failure, stops everything in any case."""

import gc

import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import ConfigError, ConnectError, ErrorTree, LinkLost, UnsupportedError
from microdrivers.core.samples import DeviceEvent
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.devices.zoom_motor import ZoomMotor
from microdrivers.rig import build_rig, open_rig
from microdrivers.rig import registry as registry_module
from microdrivers.rig import simulation as simulation_module


def emulated(**options):
    return build_rig(shipped_rig("microscope"), fake=True, clock=SimulatedClock(), **options)


def test_without_hardware_every_device_that_failed_is_named_with_a_remedy():
    with pytest.raises(ConnectError) as caught, open_rig(shipped_rig("microscope"), clock=SystemClock()):
        pass
    text = str(caught.value)
    assert "3 of 3 devices" in text
    for name in ("sample_stage", "zoom", "camera_fine"):
        assert name in text
    assert text.count("to do:") == 3
    assert "--fake" in text


def test_an_emulated_rig_opens_identifies_and_moves_nothing():
    rig = emulated()
    start = {name: axis.position_at(0) for name, axis in rig.simulation.world.stage_axes.items()}
    with rig:
        assert rig.devices["sample_stage"].info.model.startswith("C-884")
        rig.clock.sleep(1.0)
        now = {name: axis.position_at(rig.clock.now_ns()) for name, axis in rig.simulation.world.stage_axes.items()}
        assert now == start


def test_in_real_time_what_is_there_is_not_looked_through_for_garbage_while_the_rig_is_open():
    """A whole collection halts every thread for longer than a force guard waits for data."""
    with emulated():
        assert gc.get_freeze_count() == 0
    with open_rig(shipped_rig("microscope"), fake=True, clock=SystemClock()):
        assert gc.get_freeze_count() > len(gc.get_objects())
    assert gc.get_freeze_count() == 0


def test_one_failing_device_closes_the_others():
    rig = emulated()
    rig.simulation.emulations["zoom"].close()
    with pytest.raises(ConnectError, match="1 of 3") as caught:
        rig.open()
    assert "zoom" in str(caught.value)
    assert rig.devices["sample_stage"].link == "closed"


def test_leaving_stops_everything_even_after_an_error():
    events = []
    rig = emulated()
    rig.bus.topic("sample_stage/event", DeviceEvent).subscribe(lambda event: events.append(event.kind))

    def experiment():
        stage = rig.device("sample_stage", XYThetaStage)
        stage.reference(["x", "y", "theta"])
        stage.start_move_to(x_um=12_000)
        rig.clock.sleep(0.2)
        raise RuntimeError("experiment failed")

    with pytest.raises(RuntimeError, match="experiment"), rig:
        experiment()
    assert events[-2:] == ["stopped", "closed"]
    world = rig.simulation.world
    end_ns = world.stage_axes["x"].profile_end_ns
    assert world.stage_axes["x"].position_at(end_ns + 10**9) < 9000


def test_stop_reaches_every_device_though_one_link_is_dead():
    with emulated() as rig:
        from microdrivers.fakes.wire import wire_named

        rig.device("sample_stage", XYThetaStage).reference(["x", "y", "theta"])
        move = rig.device("zoom", ZoomMotor).start_move_to(zoom=10.0)
        wire_named("sample_stage").unplug()
        with pytest.raises(ErrorTree, match="not every device could be told to stop"):
            rig.stop()
        assert move.state == "cancelled"


def test_an_unplugged_cable_is_a_typed_error_that_names_the_device():
    from microdrivers.fakes.wire import wire_named

    with emulated() as rig:
        wire_named("sample_stage").unplug()
        with pytest.raises(LinkLost, match="sample_stage") as caught:
            rig.devices["sample_stage"].read()
        assert "cable" in caught.value.remedy


def test_a_stream_over_a_lost_link_reports_it_once_and_its_return(caplog):
    from microdrivers.fakes.wire import wire_named

    with emulated() as rig:
        stage, kinds = rig.devices["sample_stage"], []
        stage.events.subscribe(lambda event: kinds.append(event.kind))
        with stage.stream(50.0):
            rig.clock.sleep(0.2)
            wire_named("sample_stage").plugged = False
            rig.clock.sleep(0.2)
            assert stage.link == "lost"
            wire_named("sample_stage").plugged = True
            rig.clock.sleep(0.2)
        assert kinds.count("link_lost") == 1
        assert kinds.count("link_back") == 1
        assert stage.link == "open"


def test_a_driver_without_an_emulator_makes_fake_refuse_by_name(monkeypatch):
    monkeypatch.setattr(
        simulation_module, "find_emulator", lambda name: None if "az" in name else registry_module.find_emulator(name)
    )
    with pytest.raises(UnsupportedError, match=r"no emulator is installed for zoom \(driver oriental-az-zoom\)"):
        emulated()


def test_two_rigs_cannot_share_a_port():
    with emulated() as first:
        stage = first.devices["sample_stage"]
        other = type(stage)("other", first.simulation.settings_of("sample_stage"), clock=first.clock, bus=first.bus)
        with pytest.raises(LinkLost, match="in use"):
            other.open()


def test_a_mistake_in_the_world_file_has_its_place(tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("world: microscope\ntarget:\n  side_mm: 0.4\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"world\.yaml:3:3: target\.side_mm: unknown key") as caught:
        emulated(world=world)
    assert "side_um" in str(caught.value)


def test_worlds_differ_by_seed_and_repeat_for_a_seed():
    def draw(seed):
        world = emulated(seed=seed).simulation.world
        return world.microscope, world.look, world.delivery_delay_s, world.stamp_error_s

    assert draw(1) == draw(1)
    one, two = draw(1), draw(2)
    assert one[0].angle_deg != two[0].angle_deg
    assert one[2:] != two[2:]
    assert {draw(seed)[0].mirrored for seed in range(8)} == {True, False}


def test_a_device_of_another_kind_is_refused_by_name():
    rig = emulated()
    with pytest.raises(UnsupportedError, match="not a ZoomMotor"):
        rig.device("camera_fine", ZoomMotor)
