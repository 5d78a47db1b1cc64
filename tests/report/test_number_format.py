import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.report.number_format import MINUS, compact, fixed, significant, with_uncertainty, without_exponents


@pytest.mark.parametrize(
    ("value", "half_width", "expected"),
    [
        (0.2432451, 0.0000123, ("0.243245", "0.000012")),
        (-93.40131, 0.00279, ("−93.4013", "0.0028")),
        (7955.04, 0.449, ("7955.04", "0.45")),
        (7955.04, 123.0, ("7960", "120")),
        (1.0, 0.0996, ("1.00", "0.10")),
        (-0.0000001, 0.001, ("0.0000", "0.0010")),
        (0.0, 0.25, ("0.00", "0.25")),
        (0.2432451, None, ("0.24325", "")),
        (0.2432451, math.inf, ("0.24325", "")),
        (0.2432451, 0.0, ("0.24325", "")),
        (0.2432451, 1e-15, ("0.2432451000", "< 0.0000000001")),
    ],
)
def test_uncertainty_has_two_digits_and_the_value_matches(value, half_width, expected):
    assert with_uncertainty(value, half_width)[:2] == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("8.8e-05 µN of noise, p = 6e-13", "8.8·10⁻⁵ µN of noise, p = 6·10⁻¹³"),
        ("2e+20 to -1.5e+07 in 2026-11-22", "2·10²⁰ to −1.5·10⁷ in 2026-11-22"),
        ("the estimate -0.446 of slip_corrected-2, 1e5x", "the estimate −0.446 of slip_corrected-2, 1e5x"),
    ],
)
def test_a_sentence_has_powers_of_ten_and_minus_signs(text, expected):
    assert without_exponents(text) == expected


@settings(deadline=None, max_examples=200)
@given(
    value=st.floats(-1e6, 1e6, allow_nan=False),
    relative=st.floats(1e-7, 10.0),
)
def test_text_says_the_number(value, relative):
    half_width = max(abs(value), 1.0) * relative
    text = with_uncertainty(value, half_width)
    read = float(text.value.replace(MINUS, "-"))
    assert abs(read - value) <= 0.5001 * 10.0**-text.decimals
    assert float(text.plus_minus) == pytest.approx(half_width, rel=0.051)
    assert "e" not in text.value + text.plus_minus
    assert "-" not in text.value


def test_fixed_has_a_true_minus_and_no_negative_zero():
    assert fixed(-1.25, 1) == "−1.2"
    assert fixed(-0.001, 2) == "0.00"
    assert fixed(3.0, 1, signed=True) == "+3.0"
    assert fixed(0.0, 1, signed=True) == "0.0"
    assert fixed(1234.0, -2) == "1200"


def test_significant_never_uses_an_exponent():
    assert significant(0.0000057, 2) == "0.0000057"
    assert significant(0.0996, 2) == "0.10"
    assert significant(-12345678.0, 3) == "−12300000"


@pytest.mark.parametrize(
    ("value", "text"), [(1.2, "1.2"), (0.0, "0"), (15000.0, "15000"), (0.97123, "0.9712"), (9.0, "9")]
)
def test_compact(value, text):
    assert compact(value) == text
