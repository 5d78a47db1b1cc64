"""The fine-stage suite on CAN controllers with registers, interrupts, bit timing and a state of their own.

QEMU's SJA1000s pass frames whole and at once: a controller set to another bit rate hears them all the same, and nobody
has to acknowledge. So a wrong bit rate shows in nothing here; `tests/backends` has it on the emulated bus.
"""

import pytest
import yaml

from tests.conformance.fine_stage_suite import SUITE
from tests.vm.can_controllers import BITRATE, DEVICES, HOST, bring_up, ip_link

pytestmark = pytest.mark.vm


@pytest.fixture(scope="module")
def stage_on_the_bus(tmp_path_factory):
    """One served stage for all checks."""
    from tests.conformance.tool_bench import served_fine_stage_bench
    from tests.vcan.quick_rig import quick_rig

    for channel in (HOST, DEVICES):
        bring_up(channel)
    with served_fine_stage_bench(can_interface=DEVICES, file=quick_rig(tmp_path_factory.mktemp("rig"))) as bench:
        yield bench


@pytest.mark.parametrize("name", SUITE.checks)
def test_fine_stage_on_controllers(name, stage_on_the_bus):
    from tests.conformance.tool_bench import bring_home

    bring_home(stage_on_the_bus.stage)
    SUITE.checks[name](stage_on_the_bus)


def test_the_controller_has_the_bit_rate_of_the_rig_file(stage_on_the_bus):
    from microdrivers.configs import shipped_rig

    rig = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    assert rig["devices"]["probe_stage"]["connection"]["bitrate"] == BITRATE
    told = ip_link("show", HOST)
    assert f"bitrate {BITRATE} " in told
    assert "sja1000" in told
    assert "ERROR-ACTIVE" in told
    assert 0.0 < stage_on_the_bus.stage.bus_load < 0.3
