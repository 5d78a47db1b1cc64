"""Two SJA1000 controllers on one bus, with the kernel's own driver: devices are served at can1, the rig is at can0."""

import shutil
import subprocess

HOST, DEVICES = "can0", "can1"
BITRATE = 500_000


def ip_link(*words):
    """Run `ip link`, as whoever has a CAN interface does."""
    tool = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    assert tool is not None, "these tests need the package iproute2"
    done = subprocess.run([tool, "-details", "link", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def take_down(channel):
    """Switch an interface off; its controller leaves the bus."""
    ip_link("set", channel, "down")


def bring_up(channel, bitrate=BITRATE):
    """Switch it on at that bit rate."""
    take_down(channel)
    ip_link("set", channel, "up", "type", "can", "bitrate", str(bitrate))
