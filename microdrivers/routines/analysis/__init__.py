"""Analyses of recordings: of one, and of many in parallel."""

from microdrivers.routines.analysis.batch import BatchReport, analyse_recordings, find_recordings
from microdrivers.routines.analysis.one import COLUMNS, analyse_recording, doubts
from microdrivers.routines.analysis.results_table import ResultsTable, read_table

__all__ = [
    "COLUMNS", "BatchReport", "ResultsTable", "analyse_recording", "analyse_recordings", "doubts",
    "find_recordings", "read_table",
]  # fmt: skip
