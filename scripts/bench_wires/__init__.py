"""Measures drivers on pseudo-terminals and HTTP, in real time.

| module | what it measures |
|---|---|
| `pose` | a pose of three axes, against a bare write and read of the same bytes, and against pipython |
| `status` | a status read of the AZ drive, against the time that its bytes need at 115200 baud |
| `frames` | frame rate, latency and freshness of the served camera, against the truth |
| `cables` | how soon a pulled cable is noticed, and a device usable again |
| `calibration` | `calibrate optics` on a served rig against the same world in process |

`far_end` replays what an emulator has answered, from a process of its own and at once: what is left is the driver.
`serving` runs emulators in another process and pulls their cables on request. `figures` holds the table.
"""
