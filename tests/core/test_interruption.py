"""Ctrl-C at clean moments: kept while a rig is open, let through where the main program waits."""

from contextlib import ExitStack

import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.clock import simulated as simulated_module
from microdrivers.core.clock import system as system_module
from microdrivers.core.clock.interruption import INTERRUPTION, Interruption
from microdrivers.rig import open_rig


@pytest.fixture
def interruption(monkeypatch):
    fresh = Interruption()
    monkeypatch.setattr(simulated_module, "INTERRUPTION", fresh)
    monkeypatch.setattr(system_module, "INTERRUPTION", fresh)
    return fresh


def test_without_a_rig_it_happens_at_once(interruption):
    with pytest.raises(KeyboardInterrupt):
        interruption.request()


@pytest.mark.parametrize("make_clock", [SimulatedClock, SystemClock])
def test_with_a_rig_it_is_kept_until_the_clock_waits(interruption, make_clock):
    interruption.rig_opened()
    interruption.request()
    clock = make_clock()
    with pytest.raises(KeyboardInterrupt):
        clock.sleep(0.001)
    clock.sleep(0.001)  # once


def test_on_a_simulated_clock_it_waits_for_the_end_of_an_exchange(interruption):
    interruption.rig_opened()
    clock, done = SimulatedClock(), []

    def exchange():
        with clock.transaction():
            interruption.request()
            clock.sleep(0.01)
            done.append("exchanged")

    with pytest.raises(KeyboardInterrupt):
        exchange()
    assert done == ["exchanged"]


def test_a_second_one_does_not_wait(interruption):
    interruption.rig_opened()
    interruption.request()
    with pytest.raises(KeyboardInterrupt):
        interruption.request()


def test_while_waiting_it_happens_at_once(interruption):
    interruption.rig_opened()
    with interruption.waiting(), pytest.raises(KeyboardInterrupt):
        interruption.request()


def test_one_that_came_too_late_for_a_rig_does_not_meet_the_next(interruption):
    interruption.rig_opened()
    interruption.request()
    interruption.rig_closed()
    interruption.rig_opened()
    SimulatedClock().sleep(0.001)


def test_while_it_is_held_waiting_goes_on_and_a_second_one_does_not_wait(interruption):
    interruption.rig_opened()
    clock = SimulatedClock()
    with interruption.held():
        interruption.request()
        clock.sleep(0.01)
        with interruption.waiting():
            assert interruption.requested
    with pytest.raises(KeyboardInterrupt):
        interruption.check()
    interruption.check()  # once
    with interruption.held(), pytest.raises(KeyboardInterrupt):
        interruption.request()


def test_an_interruption_while_a_rig_is_closed_keeps_no_device_open(monkeypatch):
    stack = ExitStack()
    rig = stack.enter_context(open_rig(shipped_rig(), fake=True, clock=SimulatedClock()))
    first, *others = rig.devices.values()
    close = first.close

    def closing():
        INTERRUPTION.request()
        close()

    monkeypatch.setattr(first, "close", closing)
    with pytest.raises(KeyboardInterrupt):
        stack.close()
    assert [device.link for device in (first, *others)] == ["closed"] * len(rig.devices)
