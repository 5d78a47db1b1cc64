"""What is refused is refused with a remedy that helps: the rig file is blamed for its own limits only."""

import pytest

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import OutOfRange
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.rig import build_rig


def test_a_zero_speed_and_a_tare_of_no_time_are_no_affair_of_the_rig_file():
    with build_rig(shipped_rig(), fake=True, clock=SimulatedClock()) as rig:
        stage, sensor = rig.device("sample_stage", XYThetaStage), rig.device("probe_force", ForceSensor)
        stage.reference(["x"])
        calls = (
            lambda: stage.move_to(x_um=7000.0, speed_um_s=0.0),
            lambda: stage.start_axis_to("x", 7000.0, speed=0.0),
            lambda: sensor.tare(0.0),
            lambda: sensor.stream(0.0).__enter__(),
        )
        for call in calls:
            with pytest.raises(OutOfRange) as caught:
                call()
            assert "rig file" not in caught.value.remedy
        with pytest.raises(OutOfRange, match="speed") as caught:
            stage.move_to(x_um=7000.0, speed_um_s=1e9)
        assert "correct the limits in the rig file" in caught.value.remedy
