"""Independent client libraries drive the emulators over ports of the operating system, as a vendor's software would.

Each client has a process of its own: pipython keeps state in its classes, and all of them block.
"""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap


def run_client(code, kind, where):
    """Run a client's script in a process of its own; what it found."""
    known = f"import json\nfound, kind, where = {{}}, {kind!r}, {where!r}"
    script = f"{known}\n{textwrap.dedent(code)}\nprint(json.dumps(found))"
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    return json.loads(ran.stdout.splitlines()[-1])
