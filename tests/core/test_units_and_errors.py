"""Ranges refuse, errors say what to do."""

import math

import pytest

from microdrivers.core.errors import ConfigError, ConfigErrors, ConnectError, LinkTimeout, OutOfRange, ProtocolError
from microdrivers.core.units import Range, check_range


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(bad):
    with pytest.raises(OutOfRange, match="not a finite number"):
        check_range(bad, Range(-1, 1), what="target of axis x", unit="µm")


def test_nothing_is_clipped():
    assert check_range(1.0, Range(0, 1), what="x", unit="µm") == 1.0
    with pytest.raises(OutOfRange, match=r"x = 1\.00001 µm is outside 0 to 1 µm"):
        check_range(1.00001, Range(0, 1), what="x", unit="µm")


@pytest.mark.parametrize(
    ("value", "in_file", "correctable"),
    [
        (2.0, "both", True),
        (0.0, "both", True),
        (2.0, "max", True),
        (0.0, "max", False),
        (2.0, "", False),
        (0.0, "", False),
    ],
)
def test_only_limits_that_the_rig_file_states_are_to_be_corrected_there(value, in_file, correctable):
    with pytest.raises(OutOfRange) as caught:
        check_range(value, Range(0.5, 1.0), what="speed", unit="µm/s", in_file=in_file)
    assert "choose a value inside the limits" in caught.value.remedy
    assert ("rig file" in caught.value.remedy) == correctable


def test_limits_of_zero_are_limits():
    assert 0.0 in Range(0, 0)
    assert 1e-9 not in Range(0, 0)


def test_ranges_intersect_or_say_that_they_cannot():
    assert Range(0, 10).intersect(Range(5, 20)) == (5, 10)
    with pytest.raises(OutOfRange, match="no value in common"):
        Range(0, 1).intersect(Range(2, 3))


def test_an_error_names_device_cause_and_remedy():
    text = str(LinkTimeout("no reply", device="zoom", remedy="check power"))
    assert text == "zoom: no reply\n  to do: check power"


def test_refused_means_not_moved_and_a_failed_link_means_perhaps():
    assert OutOfRange("x").moved == "no"
    assert LinkTimeout("x").moved == "maybe"


def test_a_protocol_error_shows_what_was_sent_and_received():
    text = str(ProtocolError("not a number", sent=b"POS?\n", received=b"1=?\n"))
    assert "sent b'POS?\\n'" in text
    assert "received b'1=?\\n'" in text


def test_config_errors_name_file_line_column_and_key():
    error = ConfigError("unknown key", file="lab.yaml", line=3, column=5, key="axes.x", remedy="did you mean y?")
    assert str(error) == "lab.yaml:3:5: axes.x: unknown key\n  to do: did you mean y?"
    both = ConfigErrors("lab.yaml has 2 mistakes:", [error, error])
    assert str(both).count("lab.yaml:3:5") == 2
    assert isinstance(both, ConfigError)


def test_a_tree_shows_every_failure():
    tree = ConnectError("2 of 3:", [LinkTimeout("a", device="zoom"), LinkTimeout("b", device="stage", remedy="c")])
    assert str(tree).splitlines() == ["2 of 3:", "  - zoom: a", "  - stage: b", "      to do: c"]
