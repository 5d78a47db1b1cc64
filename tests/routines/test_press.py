"""The live experiment on an emulated probe: whatever ends it, the probe goes away and what was measured is kept."""

import re

import msgspec
import pytest

from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import DataError, MicrodriversError, MoveCancelled, NoContact, OutOfRange, TargetLost
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.vision.contact_patch import contact_patch
from microdrivers.rig import open_rig
from microdrivers.routines.force import Characterisation, PressExperiment, sight
from microdrivers.routines.progress import SilentProgress
from tests.routines.small_rig import SHORT, small_rig

AWAY_UM = 300.0


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """One for all tests: each ends with the probe taken away."""
    file = small_rig(tmp_path_factory.mktemp("rig"))
    overrides = {"specimen": {"preset": "slip_corrected"}}
    with open_rig(file, fake=True, seed=2, clock=SimulatedClock(), devices="probe", world_overrides=overrides) as rig:
        yield rig


@pytest.fixture(autouse=True)
def free(rig):
    rig.simulation.world.pressed.clear()
    yield
    rig.simulation.world.pressed.clear()
    rig.clock.sleep(0.1)
    assert not rig.safety.tripped


class Steps(SilentProgress):
    """Calls something when a step begins whose name starts so."""

    def __init__(self, begin, then):
        self._begin, self._then = begin, then

    def step(self, text):
        if text.startswith(self._begin):
            self._then()


def probe_um(rig):
    return rig.devices["probe_stage"].read().x_um


def later(rig, after_s, what):
    rig.clock.call_at(rig.clock.now_ns() + round(after_s * NS_PER_S), what)


def interrupt():
    raise KeyboardInterrupt


def run(rig, settings=SHORT, steps=None, experiment=None):
    """Characterise; returns the characterisation and what ended it."""
    characterisation = Characterisation(experiment or PressExperiment(rig, settings))
    try:
        characterisation.run(steps or SilentProgress(), check=False)
    except MicrodriversError as error:
        return characterisation, error
    return characterisation, None


def test_no_contact_within_the_travel(rig):
    characterisation, error = run(rig, SHORT._replace(most_approach_um=20.0))
    assert isinstance(error, NoContact)
    assert "no contact within 20 µm" in error.what
    assert characterisation.first is None
    assert probe_um(rig) > -410.0 + AWAY_UM


def test_an_interruption_of_the_approach_takes_the_probe_away(rig):
    steps = Steps("approach until contact", lambda: later(rig, 0.5, interrupt))
    experiment = PressExperiment(rig, SHORT)
    characterisation, error = run(rig, steps=steps, experiment=experiment)
    assert isinstance(error, NoContact)
    assert characterisation.interrupted
    assert experiment.whereabouts.startswith(f"probe_stage stands at x {probe_um(rig):.1f} µm, y ")
    assert experiment.whereabouts.endswith("; no contact was felt")
    assert probe_um(rig) > -410.0 + AWAY_UM


def test_an_interruption_of_the_press_keeps_what_was_measured_and_takes_the_probe_away(rig):
    steps = Steps("pressing at", lambda: later(rig, 1.3, interrupt))
    experiment = PressExperiment(rig, SHORT)
    characterisation, error = run(rig, steps=steps, experiment=experiment)
    assert error is None
    assert characterisation.interrupted
    before_um = int(re.search(r"(\d+) µm before the contact$", experiment.whereabouts)[1])
    assert AWAY_UM < before_um < AWAY_UM + 200
    assert len(characterisation.first.samples) > 30
    assert probe_um(rig) > -490.0 + AWAY_UM


def test_a_guard_that_trips_on_the_way_back_leaves_a_partial_result(rig):
    def too_much():
        rig.simulation.world.pressed["probe_force"] = lambda _t_ns: 1600.0 if probe_um_now() < -440.0 else 0.0

    axis = rig.simulation.world.fine_stage_axes["probe_stage"]["x"]

    def probe_um_now():
        return axis.position_at(rig.clock.now_ns())

    steps = Steps("pressing at", lambda: later(rig, 1.9, too_much))
    characterisation, error = run(rig, steps=steps)
    assert isinstance(error, MoveCancelled)
    assert "force guard" in error.what
    assert probe_um(rig) > -490.0 + AWAY_UM
    partial = characterisation.partial(error)
    assert not partial.complete
    assert partial.ended_by == error.what
    assert partial.identification.protocols["loading"].k1_uN_per_um == pytest.approx(5.8781, rel=0.1)


class Blind:
    """A tracker that sees nothing any more after some frames."""

    def __init__(self, tracker, frames):
        self._tracker, self._left = tracker, frames

    def update(self, frame):
        self._left -= 1
        seen = self._tracker.update(frame)
        return seen if self._left >= 0 else msgspec.structs.replace(seen, found=False, deformation_um=float("nan"))


def test_a_contact_point_that_is_lost_ends_the_press(rig, monkeypatch):
    prepare = PressExperiment.prepare
    monkeypatch.setattr(PressExperiment, "prepare", lambda self, progress: Blind(prepare(self, progress), 45))
    characterisation, error = run(rig)
    assert isinstance(error, TargetLost)
    assert "was not seen in 15 frames" in error.what
    assert len(characterisation.first.frames) == 45
    assert characterisation.first.unmatched["LOST"] >= 15
    assert probe_um(rig) > -490.0 + AWAY_UM


def test_the_limit_of_force_ends_the_press_before_the_guard_must_act(rig, monkeypatch):
    depths_um = []

    def watched(*arguments, **lengths):
        depths_um.append(lengths["depth_um"])
        return contact_patch(*arguments, **lengths)

    monkeypatch.setattr(sight, "contact_patch", watched)
    characterisation, error = run(rig, SHORT._replace(max_force_uN=200.0))
    assert error is None
    assert 190.0 < max(sample.force_uN for sample in characterisation.first.samples) < 215.0
    assert set(depths_um) == {SHORT.depth_um}  # the patch stays in view as deep as is pressed


def test_a_limit_that_ends_the_press_at_once_is_named(rig):
    characterisation, error = run(rig, SHORT._replace(max_force_uN=20.0))
    assert isinstance(error, DataError)
    assert not isinstance(error, NoContact)
    assert "turned back at" in error.what
    assert "beyond the limit of 20 µN" in error.what
    assert "press slower than 40 µm/s" in error.remedy
    assert len(characterisation.first.frames) > 20
    assert probe_um(rig) > -490.0 + AWAY_UM


def test_the_speed_that_a_guard_allows_is_kept_on_free_ways(rig, monkeypatch):
    monkeypatch.setattr(type(rig.safety), "max_speed_um_s", lambda _self, _sensor: 300.0)
    speeds_um_s = []
    start = rig.devices["probe_stage"].start_move_to
    monkeypatch.setattr(
        type(rig.devices["probe_stage"]), "start_move_to",
        lambda _self, **asked: speeds_um_s.append(asked["speed_um_s"]) or start(**asked),
    )  # fmt: skip
    steps = Steps("approach until contact", lambda: later(rig, 0.1, interrupt))
    run(rig, steps=steps)
    assert len(speeds_um_s) > SHORT.free_steps
    assert max(speeds_um_s) == pytest.approx(300.0)


def test_settings_that_cannot_be_are_refused(rig):
    for change in ({"speed_um_s": 300.0}, {"depth_um": 0.0}, {"max_force_uN": 1600.0}):
        with pytest.raises(OutOfRange):
            PressExperiment(rig, SHORT._replace(**change))
