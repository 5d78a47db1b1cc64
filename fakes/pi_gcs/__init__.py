"""The other end of a GCS 2.0 serial line: a three-axis controller of the PI C-884 class on a stage."""

from microdrivers.fakes.pi_gcs.emulator import EMULATOR

__all__ = ["EMULATOR"]
