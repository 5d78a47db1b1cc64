"""The other end of a GCS 2.0 serial line on a stage.

Either a three-axis controller of the PI C-884 class, or a daisy chain of single-axis ones of the C-863 class.
"""

from microdrivers.fakes.pi_gcs.emulator import EMULATOR

__all__ = ["EMULATOR"]
