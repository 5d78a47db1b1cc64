"""What all results share: plain records that refuse unknown keys, and where they come from."""

from __future__ import annotations

from typing import Any, Literal

import pydantic

Trace = list[float | None]
"""One value a sample; None where it is undefined."""


class Record(pydantic.BaseModel):
    """A part of a result: immutable; NaN is never written, `None` stands where a figure is undefined."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Provenance(Record):
    """Where a result comes from; enough to make it again."""

    microdrivers_version: str
    created_utc: str
    command: str
    source: str
    rig_name: str
    rig_file: str
    rig: dict[str, Any]
    fake: bool
    seed: int | None
    clock: Literal["simulated", "system", "recorded"]
    devices: dict[str, dict[str, str]]
    settings: dict[str, Any]
    python: str
    platform: str
