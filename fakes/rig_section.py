"""What an emulator is set to: its part of a device's section in the rig file."""

from __future__ import annotations

from typing import TypeVar

import pydantic

from microdrivers.core.errors import ConfigError
from microdrivers.devices.drivers import EmulationRequest

SectionT = TypeVar("SectionT", bound=pydantic.BaseModel)


def parse_settings(request: EmulationRequest, model: type[SectionT], *, remedy: str) -> SectionT:
    """The part of a device's settings that the emulator is set to.

    Raises:
        ConfigError: the device cannot be set to that.
    """
    try:
        return model.model_validate(dict(request.settings))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(
            f"{request.name}: the emulated device cannot be set to {first['input']!r}: {first['msg']}",
            remedy=remedy,
            key=".".join(str(part) for part in first["loc"]),
        ) from error
