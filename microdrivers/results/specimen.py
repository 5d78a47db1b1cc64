"""Reads `specimen.yaml`, the model with which force is read from the camera alone."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Literal

import pydantic
import yaml

from microdrivers.core.errors import ConfigError
from microdrivers.estimators.force.model import SpecimenModel

_log = logging.getLogger(__name__)

_Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]
_Row = tuple[_Finite, _Finite, _Finite]


class _Part(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="ignore", frozen=True)


class _Slip(_Part):
    offset_um: _Finite
    rate_per_s: _Finite


class _ValidFor(_Part):
    deepest_um: Annotated[_Finite, pydantic.Field(gt=0.0)]
    fastest_um_s: Annotated[_Finite, pydantic.Field(gt=0.0)]
    fastest_unloading_um_s: Annotated[_Finite, pydantic.Field(gt=0.0)] | None = None


class _Specimen(_Part):
    schema_version: Literal[1]
    kind: Literal["specimen"]
    k1_uN_per_um: _Finite
    k2_uN_per_um3: _Finite
    b_uN_s_per_um: _Finite
    b_unloading_uN_s_per_um: _Finite
    m_kg: _Finite | None
    covariance_of_k1_k2_b: tuple[_Row, _Row, _Row] | None
    contact_um: _Finite
    residual_uN: Annotated[_Finite, pydantic.Field(ge=0.0)]
    slip: _Slip | None
    misfit: bool = False
    valid_for: _ValidFor


def read_specimen(file: Path) -> SpecimenModel:
    """Read the `specimen.yaml` of a force characterisation.

    The model is that of the specimen when it was first touched: of one that slips, x = 0 lies farther in afterwards.
    The log warns of one that does not explain its own record.

    Returns:
        What `microdrivers.estimators.force.vision_force.VisionForce` needs.

    Raises:
        ConfigError: it is not one, is damaged, or lacks `contact_um` or `residual_uN`, as files of before had it.
    """
    try:
        found = _Specimen.model_validate(yaml.safe_load(file.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, pydantic.ValidationError) as error:
        raise ConfigError(
            f"not a specimen of schema version 1: {error}",
            file=str(file), remedy="give the specimen.yaml of `microdrivers calibrate force`",
        ) from error  # fmt: skip
    if found.misfit:
        _log.warning("%s: the model does not explain its specimen within noise (misfit): its force is no better", file)
    slip, covariance, valid_for = found.slip, found.covariance_of_k1_k2_b, found.valid_for
    return SpecimenModel(
        k1_uN_per_um=found.k1_uN_per_um,
        k2_uN_per_um3=found.k2_uN_per_um3,
        b_loading_uN_s_per_um=found.b_uN_s_per_um,
        b_unloading_uN_s_per_um=found.b_unloading_uN_s_per_um,
        m_kg=found.m_kg or 0.0,
        contact_um=found.contact_um,
        slip_um=0.0 if slip is None else slip.offset_um,
        slip_rate_per_s=0.0 if slip is None else slip.rate_per_s,
        covariance=() if covariance is None else tuple(value for row in covariance for value in row),
        residual_uN=found.residual_uN,
        deepest_um=valid_for.deepest_um,
        fastest_um_s=valid_for.fastest_um_s,
        fastest_unloading_um_s=valid_for.fastest_unloading_um_s or 0.0,
    )
