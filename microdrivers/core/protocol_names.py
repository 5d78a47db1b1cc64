"""The ways to fit an indentation and what they leave out; by itself, so that a command's help imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

ProtocolName = Literal["single", "unloading_springs", "loading_only", "slip_corrected", "loading"]
"""The paper's four ways to fit its model, Bilen et al., section III.C, and the loading part alone."""

PROTOCOLS: tuple[ProtocolName, ...] = get_args(ProtocolName)

MOST_AROUND_REVERSAL = 20
"""Samples that may be left out on either side of contact, reversals and release."""
