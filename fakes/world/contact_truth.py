"""Tells reports and tests what truly goes on at the specimen."""

from __future__ import annotations

from microdrivers.core.bus import Bus
from microdrivers.core.contact_samples import ContactTruth, SpecimenTruth
from microdrivers.fakes.world.specimen import Specimen


class ContactTruths:
    """Publishes on `truth/specimen`, once, and on `truth/contact`.

    Args:
        preset: the specimen's name in the world file.
        t_ns: the present.
    """

    def __init__(self, bus: Bus, specimen: Specimen, *, preset: str, t_ns: int) -> None:
        self._specimen = specimen
        self._contact = bus.topic("truth/contact", ContactTruth, history=4096)
        x_um, y_um, z_um = specimen.surface_um.tolist()
        bus.topic("truth/specimen", SpecimenTruth).publish(
            SpecimenTruth(
                t_ns=t_ns,
                device="world",
                t_source="computed",
                preset=preset,
                sensor=specimen.sensor,
                surface_um=(x_um, y_um, z_um),
                **specimen.mechanics._asdict(),
            )
        )

    def publish(self, t_ns: int, frame_seq: int) -> None:
        """Tell the truth of a frame."""
        touch = self._specimen.touch_at(t_ns)
        self._contact.publish(
            ContactTruth(t_ns=t_ns, device="world", t_source="computed", frame_seq=frame_seq, **touch._asdict())
        )
