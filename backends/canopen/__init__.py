"""CANopen (CiA 301) as a master needs it: SDO, NMT, heartbeats, emergencies, SYNC, PDOs. Over any `CanLine`."""
