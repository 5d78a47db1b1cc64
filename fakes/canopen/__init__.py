"""Emulated CANopen slaves, written from CiA 301 on raw frames."""

from microdrivers.fakes.canopen.aborts import AbortCode, SdoAbort
from microdrivers.fakes.canopen.application import Application, Loss
from microdrivers.fakes.canopen.communication_objects import Identity
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary, array
from microdrivers.fakes.canopen.nmt import NmtState
from microdrivers.fakes.canopen.node import CanOpenNode
from microdrivers.fakes.canopen.pdo_record import PdoDefaults
from microdrivers.fakes.canopen.temper import PROMPT, Temper

__all__ = [
    "PROMPT",
    "AbortCode",
    "Application",
    "CanOpenNode",
    "Entry",
    "Identity",
    "Loss",
    "NmtState",
    "ObjectDictionary",
    "PdoDefaults",
    "SdoAbort",
    "Temper",
    "array",
]
