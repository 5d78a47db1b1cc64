"""The force guard on a served bus: stage and sensor behind a serial CAN adapter, in real time."""

import pytest
import yaml

from microdrivers.core.contact_samples import Intervention
from microdrivers.core.errors import MoveCancelled
from microdrivers.devices.fine_stage import FineStage
from microdrivers.rig import build_rig, load_rig_file
from microdrivers.rig.serving import ServedRig
from tests.rig.guarded_rig import LIMIT_UN, SENSOR, STAGE, write_rig_file

# With the machine to themselves, by `make test-ports`: they run in real time, drives and host watching each other.
pytestmark = pytest.mark.ports

PATIENT_MS = 1000
RETRACT_UM = 400.0
SAFETY = {
    "force_guards": [{"sensor": SENSOR, "stage": STAGE, "max_force_uN": LIMIT_UN, "stale_after_ms": PATIENT_MS}],
    "keep_out": "none",
}


@pytest.fixture
def served(tmp_path):
    """The rig on its ports, and the world behind it."""
    file = write_rig_file(tmp_path, safety=SAFETY, stage={"heartbeat_ms": PATIENT_MS})
    pointing = tmp_path / "served.yaml"
    with ServedRig(load_rig_file(file), seed=3) as serving:
        serving.write(pointing)
        with build_rig(pointing) as rig:
            yield rig, serving.simulation.world


def test_a_served_rig_file_carries_the_guard_over(served):
    rig, _ = served
    data = yaml.safe_load(rig.description.file.read_text(encoding="utf-8"))
    assert data["emulated"] is True
    assert data["safety"]["force_guards"][0]["max_force_uN"] == LIMIT_UN


def test_the_stage_stops_and_the_tool_is_taken_away(served):
    rig, world = served
    interventions = []
    rig.bus.topic("safety", Intervention).subscribe(interventions.append)
    stage = rig.device(STAGE, FineStage)
    world.pressed[SENSOR] = lambda _t_ns: 0.0
    stage.reference(stage.reference_order)
    move = stage.start_move_to(x_um=-200.0, speed_um_s=50.0)
    rig.clock.sleep(0.5)
    world.pressed[SENSOR] = lambda _t_ns: 1.5 * LIMIT_UN
    with pytest.raises(MoveCancelled, match="force guard: probe_force feels 1"):
        move.wait()
    stopped_um = stage.read().x_um
    world.pressed[SENSOR] = lambda _t_ns: 0.0
    rig.safety.finish()
    assert [each.rule for each in interventions] == ["force limit", "retraction"]
    assert stage.read().x_um == pytest.approx(stopped_um + RETRACT_UM, abs=20.0)
    rig.clock.sleep(0.1)
    stage.move_to(x_um=0.0)
