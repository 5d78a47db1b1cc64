"""Whatever the delays: a reply that is taken answers the request that it is taken for."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import LinkTimeout, ProtocolError
from tests.backends.modbus_bench import ModbusBench, TardyUnit

delays_s = st.lists(st.sampled_from([0.0055, 0.0055, 0.02, 0.19, 0.205, 0.22, 0.24, 0.3, 0.45]), min_size=1, max_size=9)
steps = st.lists(
    st.tuples(st.sampled_from(["read", "read", "write", "post"]), st.integers(0, 0xFFFD), st.floats(0.0, 0.1)),
    min_size=1, max_size=8,
)  # fmt: skip


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
@settings(deadline=None, max_examples=80)
@given(delays_s=delays_s, steps=steps, seed=st.integers(0, 100))
def test_no_late_reply_is_taken_for_a_later_requests(
    framing: str, delays_s: list[float], steps: list[tuple[str, int, float]], seed: int
) -> None:
    unit = TardyUnit(delays_s, framing=framing)
    bench = ModbusBench(unit, framing=framing, seed=seed)
    for action, address, pause_s in steps:
        seen = len(unit.sampled_ns)
        try:
            if action == "read":
                (replied_address, number), t_ns, dt_ns = bench.master.read(address, 2)
                assert replied_address == address
                assert number >= seen
                assert abs(unit.sampled_ns[number] - t_ns) <= dt_ns + 1
            elif action == "write":
                bench.master.write(address, 7)
            else:
                bench.master.post(address, (9,))
        except (LinkTimeout, ProtocolError):
            assert max(delays_s) > 0.1
        bench.clock.sleep(pause_s)
