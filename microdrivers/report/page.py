"""The frame of every report: one HTML page that needs nothing but itself, with notes, provenance and how to repeat."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import resources
from typing import Any, NamedTuple, Protocol

import yaml
from jinja2 import Environment, FunctionLoader, StrictUndefined

from microdrivers.report.number_format import MINUS, compact
from microdrivers.results.record import Provenance

_REPEATING = {
    "simulated": "A simulated run gives the same bits again with the same version, rig file and seed.",
    "recorded": "The same recording analysed by the same version gives the same numbers.",
    "real": "On the rig, the same command repeats the experiment; the numbers then agree within their intervals.",
}


class Reported(Protocol):
    """What a page needs of a result."""

    @property
    def complete(self) -> bool:
        """False if the run was interrupted."""

    @property
    def notes(self) -> Sequence[str]:
        """What the reader must know."""

    @property
    def provenance(self) -> Provenance:
        """Where the result comes from."""


class RunKind(NamedTuple):
    """Where the data come from: `key` is simulated, recorded or real."""

    key: str
    label: str


def run_kind(provenance: Provenance) -> RunKind:
    """Simulated, recorded or real; a recording of a simulation is simulated."""
    recorded = provenance.clock == "recorded"
    if provenance.fake:
        return RunKind("simulated", "simulated, from a recording" if recorded else "simulated")
    return RunKind("recorded", "recorded") if recorded else RunKind("real", "real hardware")


def created(provenance: Provenance) -> str:
    """When the result was made, UTC to the minute; as it stands in the result if that is no ISO 8601 time."""
    text = provenance.created_utc
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return text
    return f"{(moment.astimezone(UTC) if moment.tzinfo else moment):%Y-%m-%d %H:%M} UTC"


def page(template: str, result: Reported, *, title: str, **values: Any) -> str:
    """Fill a template that extends `page.html.j2`; equal results give equal text.

    Args:
        template: file name of the template in this package.
        result: what is reported.
        title: of the page.
        values: what the template itself needs.
    """
    environment = Environment(
        loader=FunctionLoader(_template), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(compact=compact, setting=_setting)
    kind = run_kind(result.provenance)
    return environment.get_template(template).render(
        result=result,
        title=title,
        kind=kind,
        created=created(result.provenance),
        repeating=_REPEATING[kind.key],
        rig=yaml.safe_dump(result.provenance.rig, sort_keys=False, allow_unicode=True),
        **values,
    )


def _template(name: str) -> str:
    return resources.files("microdrivers.report").joinpath(name).read_text(encoding="utf-8")


def _setting(value: Any) -> str:
    """A setting as plain text."""
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_setting(each)}" for key, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_setting(each) for each in value)
    if isinstance(value, int | float):
        return str(value).replace("-", MINUS, 1) if value < 0 else str(value)
    return str(value)
