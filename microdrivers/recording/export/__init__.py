"""Recordings in formats that other tools read: tables, HDF5, images and videos."""

from microdrivers.recording.export.run import FORMATS, ExportReport, Format, export_recording

__all__ = ["FORMATS", "ExportReport", "Format", "export_recording"]
