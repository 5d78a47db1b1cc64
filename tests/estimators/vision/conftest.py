from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


def _load(name: str) -> ModuleType:
    path = Path(__file__).with_name(f"{name}.py")
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def scene() -> ModuleType:
    """The analytic renderer of squares, and the maker of frames."""
    return _load("square_scene")


@pytest.fixture(scope="session")
def textures() -> ModuleType:
    """The analytic renderer of texture."""
    return _load("texture_scene")


@pytest.fixture(scope="session")
def contact_scenes() -> ModuleType:
    """The analytic renderer of a probe that presses on a specimen."""
    return _load("contact_scene")
