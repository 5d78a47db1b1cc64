"""What everything that moves must do in real time, with threads; for stages and zoom motors alike."""

from __future__ import annotations

import threading
from typing import Any

from microdrivers.core.errors import LinkError
from tests.conformance.checks import Suite

SUITE = Suite()


@SUITE.check
def a_stop_waits_for_no_exchange(bench: Any) -> None:
    """While another thread waits for an answer that never comes, `stop()` is through before that thread gives up."""
    device = bench.device
    order: list[str] = []
    asked = threading.Event()

    def ask() -> None:
        asked.set()
        try:
            device.read()
        except LinkError:
            order.append("the reader gave up")

    with bench.need(bench.silence)():
        reader = threading.Thread(target=ask)
        reader.start()
        asked.wait()
        bench.clock.sleep(0.05)  # until the reader waits for its answer
        device.stop()
        order.append("stopped")
        reader.join()
    assert order == ["stopped", "the reader gave up"]


@SUITE.check
def a_stop_from_a_subscriber_does_not_hang(bench: Any) -> None:
    """A guard stops the device from within the delivery of its own sample."""
    device = bench.device
    stopped = threading.Event()

    def stop_at_once(_sample: object) -> None:
        device.stop()
        stopped.set()

    subscription = device.topic.subscribe(stop_at_once)
    reader = threading.Thread(target=device.read, daemon=True)
    reader.start()
    assert stopped.wait(10.0), "stop() hangs in a subscriber's call"
    reader.join(10.0)
    assert not reader.is_alive()
    subscription.cancel()
    assert subscription.error_count == 0
