"""Rates and gaps of a topic."""

import math

import pytest

from microdrivers.recording.recorded_channels import Stamps
from microdrivers.recording.survey import Survey

MS = 1_000_000


def surveyed(instants_ns):
    survey = Survey()
    for seq, t_ns in enumerate(instants_ns):
        survey.count_frame("camera", Stamps(t_ns, seq, seq))
    return survey.topics()["camera"]


def test_a_rate_is_that_between_pauses_and_the_longest_pause_is_told():
    found = surveyed([burst * 5000 * MS + frame * 20 * MS for burst in range(4) for frame in range(10)])
    assert found.usual_rate_hz == 50.0
    assert found.rate_hz == pytest.approx(39 / (15 + 9 * 0.02))
    assert found.longest_gap_s == pytest.approx(5 - 9 * 0.02)


def test_samples_that_come_late_or_twice_are_no_intervals():
    found = surveyed([0, 10 * MS, 10 * MS, 20 * MS, 15 * MS, 30 * MS, 30 * MS])
    assert (found.usual_rate_hz, found.longest_gap_s) == (100.0, 0.01)


@pytest.mark.parametrize("instants_ns", [[5], [5, 5], [5, 3]])
def test_without_a_later_sample_there_is_no_rate(instants_ns):
    found = surveyed(instants_ns)
    assert math.isnan(found.usual_rate_hz)
    assert math.isnan(found.longest_gap_s)


@pytest.mark.parametrize(("orders", "repeated"), [((1, 2, 2, 5), 1), ((3, 1, 2, 1), 1), ((-1, -1, -1, -1), 0)])
def test_samples_are_told_apart_by_their_order_where_they_have_one(orders, repeated):
    survey = Survey()
    for seq, order in enumerate(orders):
        survey.count_frame("camera", Stamps(seq, seq - repeated * (seq > 1), order))
    found = survey.topics()["camera"]
    assert (found.repeated, found.gaps) == (repeated, 0)


@pytest.mark.parametrize(("slow", "rate_hz"), [(16_000, 1000.0), (20_000, 100.0)])
def test_of_a_long_recording_intervals_of_all_its_parts_count(slow, rate_hz):
    """One part is slow, the other fast; the gap is not among the intervals that are kept."""
    instants = [index * 10 * MS for index in range(slow)]
    instants += [instants[-1] + index * MS for index in range(1, 36_002 - slow)]
    instants += [instants[-1] + 700 * MS]
    found = surveyed(instants)
    assert (found.usual_rate_hz, found.longest_gap_s) == (rate_hz, 0.7)
