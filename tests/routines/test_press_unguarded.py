"""A rig that states no force guard: the probe never presses on while the sensor gives no valid number."""

import json
import math

import msgspec
import pytest
import yaml

from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import (
    DataError,
    MicrodriversError,
    MoveCancelled,
    NoContact,
    OutOfRange,
    SaturatedData,
    TargetLost,
)
from microdrivers.core.samples import FineStageSample
from microdrivers.core.units import NS_PER_S
from microdrivers.rig import open_rig
from microdrivers.routines.force import Characterisation, PressExperiment
from microdrivers.routines.progress import SilentProgress
from tests.routines.small_rig import SHORT, small_rig

pytestmark = pytest.mark.xdist_group("two prepared probes")

AWAY_UM = 300.0
STALE_S, BRAKING_UM = 0.15, 1.0
SILENT = "no reading has come from probe_force for "
SAID = {"disconnect": "reports DISCONNECTED", "silence": SILENT, "hang": SILENT}
WHOLE_UM = SHORT.back_off_um + SHORT.depth_um
AT_ONE_SECOND_UM = 0.5 * SHORT.speed_um_s
STIFFNESS_UN_PER_UM = 60.0


class Steps(SilentProgress):
    """Remembers them, and calls something when one begins so."""

    def __init__(self, begin="", then=None):
        self.told = []
        self._begin, self._then = begin, then

    def step(self, text):
        self.told.append(text)
        if self._then is not None and text.startswith(self._begin):
            self._then()


class Press:
    """An open rig whose probe has found the specimen, and what may happen to it."""

    def __init__(self, rig):
        self.rig, self.clock = rig, rig.clock
        self.stage = rig.devices["probe_stage"]
        self._axis = rig.simulation.world.fine_stage_axes["probe_stage"]["x"]
        emulation = rig.simulation.emulations["probe_force"]
        self._medium, self._amplifier = emulation.medium, emulation.devices["amplifier"]
        self._silent = False
        self.experiment = PressExperiment(rig, SHORT)
        self.experiment.prepare(SilentProgress())
        self.start_um = self.x_um()
        self.zero_uN = 0.0

    def x_um(self, t_ns=None):
        return self._axis.position_at(self.clock.now_ns() if t_ns is None else t_ns)

    def spring_uN(self, t_ns):
        """A hard specimen, where the contact was felt; with the amplifier's zero."""
        depth_um = self.start_um - SHORT.back_off_um - self.x_um(t_ns)
        return self.zero_uN + STIFFNESS_UN_PER_UM * max(0.0, depth_um)

    def press(self, force_uN):
        self.rig.simulation.world.pressed["probe_force"] = force_uN

    def later(self, after_s, what):
        self.clock.call_at(self.clock.now_ns() + round(after_s * NS_PER_S), what)

    def disconnect(self):
        self._amplifier.disconnect_sensor(self.clock.now_ns())

    def silence(self):
        self._medium.detach(self._amplifier.node)
        self._silent = True

    def hang(self):
        """Nothing is published any more, not even that nothing comes."""
        self.rig.devices["probe_force"]._watch.cancel()
        self.silence()

    def indent(self, what=None, after_s=1.0, steps=None, indented=False, **settings):
        """Press once, from the start; returns how deep beyond the start, how long it took, and what ended it."""
        experiment = self.experiment
        experiment.settings = SHORT._replace(**settings)
        experiment._indented = indented
        deepest_um, begun_ns, error = 0.0, self.clock.now_ns(), None

        def watch(sample: FineStageSample):
            nonlocal deepest_um
            deepest_um = max(deepest_um, self.start_um - self.x_um(sample.t_ns))

        if what is not None:
            self.later(after_s, what)
        watching = self.stage.topic.subscribe(watch)
        try:
            experiment.indent(lambda: None, steps or SilentProgress())
        except MicrodriversError as raised:
            error = raised
        watching.cancel()
        return deepest_um, (self.clock.now_ns() - begun_ns) / NS_PER_S, error

    def restore(self):
        if self._silent:
            self._medium.attach(self._amplifier.node)
        self._silent = False
        self._amplifier.connect_sensor(self.clock.now_ns())
        self.rig.simulation.world.pressed.clear()
        self.zero_uN = 0.0
        self.clock.sleep(1.0)
        self.experiment._drive.go(self.experiment._contact.place_um - SHORT.back_off_um)


def rig_file(folder, **changes):
    """The small rig with few frames: what is seen matters little here."""
    file = small_rig(folder)
    data = yaml.safe_load(file.read_text(encoding="utf-8")) | changes
    data["devices"]["camera_fine"]["rate_hz"] = 5
    file.write_text(json.dumps(data), encoding="utf-8")
    return file


def opened(file):
    overrides = {"specimen": {"preset": "slip_corrected"}}
    return open_rig(file, fake=True, seed=2, clock=SimulatedClock(), devices="probe", world_overrides=overrides)


@pytest.fixture(scope="module")
def unguarded(tmp_path_factory):
    with opened(rig_file(tmp_path_factory.mktemp("rig"), safety="none")) as rig:
        yield Press(rig)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    with opened(rig_file(tmp_path_factory.mktemp("rig"))) as rig:
        yield Press(rig)


@pytest.fixture
def press(unguarded):
    yield unguarded
    unguarded.restore()


@pytest.fixture(params=["unguarded", "guarded"])
def either(request):
    press = request.getfixturevalue(request.param)
    yield press
    press.restore()


@pytest.mark.parametrize("what", SAID)
def test_a_press_ends_when_no_valid_force_comes(press, what):
    deepest_um, _, error = press.indent(getattr(press, what))
    assert isinstance(error, DataError)
    assert ("reports DISCONNECTED" if what == "disconnect" else "no reading has come from probe_force for ") in str(
        error
    )
    assert AT_ONE_SECOND_UM - 2.0 < deepest_um < AT_ONE_SECOND_UM + STALE_S * SHORT.speed_um_s + BRAKING_UM


@pytest.mark.parametrize("what", ["disconnect", "silence"])
def test_a_sensor_that_is_gone_before_a_press_lets_none_begin(press, what):
    deepest_um, _, error = press.indent(getattr(press, what), after_s=0.2)
    assert isinstance(error, DataError)
    assert deepest_um < BRAKING_UM


@pytest.mark.parametrize("what", ["disconnect", "silence"])
def test_a_probe_stays_at_its_deepest_point_only_while_valid_forces_come(either, what):
    """A guard leaves a stage at rest alone."""
    deepest_um, took_s, error = either.indent(getattr(either, what), after_s=1.8, hold_s=60.0)
    assert isinstance(error, DataError)
    assert "the probe does not go on without valid forces" in error.what
    assert deepest_um == pytest.approx(WHOLE_UM, abs=BRAKING_UM)
    assert took_s < 2.5


def test_a_force_that_grows_too_large_at_the_deepest_point_ends_the_stay(either):
    _, took_s, error = either.indent(lambda: either.press(lambda _t_ns: 2500.0), after_s=1.8, hold_s=60.0)
    assert took_s < 4.0
    if either.rig.safety.guards:
        assert isinstance(error, MoveCancelled)
        assert "the force guard intervened" in error.what
    else:
        assert error is None
        assert either.x_um() == pytest.approx(either.start_um, abs=BRAKING_UM)


def test_a_return_ends_when_no_valid_force_comes(press):
    _, took_s, error = press.indent(press.disconnect, after_s=1.8)
    assert isinstance(error, DataError)
    assert "reports DISCONNECTED" in error.what
    assert took_s < 1.9


@pytest.mark.parametrize("force_uN", [1990.0, 2500.0])
def test_a_jump_of_the_force_ends_the_press_also_beyond_the_range(press, force_uN):
    at_um = press.start_um - 20.0
    deepest_um, _, error = press.indent(
        lambda: press.press(lambda t_ns: force_uN if press.x_um(t_ns) < at_um else 0.0), after_s=0.5
    )
    assert error is None
    assert 20.0 < deepest_um < 20.0 + BRAKING_UM
    assert press.x_um() == pytest.approx(press.start_um, abs=BRAKING_UM)


def test_a_saturated_sensor_lets_no_press_begin(press):
    deepest_um, _, error = press.indent(lambda: press.press(lambda _t_ns: -2500.0), after_s=0.2)
    assert isinstance(error, SaturatedData)
    assert deepest_um < BRAKING_UM
    assert "at the end of its range" in error.what
    assert "-2" in error.what


def test_a_zero_of_the_amplifier_is_taken_off_the_range_that_is_left(press):
    press.zero_uN = 450.0
    press.press(press.spring_uN)
    press.clock.sleep(0.1)
    press.experiment._sensor.tare(0.2)
    _, _, error = press.indent(max_force_uN=1600.0)
    assert isinstance(error, OutOfRange)
    assert "1600 µN is not between 0 and the sensor's range at a zero of 4" in error.what
    steps = Steps()
    deepest_um, _, error = press.indent(steps=steps)
    assert error is None
    limit_uN = 0.8 * (2000.0 - 450.0)
    assert any(f"or {limit_uN:.0f}"[:-1] in step for step in steps.told)
    assert STIFFNESS_UN_PER_UM * (deepest_um - SHORT.back_off_um) == pytest.approx(limit_uN, rel=0.08)


def characterise(press, begin, then):
    """A whole characterisation, in which something happens in a step; returns it and what ended it."""
    steps = Steps(begin, then)
    characterisation = Characterisation(PressExperiment(press.rig, SHORT))
    with pytest.raises(MicrodriversError) as caught:
        characterisation.run(steps, check=False)
    return characterisation, caught.value


def test_what_was_measured_is_kept_and_the_probe_is_taken_away(press):
    characterisation, error = characterise(press, "pressing at", lambda: press.later(1.2, press.disconnect))
    assert "reports DISCONNECTED" in error.what
    forces_uN = [frame.force_uN for frame in characterisation.first.frames]
    assert len(forces_uN) >= 4
    assert max(force for force in forces_uN if math.isfinite(force)) > 20.0
    assert press.x_um() > press.start_um + AWAY_UM


@pytest.mark.parametrize("what", ["disconnect", "silence"])
def test_an_approach_ends_when_no_valid_force_comes(press, what):
    contact_um = press.start_um - SHORT.back_off_um
    characterisation, error = characterise(press, "approach until", lambda: press.later(0.5, getattr(press, what)))
    assert isinstance(error, DataError)
    assert not isinstance(error, NoContact)
    assert "does not go on without valid forces" in error.what
    assert characterisation.first is None
    assert press.x_um() > contact_um + AWAY_UM


def test_an_approach_that_meets_the_end_of_the_range_is_no_contact_to_press_on(press):
    at_um = press.start_um + 10.0
    press.press(lambda t_ns: 2500.0 if press.x_um(t_ns) < at_um else 0.0)
    _, error = characterise(press, "-", None)
    assert isinstance(error, SaturatedData)
    assert "at the end of its range on the approach, at 2" in error.what
    assert press.x_um() > at_um + AWAY_UM


def test_a_probe_without_a_way_out_goes_back_by_the_way_on_which_it_came(press, monkeypatch):
    monkeypatch.setattr(press.stage, "retract_um", None)
    _, error = characterise(press, "pressing at", lambda: press.later(1.2, press.disconnect))
    assert isinstance(error, DataError)
    assert press.x_um() > press.start_um + 40.0  # where the approach began


def test_a_specimen_that_is_not_seen_is_not_waited_for(press, monkeypatch):
    class Blind:
        def update(self, frame):
            return msgspec.structs.replace(press.tracked.update(frame), found=False, deformation_um=math.nan)

    press.tracked = press.experiment._watcher
    monkeypatch.setattr(press.experiment, "_watcher", Blind())
    begun_ns = press.clock.now_ns()
    _, _, error = press.indent(indented=True)
    assert isinstance(error, TargetLost)
    assert "was not seen in 15 frames" in error.what
    assert press.clock.now_ns() - begun_ns < 15 * NS_PER_S
