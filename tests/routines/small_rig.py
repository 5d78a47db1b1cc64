"""The workstation made small, for force characterisations that take little time."""

from microdrivers.configs import shipped_rig
from microdrivers.routines.force import PressSettings

SHORT = PressSettings(
    speed_um_s=40.0, depth_um=30.0, rest_s=0.1, back_off_um=8.0, free_speed_um_s=1000.0, tare_s=0.2, free_steps=6
)


def small_rig(folder):
    """The workstation with a camera that sees the middle of the view alone, and slower force readings."""
    text = shipped_rig().read_text()
    section = text.index("  camera_fine:")
    text = text[:section] + text[section:].replace("[640, 480]", "[320, 240]", 1)
    section = text.index("  probe_force:")
    text = text[:section] + text[section:].replace("rate_hz: 1000", "rate_hz: 200", 1)
    file = folder / "workstation.yaml"
    file.write_text(text)
    return file
