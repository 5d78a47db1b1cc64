"""Figures of the world that stand in place of the world file's."""

import pytest
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import ConfigError
from microdrivers.rig import build_rig


def emulated(overrides, **options):
    return build_rig(shipped_rig(), fake=True, clock=SimulatedClock(), world_overrides=overrides, **options)


def test_they_are_merged_into_the_world_file():
    usual = emulated(None).simulation.world.settings
    world = emulated({"specimen": {"preset": "viscoelastic"}, "target": {"noise_levels": 0}}).simulation.world
    assert world.settings.specimen == usual.specimen.model_copy(update={"preset": "viscoelastic"})
    assert world.settings.target == usual.target.model_copy(update={"noise_levels": 0.0})
    assert world.settings.stage == usual.stage


def test_they_do_without_a_world_file(tmp_path):
    file = tmp_path / "lab.yaml"
    file.write_text(shipped_rig().read_text(encoding="utf-8"), encoding="utf-8")
    rig = build_rig(file, fake=True, clock=SimulatedClock(), world_overrides={"specimen": {"preset": "none"}})
    assert rig.simulation.world_file is None
    assert rig.simulation.world.specimen is None


def test_what_is_wrong_with_them_is_not_blamed_on_the_file(tmp_path):
    with pytest.raises(ConfigError) as caught:
        emulated({"specimen": {"preset": "jelly"}})
    assert str(caught.value).startswith("world_overrides: specimen.preset: ")
    assert "'slip_corrected'" in str(caught.value)
    with pytest.raises(ConfigError, match="world_overrides: specimens: unknown key") as caught:
        emulated({"specimens": {"preset": "single"}})
    assert "specimen" in caught.value.remedy
    world = tmp_path / "world.yaml"
    world.write_text(yaml.safe_dump({"stage": {"servo_lag_ms": -1}}), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        emulated({"specimen": {"preset": "single"}}, world=world)
    assert caught.value.file == str(world)


def test_another_word_is_no_slip_of_the_pen():
    for written, remedy in (("singel", "did you mean 'single'?"), ("nonsense", "correct the value")):
        with pytest.raises(ConfigError) as caught:
            build_rig(shipped_rig(), fake=True, world_overrides={"specimen": {"preset": written}})
        assert caught.value.remedy == remedy


def test_they_need_a_simulation_of_their_own(tmp_path):
    with pytest.raises(ConfigError, match="wire_replay takes the place"):
        build_rig(shipped_rig(), wire_replay=tmp_path / "log.jsonl", world_overrides={"specimen": {}})
