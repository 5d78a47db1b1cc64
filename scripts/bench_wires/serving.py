"""Emulators of the workstation in another process, whose cables can be pulled and whose truth can be asked for.

Run as a program it is that process: `python serving.py RIG SEED SERVED`, commands on standard input.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import yaml

from microdrivers.configs import shipped_rig
from microdrivers.rig import load_rig_file
from microdrivers.rig.serving import ServedRig


class Serving:
    """Some devices of the workstation, served by another process for as long as the context is open.

    Args:
        devices: their names.
        changes: to the settings of each, merged over those of the rig file.

    Attributes:
        rig_file: points at the ports.
    """

    def __init__(self, *devices: str, seed: int = 1, changes: dict[str, dict[str, Any]] | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="bench-wires-")
        self._lock = threading.Lock()
        part = Path(self._folder.name) / "part.yaml"
        self.rig_file = Path(self._folder.name) / "served.yaml"
        data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
        del data["microscope"]
        data["safety"] = "none"
        data["devices"] = {name: data["devices"][name] | (changes or {}).get(name, {}) for name in devices}
        part.write_text(yaml.safe_dump(data), encoding="utf-8")
        command = [sys.executable, __file__, str(part), str(seed), str(self.rig_file)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> Serving:
        self._answer()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()  # the end of its input is the end of the process
        self._folder.cleanup()

    def unplug(self, device: str) -> int:
        """Pull its cable; returns when, ns on the clock that all processes of this computer share."""
        return int(self._ask("unplug", device))

    def plug_in(self, device: str) -> int:
        """Put its cable back; returns when, likewise."""
        return int(self._ask("plug_in", device))

    def true_middles_ns(self) -> dict[int, int]:
        """When the middle of each exposure really was, by frame number."""
        return {int(frame): middle_ns for frame, middle_ns in self._ask("truth", "").items()}

    def _ask(self, *command: str) -> Any:
        with self._lock:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps(command) + "\n")
            self._process.stdin.flush()
            return self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


def serve(rig: Path, seed: int, served: Path) -> None:
    """The other process."""
    middles_ns: dict[int, int] = {}
    with ServedRig(load_rig_file(rig), seed=seed) as running:
        world: Any = running.simulation.world
        world._truth.subscribe(lambda truth: middles_ns.update({truth.frame_seq: truth.t_ns}))
        running.write(served)
        print(json.dumps("ready"), flush=True)
        for line in sys.stdin:
            what, device = json.loads(line)
            answer: object = running.clock.now_ns()
            if what == "truth":
                answer = middles_ns.copy()
            else:
                getattr(running.endpoints[device].control, what)()
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
