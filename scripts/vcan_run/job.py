"""What is to be run, and how it can fail before or beside the command itself."""

from __future__ import annotations

from dataclasses import dataclass

WRONG_USE = 2
RAN_TOO_LONG = 124
GUEST_FAILED = 125


@dataclass(frozen=True, kw_only=True)
class Job:
    """A command and the limits and surroundings that it gets.

    Attributes:
        virtual_time: a guest's clock counts what is done there and what is waited for, not the time that this takes.
    """

    command: tuple[str, ...]
    limit_s: int
    memory_mib: int
    modules: tuple[str, ...]
    show_boot_log: bool
    virtual_time: bool


class NotUsable(Exception):
    """Wrong use, or something is missing on this machine; the text says what to do."""


class GuestFailed(Exception):
    """The virtual machine ended without the command's exit status."""
