"""These tests need devices that a container lacks; `make test-vm` runs them in a guest that has them."""

import os

import pytest


@pytest.fixture(autouse=True)
def _in_the_guest():
    if os.environ.get("VCAN_RUN") != "qemu":
        pytest.skip("needs the guest's devices: make test-vm")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """In the guest there is no reason to skip: a test that does so is broken."""
    report = yield
    if report.skipped and "VCAN_RUN" in os.environ and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped in the guest: {report.longrepr}"
    return report
