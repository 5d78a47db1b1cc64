"""The workstation with drives that look for their switches as fast as they may: 5 s of real time less."""

import yaml

from microdrivers.configs import shipped_rig


def quick_rig(folder):
    """Its rig file."""
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    for axis in data["devices"]["probe_stage"]["axes"].values():
        axis["homing_speeds_um_s"] = [1000, 200]
    file = folder / "quick.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file
