"""The other end of every wire: emulators, and the one physical world that they share."""
