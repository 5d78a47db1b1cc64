"""The same examples in every run: what a random search finds belongs into a test of its own. And strictness in CI."""

import os

import pytest
from hypothesis import settings

settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")

NO_SKIPS = bool({"MICRODRIVERS_NO_SKIPS", "VCAN_RUN"} & os.environ.keys())
"""Whether a test that is skipped has failed: in `.ci/run`, and in a guest, where all is there that tests need."""


def _refuse_skip(report):
    if NO_SKIPS and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} may not be skipped here (MICRODRIVERS_NO_SKIPS). {reason}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    return _refuse_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """A whole module can be skipped as it is imported."""
    return _refuse_skip((yield))
