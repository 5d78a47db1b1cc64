"""A record whose units are doubtful is identified, and says so."""

import pytest

from microdrivers.estimators.force.identify import identify
from tests.estimators.force.indentations import part, real, recorded
from tests.estimators.force.indenter import Push


def told(record):
    return [note for note in identify(record).notes if note.startswith("units in doubt")]


def shallow():
    """30 µm of the paper's specimen: in mN, its force over the square of its depth is that of soft matter."""
    return recorded("unloading_springs", Push(depth_um=30.0))


def test_what_the_paper_has_is_not_doubted():
    assert told(shallow()) == []


def test_a_force_in_mN_is_doubted():
    record = shallow()
    (note,) = told(record._replace(force_uN=record.force_uN / 1e3, force_sigma_uN=0.0))
    assert "if the forces were in mN, multiply them by 1000" in note
    assert "held embryos have 3 to 6 µN/µm" in note


@pytest.mark.parametrize(("factor", "unit"), [(1.0 / 60.0, "minutes, multiply it by 60"), (150.0, "ms, divide it")])
def test_a_time_in_another_unit_is_doubted(factor, unit):
    record = shallow()
    (note,) = told(record._replace(time_s=record.time_s * factor))
    assert unit in note


def test_a_real_soft_hydrogel_is_doubted_and_yet_identified():
    record = real()
    (note,) = told(record)
    assert "mN" in note
    assert identify(part(record, 0.0, 1e9)).protocols["loading"].error_percent <= 5.6
