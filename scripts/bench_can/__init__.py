"""Measures the CAN devices of the workstation.

| module | what it measures | on |
|---|---|---|
| `move` | a coordinated move of 1 mm: end, path, `on_target` | the emulated bus, simulated time |
| `streams` | 3 axes on SYNC at 100 Hz beside 1000 force samples/s for a minute: what is lost | the same |
| `exchanges` | an SDO read, and a pose from its SYNC to the sample | the same, in this computer's time |
| `socketcan` | 3 axes on SYNC at 200 Hz for 10 s, and 1000 force samples/s | vcan0, in real time |

`tools` builds the rigs and holds what is counted. The table is that of `bench_wires.figures`.
"""
