"""These tests need devices that a container lacks; `make test-vm` runs them in a guest that has them."""

import os

import pytest


@pytest.fixture(autouse=True)
def _in_the_guest():
    if os.environ.get("VCAN_RUN") != "qemu":
        pytest.skip("needs the guest's devices: make test-vm")
