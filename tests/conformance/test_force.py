"""The force-sensor suite in process, and over drivers with planted faults."""

import msgspec
import pytest

from microdrivers.backends.cia404.sensor import Cia404ForceSensor
from microdrivers.core.errors import MicrodriversError
from tests.conformance.force_suite import SUITE
from tests.conformance.tool_bench import force_bench


@pytest.mark.parametrize("device", ["probe_force", "gripper_force"])
@pytest.mark.parametrize("name", SUITE.checks)
def test_force_sensor_in_process(name, device):
    with force_bench(device) as bench:
        SUITE.checks[name](bench)


class WrongSign(Cia404ForceSensor):
    def _sample(self, raw_uN, **stamp):
        return super()._sample(-raw_uN, **stamp)


class NanonewtonsForMicronewtons(Cia404ForceSensor):
    def _sample(self, raw_uN, **stamp):
        return super()._sample(raw_uN / 1000.0, **stamp)


class SaturationUnsaid(Cia404ForceSensor):
    def _sample(self, raw_uN, **stamp):
        sample = super()._sample(raw_uN, **stamp)
        return msgspec.structs.replace(sample, force_uN=raw_uN, flags=frozenset())


class RawIsTared(Cia404ForceSensor):
    def _sample(self, raw_uN, **stamp):
        sample = super()._sample(raw_uN, **stamp)
        return msgspec.structs.replace(sample, raw_uN=sample.force_uN)


FOUND_BY = {
    WrongSign: "shows_the_force_that_presses",
    NanonewtonsForMicronewtons: "shows_the_force_that_presses",
    SaturationUnsaid: "says_when_it_is_saturated",
    RawIsTared: "keeps_raw_tare_and_force_apart",
}


@pytest.mark.parametrize("fault", FOUND_BY, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found_by_name(fault):
    found = (AssertionError, pytest.fail.Exception, MicrodriversError)
    with pytest.raises(found), force_bench("probe_force", fault) as bench:
        SUITE.checks[FOUND_BY[fault]](bench)
