"""What options of several commands share: their checks, and which of them exclude each other."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import click
from click.core import ParameterSource

COMPRESSION_HELP = "without loss: a third to a half smaller, 3 to 10 ms of processor time a megapixel."


def topic_patterns(topics: Sequence[str]) -> list[str] | None:
    """The names and patterns of all `--topics`; None if that was not given.

    Raises:
        ConfigError: it was given, and names nothing.
    """
    from microdrivers.core.errors import ConfigError

    patterns = [name.strip() for names in topics for name in names.split(",") if name.strip()]
    if topics and not patterns:
        raise ConfigError("--topics names no topic", remedy="name some, or leave out --topics for all of them")
    return patterns or None


class FiniteRange(click.FloatRange):
    """A number within a range, neither infinite nor NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As click's own."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


def given(name: str) -> bool:
    """Whether the user has given that parameter of the present command."""
    return click.get_current_context().get_parameter_source(name) is ParameterSource.COMMANDLINE


def fields_given(settings: object, options: Mapping[str, str]) -> dict[str, Any]:
    """Those fields of some settings that the user has given, by the options that set them."""
    return {field: getattr(settings, field) for option, field in options.items() if given(option)}


def refuse_options_given(reason: str, *, allowed: Collection[str], of_analysis: Collection[str] = ()) -> None:
    """Refuse what the user has given beside an option that makes it void.

    Args:
        reason: what that option does, as `--images replaces the rig`.
        allowed: names of the parameters that keep their meaning.
        of_analysis: and of those that may be tried on old data.

    Raises:
        ConfigError: something else was given on the command line.
    """
    from microdrivers.core.errors import ConfigError

    context = click.get_current_context()
    void = [
        _named(p, context.params.get(p.name))
        for p in context.command.params
        if p.name and given(p.name) and p.name not in {*allowed, *of_analysis}
    ]
    if void:
        tries = [_named(p, not p.default) for p in context.command.params if p.name in of_analysis]
        other = f"; what can be tried on old data: {', '.join(tries)}" if tries else ""
        raise ConfigError(
            f"{reason}, and there is no experiment to drive", remedy=f"leave out {', '.join(void)}{other}"
        )


def _named(parameter: click.Parameter, value: Any) -> str:
    """The option that gives that value: of a pair such as --record/--no-record, one or the other."""
    return max(parameter.secondary_opts if parameter.secondary_opts and value is False else parameter.opts, key=len)
