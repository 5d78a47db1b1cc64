"""Lines: a port, a lock, and bytes in and out in time."""
