from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.oriental_az.backlash import Backlash
from microdrivers.core.errors import (
    LinkTimeout,
    NotReached,
    RefusedError,
)
from tests.backends.oriental_az_bench import INPUTS_OFF, Bench, at_steps, check_honesty, sheet
from tests.backends.oriental_az_peer import SheetDrive, with_crc

# ---------------------------------------------------------------------- moving


@pytest.mark.parametrize("home_end_holds", [True, False])
@pytest.mark.parametrize("distance", [0, 1, 37, 400, 3000, -900])
@pytest.mark.parametrize("rate_hz", [5.0, 60.0, 80.0])
def test_a_move_as_the_stream_tells_it(home_end_holds: bool, distance: int, rate_hz: float) -> None:
    bench = Bench(SheetDrive(position=1000, home_end_holds=home_end_holds)).opened()
    target = at_steps(1000 + distance)
    with bench.motor.stream(rate_hz):
        bench.clock.run_for(0.3)
        final = bench.motor.start_move_to(zoom=target).wait()
        bench.clock.run_for(0.8)
    assert final.on_target
    assert final.position_steps == 1000 + distance
    assert final.target_zoom == pytest.approx(target)
    check_honesty(bench)
    commanded_ns = next(t_ns for t_ns, _, data in bench.wire.log if data[1] == 0x10)
    after = [sample for sample in bench.samples if sample.t_ns - sample.dt_ns > commanded_ns]
    assert [moving for moving, _ in itertools.groupby(sample.moving for sample in after)] == [True, False]
    assert bench.motor.referenced


def test_nothing_is_retried_or_written_but_the_block() -> None:
    bench = Bench().opened()
    bench.motor.move_to(zoom=at_steps(3000))
    writes = [data for data in sheet(bench).requests if data[1] != 0x03]
    block = bytes.fromhex("0110005800102000000000 0000000100000BB8 00004E20 000F4240 000F4240 000003E8 00000001")
    assert writes == [INPUTS_OFF, with_crc(block)]  # the input word is unknown at first: a STOP may stand in it


def test_a_lost_reply_to_the_trigger_is_an_error_and_the_motor_counts_as_moving() -> None:
    bench = Bench().opened()
    bench.motor.move_to(zoom=at_steps(1100))
    sheet(bench).spoil = [lambda reply: b""] * 3  # 3: also both tries of the sample that follows
    target = at_steps(9000)
    with pytest.raises(LinkTimeout) as caught:
        bench.motor._command(9000, 1100)
    assert caught.value.moved == "maybe"
    with pytest.raises(LinkTimeout):
        bench.motor.read()
    sheet(bench).spoil = []
    assert bench.motor.read().target_zoom == pytest.approx(target)
    assert sheet(bench).commanded_positions == [1100, 9000]
    bench.clock.run_for(1.0)
    assert bench.motor.read().on_target
    check_honesty(bench)


def test_a_refused_block_leaves_the_target_as_it_was() -> None:
    bench = Bench().opened()
    bench.motor.move_to(zoom=at_steps(1500))
    bench.motor._settings = bench.motor._settings.model_copy(update={"acceleration_steps_s2": 0})
    with pytest.raises(RefusedError, match="8Ch: a setting is out of the drive's range"):
        bench.motor.start_move_to(zoom=2.0)
    bench.motor.read()
    sample = bench.motor.read()
    assert (sample.moving, sample.on_target) == (False, True)
    assert sample.target_zoom == pytest.approx(at_steps(1500))


def test_a_drive_that_does_not_start_is_not_on_target() -> None:
    bench = Bench().opened()
    sheet(bench).stuck = True
    with pytest.raises(NotReached):
        bench.motor.move_to(zoom=at_steps(1300))
    asked = [sample for sample in bench.samples if not math.isnan(sample.target_zoom)]
    assert asked
    assert not any(sample.on_target for sample in asked)


def test_another_masters_motion_is_seen() -> None:
    bench = Bench().opened()
    with bench.motor.stream(60.0):
        bench.clock.run_for(0.5)
        sheet(bench)._run(5000, 20_000, bench.clock.now_ns())
        bench.clock.run_for(0.6)
    moving = [sample.moving for sample in bench.samples]
    assert [value for value, _ in itertools.groupby(moving)] == [False, True, False]
    check_honesty(bench)


actions = st.lists(
    st.tuples(
        st.sampled_from(["move", "stop", "wait"]), st.integers(-200, 11_000), st.floats(0.0, 0.5)
    ),
    min_size=1, max_size=6,
)  # fmt: skip


@settings(deadline=None, max_examples=40)
@given(actions=actions, rate_hz=st.sampled_from([7.0, 30.0, 60.0]), home_end_holds=st.booleans())
def test_no_sequence_of_moves_and_stops_makes_the_stream_lie(
    actions: list[tuple[str, int, float]], rate_hz: float, home_end_holds: bool
) -> None:
    bench = Bench(SheetDrive(position=1000, home_end_holds=home_end_holds)).opened()
    with bench.motor.stream(rate_hz):
        for action, steps, pause_s in actions:
            if action == "move":
                bench.motor.start_move_to(zoom=at_steps(steps))
            elif action == "stop":
                bench.motor.stop()
            bench.clock.run_for(pause_s)
            check_honesty(bench)
            bench.samples.clear()
        bench.clock.run_for(1.5)
    assert not bench.samples[-1].moving
    assert bench.motor.referenced


@pytest.mark.parametrize(("rate_hz", "least"), [(60.0, 57), (80.0, 76)])
def test_stream_rates_at_115200_baud(rate_hz: float, least: int) -> None:
    bench = Bench().opened()
    with bench.motor.stream(rate_hz):
        bench.clock.run_for(1.0)
        at_rest = len(bench.samples)
        bench.motor.start_move_to(zoom=9.9)
        bench.clock.run_for(0.5)
    assert at_rest >= least
    assert len(bench.samples) - at_rest >= least / 2 - 3


# ---------------------------------------------------------------------- approach


def test_the_target_is_approached_from_below() -> None:
    bench = Bench(backlash_steps=50).opened()
    bench.motor.move_to(zoom=at_steps(3000))  # upwards: direct
    bench.motor.move_to(zoom=at_steps(3000))  # there already, on the right flank
    bench.motor.move_to(zoom=at_steps(2000))
    bench.motor.move_to(zoom=at_steps(2010))  # shorter than the play, but on the right flank
    bench.motor.move_to(zoom=at_steps(1500), approach="direct")
    bench.motor.move_to(zoom=at_steps(1510))  # the play is not taken up
    bench.motor.move_to(zoom=at_steps(1510), approach="above")
    assert sheet(bench).commanded_positions == [3000, 3000, 1900, 2000, 2010, 1500, 1410, 1510, 1610, 1510]


def test_after_a_stop_the_flank_is_not_known() -> None:
    bench = Bench(backlash_steps=50).opened()
    bench.motor.move_to(zoom=at_steps(3000))
    bench.motor.stop()
    bench.motor.move_to(zoom=at_steps(3010))
    assert sheet(bench).commanded_positions == [3000, 2910, 3010]


@settings(deadline=None, max_examples=200)
@given(
    play=st.integers(1, 300), start=st.integers(-500, 4000), target=st.integers(-500, 4000),
    approach=st.sampled_from(["below", "above"]),
)  # fmt: skip
def test_the_last_leg_takes_up_the_play(play: int, start: int, target: int, approach: Any) -> None:
    backlash = Backlash(play_steps=play, tolerance_steps=2, low_steps=-500, high_steps=4000)
    via = backlash.via(start, target, approach)
    last_leg = target - (start if via is None else via)
    sign, room = (1, target + 500) if approach == "below" else (-1, 4000 - target)
    if not room:  # at the end of the range the wanted side does not exist
        assert via is None
        return
    assert via is None or -500 <= via <= 4000
    assert sign * last_leg >= min(play, room)


@pytest.mark.parametrize("by_callback", [True, False])
def test_samples_come_in_order_whenever_a_move_is_commanded(by_callback: bool) -> None:
    bench = Bench(SheetDrive(position=1000)).opened()
    with bench.motor.stream(70.0):
        for phase in range(24):
            bench.clock.run_for(0.5 + phase * 0.0006)
            target = at_steps(1000 + 200 * (phase % 2))
            if by_callback:
                bench.clock.call_at(bench.clock.now_ns(), lambda zoom=target: bench.motor.start_move_to(zoom=zoom))
            else:
                bench.motor.start_move_to(zoom=target)
        bench.clock.run_for(0.5)
    rests = [sample for sample in bench.samples if sample.t_source == "computed"]
    assert len(rests) == 24
    assert [(sample.t_ns, sample.seq) for sample in bench.samples] == sorted(
        (sample.t_ns, bench.samples[0].seq + number) for number, sample in enumerate(bench.samples)
    )
