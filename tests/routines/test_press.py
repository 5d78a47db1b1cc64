"""The live experiment on an emulated probe: whatever ends it, the probe goes away and what was measured is kept."""

import re
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from microdrivers.core.clock import SimulatedClock
from microdrivers.core.clock.interruption import INTERRUPTION
from microdrivers.core.errors import (
    DataError,
    LinkLost,
    MicrodriversError,
    MoveCancelled,
    NoContact,
    OutOfRange,
    StaleCalibration,
    TargetLost,
    UnsafeError,
)
from microdrivers.core.units import NS_PER_S, Range
from microdrivers.devices.force_sensor import Tare
from microdrivers.estimators.vision.contact_patch import contact_patch
from microdrivers.rig import open_rig
from microdrivers.rig.safety_keep_out import KeepOut
from microdrivers.rig.safety_section import KeepOutBox
from microdrivers.routines.force import Characterisation, PressExperiment, sight
from microdrivers.routines.force.probe_drive import ProbeDrive
from microdrivers.routines.progress import SilentProgress
from tests.routines.small_rig import SHORT, small_rig

AWAY_UM, RETRACT_UM = 300.0, 400.0
SETTLED_S = 0.1
"""So long after a force has gone the sensor, which lags, reads none: a tare may begin."""


@pytest.fixture
def rig(tmp_path):
    file = small_rig(tmp_path)
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
    assert "no contact within 20 µm: the force" in error.what
    assert "less deeply" not in error.remedy
    assert characterisation.first is None
    assert probe_um(rig) > -410.0 + AWAY_UM


def test_no_contact_before_the_travel_leaves_no_more_than_the_depth(rig):
    _, error = run(rig, SHORT._replace(depth_um=225.0))
    assert isinstance(error, NoContact)
    assert "no contact within 10 µm, where the stage's travel leaves just the 225 µm to be pressed" in error.what
    assert error.remedy.endswith("or press less deeply")


def test_where_the_probe_was_last_seen_tells_no_force_that_is_none(rig):
    experiment = PressExperiment(rig, SHORT)
    experiment.prepare(SilentProgress())
    assert re.search(r"contact, with \S+ µN felt$", experiment._last_seen())
    unread = msgspec.structs.replace(rig.devices["probe_force"].topic.latest, force_uN=float("nan"))
    rig.devices["probe_force"].topic.publish(unread)
    told = experiment._last_seen()
    assert told.startswith("the probe was not taken farther away: probe_stage was last seen at x ")
    assert told.endswith("µm before the contact")


@pytest.mark.parametrize("begin", ["tare", "the probe's travel in sight"])
def test_an_interruption_before_the_approach_takes_the_probe_away_too(rig, begin):
    experiment = PressExperiment(rig, SHORT)
    characterisation, error = run(rig, steps=Steps(begin, lambda: later(rig, 0.1, interrupt)), experiment=experiment)
    assert isinstance(error, NoContact)
    assert characterisation.interrupted
    assert experiment.whereabouts.endswith("; no contact was felt")
    assert probe_um(rig) > -390.0 + AWAY_UM


def test_an_interruption_of_the_approach_takes_the_probe_away(rig):
    steps = Steps("approach until contact", lambda: later(rig, 0.5, interrupt))
    experiment = PressExperiment(rig, SHORT)
    characterisation, error = run(rig, steps=steps, experiment=experiment)
    assert isinstance(error, NoContact)
    assert characterisation.interrupted
    assert experiment.whereabouts.startswith(f"probe_stage stands at x {probe_um(rig):.1f} µm, y ")
    assert experiment.whereabouts.endswith("; no contact was felt")
    assert probe_um(rig) > -410.0 + AWAY_UM


@pytest.mark.parametrize("begin", ["identifying", "at the end"])
def test_a_first_interruption_after_the_press_waits_until_the_probe_is_away(rig, monkeypatch, begin):
    steps = Steps("identifying the specimen", INTERRUPTION.request if begin == "identifying" else lambda: None)
    experiment = PressExperiment(rig, SHORT)
    take_away = ProbeDrive.take_away

    def taking_away(drive):
        if begin == "at the end":
            INTERRUPTION.request()
        take_away(drive)

    monkeypatch.setattr(ProbeDrive, "take_away", taking_away)
    characterisation, error = run(rig, steps=steps, experiment=experiment)
    assert (error, characterisation.first.ended) == (None, True)
    with pytest.raises(KeyboardInterrupt):
        INTERRUPTION.check()
    assert experiment.whereabouts.endswith("µm before the contact")
    assert probe_um(rig) > -490.0 + AWAY_UM


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


@pytest.mark.parametrize("ended", [LinkLost("the port is gone", remedy="plug it in"), KeyboardInterrupt()])
def test_a_probe_that_cannot_be_taken_away_is_said_to_press_and_where(rig, monkeypatch, ended):
    def fail():
        raise ended

    def fail_later():
        monkeypatch.setattr(rig.devices["probe_stage"], "retract", fail)
        monkeypatch.setattr(rig.devices["zoom"], "read", fail)
        monkeypatch.setattr(type(rig), "fake", False)  # an emulated rig ends with the program that told of it
        interrupt()

    experiment = PressExperiment(rig, SHORT)
    characterisation = Characterisation(experiment)
    with pytest.raises(type(ended)) as caught:
        characterisation.run(Steps("pressing at", lambda: later(rig, 1.0, fail_later)), check=False)
    assert experiment.setup().zoom == pytest.approx(rig.devices["zoom"].topic.latest.zoom)
    monkeypatch.undo()
    saw = re.match(
        r"the probe was not taken away and may be pressing: probe_stage was last seen at x (-\d+\.\d) µm, y .* µm, "
        r"(\d+) µm beyond the contact, with (\d+\.?\d*) µN felt$",
        experiment.whereabouts,
    )
    assert float(saw[1]) == pytest.approx(probe_um(rig), abs=1.0)
    assert float(saw[3]) > 10.0
    if isinstance(ended, LinkLost):
        assert str(caught.value).startswith(f"{experiment.whereabouts}. the port is gone")
        assert f"{rig.description.file} probe_stage --retract; or free it by hand. plug it in" in caught.value.remedy
    assert characterisation.interrupted
    assert not rig.devices["probe_stage"].read().moving
    assert characterisation.first.samples
    rig.devices["probe_stage"].retract().wait()


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
    assert -490.0 + AWAY_UM < probe_um(rig) < -400.0 + RETRACT_UM  # once
    partial = characterisation.partial(error)
    assert not partial.complete
    assert partial.ended_by == error.what
    assert partial.identification.protocols["loading"].k1_uN_per_um == pytest.approx(5.8781, rel=0.1)


def test_a_guard_that_trips_while_the_press_is_ended_is_what_ended_it(rig):
    since_ns = []

    def rising_uN(t_ns):
        return 0.0 if probe_um_now() > -440.0 else 1200.0 if t_ns < since_ns[0] + 12_000_000 else 1600.0

    def too_much():
        since_ns.append(rig.clock.now_ns())
        rig.simulation.world.pressed["probe_force"] = rising_uN

    axis = rig.simulation.world.fine_stage_axes["probe_stage"]["x"]

    def probe_um_now():
        return axis.position_at(rig.clock.now_ns())

    told = []
    steps = Steps("pressing at", lambda: later(rig, 1.1, too_much))
    begin = steps.step
    steps.step = lambda text: (told.append(text), begin(text))
    _, error = run(rig, SHORT._replace(max_force_uN=999.9), steps=steps)
    assert [text for text in told if text.startswith("pressing")] == ["pressing at 40 µm/s, to 30 µm or 999.9 µN"]
    assert isinstance(error, MoveCancelled)
    assert "the force guard intervened: probe_force feels" in error.what
    assert "far enough" not in error.what
    assert -490.0 + AWAY_UM < probe_um(rig) < -400.0 + RETRACT_UM  # once


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
    assert characterisation.first.turned_at_uN == 200.0
    assert set(depths_um) == {SHORT.depth_um}  # the patch stays in view as deep as is pressed


@pytest.mark.parametrize(
    ("later_s", "tells"),
    [
        pytest.param(0.0, r"up to [\d.]+ µN was felt, but so briefly that none of the \d+ frames", id="between frames"),
        pytest.param(0.011, r"the force leaves its noise in only 1 of \d+ frames, by up to ", id="in one frame"),
    ],
)
def test_a_limit_that_ends_the_press_at_once_is_named(rig, later_s, tells):
    rig.clock.sleep(later_s)
    characterisation, error = run(rig, SHORT._replace(max_force_uN=20.0))
    assert isinstance(error, DataError)
    assert not isinstance(error, NoContact)
    assert "turned back at" in error.what
    assert "beyond the limit of 20 µN" in error.what
    assert error.remedy.startswith("allow more force: --max-force-uN")
    assert error.remedy.endswith("press more slowly than 40 µm/s")
    assert len(characterisation.first.frames) > 20
    assert probe_um(rig) > -490.0 + AWAY_UM
    assert characterisation.partial(error) is None
    assert re.match(tells, characterisation.tells_nothing)


def test_a_noisy_sensor_is_tared_so_long_that_a_drift_shows(rig, monkeypatch):
    sensor, taken_s = rig.devices["probe_force"], []
    monkeypatch.setattr(sensor, "tare", lambda duration_s: taken_s.append(duration_s) or noisy)
    noisy = Tare(t_ns=0, offset_uN=0.0, sigma_uN=2.0, n=40)
    experiment = PressExperiment(rig, SHORT)
    experiment._tare()
    assert taken_s == [SHORT.tare_s, pytest.approx(2.05, abs=0.1)]
    taken_s.clear()
    noisy = Tare(t_ns=0, offset_uN=0.0, sigma_uN=0.05, n=40)
    experiment._tare()
    assert taken_s == [SHORT.tare_s]


def test_a_limit_that_noise_hides_a_touch_from_is_refused(rig):
    _, error = run(rig, SHORT._replace(max_force_uN=1.5))
    assert isinstance(error, OutOfRange)
    assert "a touch shows from 1 µN on in the noise of probe_force, which is not clear of the 1.5 µN" in error.what
    assert "--max-force-uN" in error.remedy


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


@pytest.mark.parametrize(
    ("range_uN", "guard_uN", "tare_uN", "limit_uN"),
    [
        ((-2000.0, 2000.0), None, 0.0, 1600.0),
        ((0.0, 2000.0), None, 0.0, 1600.0),
        ((-100.0, 2000.0), None, 0.0, 1600.0),
        ((-2000.0, 2000.0), None, 450.0, 1240.0),
        ((-2000.0, 2000.0), None, -450.0, 1960.0),
        ((-2000.0, 2000.0), 1500.0, 0.0, 1200.0),
        ((-2000.0, 2000.0), 1500.0, 600.0, 1120.0),
        ((0.0, 500.0), 1500.0, 0.0, 400.0),
    ],
)
def test_a_push_may_use_most_of_what_guard_and_sensor_leave(range_uN, guard_uN, tare_uN, limit_uN):
    known = {"guard_uN": guard_uN, "tare_uN": tare_uN}
    assert SHORT.limit_uN(Range(*range_uN), **known) == pytest.approx(limit_uN)
    assert SHORT._replace(max_force_uN=300.0).limit_uN(Range(*range_uN), **known) == 300.0
    with pytest.raises(OutOfRange, match="is not between 0 and"):
        SHORT._replace(max_force_uN=limit_uN / 0.8 + 1.0).limit_uN(Range(*range_uN), **known)


@pytest.mark.parametrize(("end_uN", "tare_uN"), [(0.0, 0.0), (2000.0, 2001.0)])
def test_a_sensor_that_can_feel_no_push_is_refused(end_uN, tare_uN):
    with pytest.raises(OutOfRange, match="leaves no force to press with"):
        SHORT.limit_uN(Range(-2000.0, end_uN), guard_uN=1500.0, tare_uN=tare_uN)


def test_a_zoom_that_cannot_be_asked_is_not_known_and_contradicts_a_calibration(rig, monkeypatch):
    camera = rig.devices["camera_fine"]
    now = camera.settings
    zoom = sight.zoom_of(rig)
    result = SimpleNamespace(
        valid_for=SimpleNamespace(camera=camera.name, zoom=zoom, binning=now.binning, roi=tuple(now.roi))
    )
    sight._require_same(result, camera, rig, Path("result.json"))
    monkeypatch.setattr(rig.devices["zoom"], "link", "closed")
    assert sight.zoom_of(rig) is None
    with pytest.raises(StaleCalibration, match="and zoom cannot be asked for its own"):
        sight._require_same(result, camera, rig, Path("result.json"))


def test_what_stage_and_guard_forbid_is_refused_before_anything_moves(rig, monkeypatch):
    with pytest.raises(OutOfRange, match="goes on for 235 µm, of which 1000 µm are to be pressed"):
        PressExperiment(rig, SHORT._replace(depth_um=1000.0))
    with pytest.raises(OutOfRange, match="back for 1015 µm, of which 1100 µm are needed"):
        PressExperiment(rig, SHORT._replace(free_travel_um=1100.0))
    monkeypatch.setattr(type(rig.safety), "max_speed_um_s", lambda _self, _sensor: 39.0)
    with pytest.raises(OutOfRange, match=r"its force guard allows \(max_speed_um_s\): 39 µm/s") as refused:
        PressExperiment(rig, SHORT)
    assert "--speed-um-s" in refused.value.remedy
    PressExperiment(rig, SHORT._replace(speed_um_s=39.0))


def test_a_keep_out_box_on_the_way_is_told_before_anything_moves(rig, monkeypatch):
    stage = rig.devices["probe_stage"]
    stage.reference([axis for axis in stage.reference_order if not stage.referenced[axis]] or ["x"])
    x, y, z = stage.tip_um({"x": -520.0, "y": 0.0, "z": 0.0})
    box = KeepOutBox(name="wall", min_um=(x - 20.0, y - 50.0, z - 50.0), max_um=(x + 20.0, y + 50.0, z + 50.0))
    monkeypatch.setattr(rig.safety, "keep_out", KeepOut([box]))
    with pytest.raises(UnsafeError, match="too near to the keep-out box 'wall'"):
        PressExperiment(rig, SHORT)
    monkeypatch.setattr(type(stage), "referenced", dict.fromkeys("xyz", False))
    with pytest.raises(UnsafeError, match="too near to the keep-out box 'wall'"):
        PressExperiment(rig, SHORT)


def test_a_keep_out_box_behind_the_surface_is_told_before_the_press(rig):
    stage = rig.devices["probe_stage"]
    x, y, z = stage.tip_um({"x": -500.0, "y": 0.0, "z": 0.0})
    box = KeepOutBox(name="wall", min_um=(x - 20.0, y - 50.0, z - 50.0), max_um=(x, y + 50.0, z + 50.0))
    free, rig.safety.keep_out = rig.safety.keep_out, KeepOut([box])
    try:
        characterisation, error = run(rig, SHORT._replace(most_approach_um=100.0, depth_um=60.0))
    finally:
        rig.safety.keep_out = free
    assert isinstance(error, UnsafeError)
    assert "presses is not free: the tip would come too near to the keep-out box 'wall'" in error.what
    assert characterisation.first is None


def test_a_picture_in_which_nothing_moves_asks_for_tip_and_specimen(rig):
    frames = [rig.devices["camera_fine"].grab() for _ in range(6)]
    with pytest.raises(DataError, match="nothing in the picture moved while the probe travelled 100 µm") as caught:
        sight.Sight().learn(frames, [20.0 * k for k in range(6)], scale_hint_px_per_um=0.25)
    assert "specimen" in caught.value.remedy


def test_a_force_that_stays_when_the_tool_goes_back_is_no_contact(rig):
    """Something else than the specimen bends the sensor: tared anew, and the specimen is found farther on."""
    world, told = rig.simulation.world, []

    def step(text):
        told.append(text)
        if text.startswith("approach until contact"):
            since_ns = rig.clock.now_ns() + round(0.4 * NS_PER_S)
            world.pressed["probe_force"] = lambda t_ns: 30.0 if t_ns > since_ns else 0.0
        elif text.startswith("no contact after"):
            world.pressed.clear()
            rig.clock.sleep(SETTLED_S)

    steps = SilentProgress()
    steps.step = step
    characterisation, error = run(rig, steps=steps)
    assert error is None
    alarm, contact = (next(text for text in told if text.startswith(begin)) for begin in ("no contact", "contact"))
    assert "it is the sensor's drift; tare, and on" in alarm
    alarm_um, contact_um = (float(re.search(r"after ([\d.]+) µm", text)[1]) for text in (alarm, contact))
    assert alarm_um < contact_um - 10.0
    assert max(sample.force_uN for sample in characterisation.first.samples) > 150.0


def test_false_contacts_that_come_no_farther_are_given_up(rig):
    """Each tare is followed by a force that begins at once: where the specimen is cannot be told."""
    world = rig.simulation.world

    def step(text):
        if not text.startswith(("approach until", "no contact after")):
            return
        world.pressed.clear()
        rig.clock.sleep(SETTLED_S)
        since_ns = rig.clock.now_ns() + round((SHORT.tare_s + 0.15) * NS_PER_S)
        world.pressed["probe_force"] = lambda t_ns: 30.0 if t_ns > since_ns else 0.0

    steps = SilentProgress()
    steps.step = step
    _, error = run(rig, steps=steps)
    assert isinstance(error, DataError)
    assert not isinstance(error, NoContact)
    assert "the sensor's zero drifts too fast to find the specimen" in error.what
    assert probe_um(rig) > -410.0 + AWAY_UM
