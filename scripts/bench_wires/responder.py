"""The far end of a wire, a process of its own: answers known requests with recorded bytes and does nothing else.

    python responder.py DESCRIPTOR BYTE_NS SILENCE_NS < script.json

The script maps requests to lists of replies that are sent in turn, all in hexadecimal digits. With BYTE_NS 0 a reply is
written at once. Otherwise bytes take their time as on a line of that baud rate: the request's are waited for, then
SILENCE_NS, and every byte of the reply appears when its last bit would.
"""

import itertools
import json
import os
import sys
import time


def main() -> None:
    """Answer until the other side closes."""
    descriptor, byte_ns, silence_ns = (int(text) for text in sys.argv[1:4])
    script = {
        bytes.fromhex(request): itertools.cycle([bytes.fromhex(reply) for reply in replies])
        for request, replies in json.load(sys.stdin).items()
    }
    received = b""
    while True:
        try:
            received += os.read(descriptor, 4096)
        except OSError:  # the driver's side has closed
            return
        if received not in script:
            continue
        reply = next(script[received])
        if byte_ns:
            send_paced(descriptor, reply, time.monotonic_ns() + len(received) * byte_ns + silence_ns, byte_ns)
        else:
            os.write(descriptor, reply)
        received = b""


def send_paced(descriptor: int, reply: bytes, start_ns: int, byte_ns: int) -> None:
    """Write byte by byte; sleeping would be too coarse."""
    for number in range(len(reply)):
        due_ns = start_ns + (number + 1) * byte_ns
        while time.monotonic_ns() < due_ns:
            pass
        os.write(descriptor, reply[number : number + 1])


if __name__ == "__main__":
    main()
