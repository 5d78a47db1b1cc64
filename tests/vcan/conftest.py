"""These tests need a SocketCAN bus; `make test-vcan` provides one. There, a test that is skipped has failed."""

import os

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """There is no reason to skip where the bus was made for these tests."""
    report = yield
    if report.skipped and "VCAN_RUN" in os.environ and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped on vcan: {report.longrepr}"
    return report
