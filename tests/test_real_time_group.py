"""Tests in real time run one after the other, by one worker."""

import pytest


@pytest.mark.xdist_group("real_time")
def test_a_group_has_a_worker(request):
    """pytest-xdist finds a test's group in its name, and says nothing if the name does not hold it."""
    if getattr(request.config.option, "loadgroup", False):
        assert request.node.nodeid.endswith("@real_time")
