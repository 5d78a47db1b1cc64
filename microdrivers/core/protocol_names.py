"""Names of the ways to fit an indentation; a module of their own, so that a command's help imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

ProtocolName = Literal["single", "unloading_springs", "loading_only", "slip_corrected", "loading"]
"""The paper's four ways to fit its model, Bilen et al., section III.C, and the loading part alone."""

PROTOCOLS: tuple[ProtocolName, ...] = get_args(ProtocolName)
