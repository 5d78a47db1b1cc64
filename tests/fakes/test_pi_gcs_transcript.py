"""What pipython exchanges with a controller of one axis, byte for byte, as it was recorded.

The recording's other end was a program; only the values that were its own choice differ here: P-term and help texts.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.fakes.gcs_bench import NOT_READY, READY, Bench, BenchWorld, GcsBench, chained_settings

Exchange = tuple[bytes, bytes | None]
"""A request and its reply; None: the request is repeated, every 0.1 s, until it is answered as it is next time."""

CHECKED = (b"ERR?\n", b"0\n")

CONNECT: list[Exchange] = [
    (b"CSV?\n", b"2.0\n"),
    CHECKED,
    (b"*IDN?\n", b"(c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,0115500620,1.2.0.0\n"),
    CHECKED,
    (b"SAI?\n", b"1\n"),
    CHECKED,
    (b"CST?\n", b"1=M-111.1DG\n"),
    CHECKED,
]
STARTUP: list[Exchange] = [
    (b"SAI? ALL\n", b"1\n"),
    CHECKED,
    (b"CST?\n", b"1=M-111.1DG\n"),
    CHECKED,
    (b"\x18", b""),
    (b"ERR?\n", b"10\n"),
    (b"\x07", READY),
    CHECKED,
    (b"\x07", READY),
    CHECKED,
    (b"SAI?\n", b"1\n"),
    CHECKED,
    (b"SVO? 1\n", b"1=0\n"),
    CHECKED,
    (b"FRF? 1\n", b"1=0\n"),
    CHECKED,
    (b"RON 1 1\n", b""),
    CHECKED,
    (b"FRF 1\n", b""),
    (b"ERR?\n", b"5\n"),
    (b"SVO? 1\n", b"1=0\n"),
    CHECKED,
    (b"SVO 1 1\n", b""),
    CHECKED,
    (b"FRF 1\n", b""),
    CHECKED,
    (b"\x07", NOT_READY),
    (b"\x07", None),
    (b"\x07", READY),
    CHECKED,
    (b"FRF? 1\n", b"1=1\n"),
    CHECKED,
    (b"SVO 1 1\n", b""),
    CHECKED,
    (b"\x07", READY),
    CHECKED,
]
MOTION: list[Exchange] = [
    (b"TMN?\n", b"1=0.0000000\n"),
    CHECKED,
    (b"TMX?\n", b"1=15.0000000\n"),
    CHECKED,
    (b"VEL 1 5\n", b""),
    CHECKED,
    (b"MOV 1 8.5\n", b""),
    CHECKED,
    (b"\x07", READY),
    CHECKED,
    (b"SVO? 1\n", b"1=1\n"),
    CHECKED,
    (b"ONT? 1\n", b"1=0\n"),
    CHECKED,
    (b"ONT? 1\n", None),
    (b"ONT? 1\n", b"1=1\n"),
    CHECKED,
    (b"POS?\n", b"1=8.5000000\n"),
    CHECKED,
    (b"\x05", b"0\n"),
    CHECKED,
    (b"MOV 1 99\n", b""),
    (b"ERR?\n", b"7\n"),
    (b"MVR 1 -5e-05\n", b""),
    CHECKED,
    (b"ONT? 1\n", None),
    (b"ONT? 1\n", b"1=1\n"),
    (b"POS? 1\n", b"1=8.4999500\n"),
    CHECKED,
]
STOPS_AND_ERRORS: list[Exchange] = [
    (b"MOV 1 1\n", b""),
    CHECKED,
    (b"HLT 1\n", b""),
    (b"ERR?\n", b"10\n"),
    (b"\x18", b""),
    (b"ERR?\n", b"10\n"),
    CHECKED,
    (b"SPA? 1 1\n", b"1 1=200\n"),
    CHECKED,
    (b"VER?\n", b"FW_DSP: 01.002\n"),
    CHECKED,
    (b"SVO 1 0\n", b""),
    CHECKED,
    (b"MOV 1 1\n", b""),
    (b"ERR?\n", b"5\n"),
]


def fast_settings() -> dict[str, Any]:
    """As in the recording, 5 mm/s are allowed."""
    settings = chained_settings()
    for axis in ("x", "y"):
        settings["axes"][axis] |= {"max_speed_um_s": 10000, "acceleration_um_s2": 500000, "serial_number": "0115500620"}
    return settings


@pytest.mark.parametrize(
    ("prefix", "reply_prefix"), [(b"", b""), (b"1 ", b"0 1 "), (b"2 ", b"0 2 "), (b"2 0 ", b"0 2 ")]
)
def test_golden_transcript(prefix: bytes, reply_prefix: bytes) -> None:
    bench = Bench(fast_settings(), BenchWorld(start={"x": 4500.0, "y": 4500.0}), seed=1)
    exchanges = CONNECT + STARTUP + MOTION + STOPS_AND_ERRORS
    for (request, reply), (_, next_reply) in zip(exchanges, [*exchanges[1:], (b"", b"")], strict=True):
        bench.wait(0.01)
        if reply is not None:
            assert bench.ask(prefix + request) == (reply_prefix + reply if reply else b""), request
            continue
        assert next_reply is not None
        polls = 0
        while bench.ask(prefix + request) != reply_prefix + next_reply:
            bench.wait(0.1)
            polls += 1
            assert polls < 8, request


SEVERAL_AXES: list[Exchange] = [
    (b"SAI?\n", b"1 \n2 \n3\n"),
    (b"POS?\n", b"1=0.0000000 \n2=0.0000000 \n3=0.0000000\n"),
    (b"POS? 1 3\n", b"1=0.0000000 \n3=0.0000000\n"),
    (b"SVO 1 1 2 0\n", b""),
    (b"SVO?\n", b"1=1 \n2=0 \n3=0\n"),
    (b"SPA? 1 60\n", b"1 60=M-111.1DG\n"),
    (b"SPA 1 21 15\n", b""),
    CHECKED,
]


def test_golden_lines_of_several_axes() -> None:
    bench = GcsBench()
    for request, reply in SEVERAL_AXES:
        bench.wait(0.01)
        assert bench.ask(request) == reply, request
