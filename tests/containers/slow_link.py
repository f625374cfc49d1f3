"""Makes the network interface of its container slow: delay, loss and bandwidth, frame by frame.

`tc netem` does this in the kernel, where the kernel has it. This program needs a TAP device only: a
device with the address of eth0 takes its place, and each frame between the two is lost at random
or waits for its turn at the bandwidth and then for the delay, in each direction on its own.

    python slow_link.py DELAY_S LOSS BITS_PER_S
"""

import fcntl
import heapq
import os
import random
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

ETH, TAP = b"eth0", b"slow0"
MOST_WAITING_S = 1.0
"""Frames that would wait longer for their turn are lost, as in any queue."""
VNET_HEADER_BYTES = 10
SEGMENT_BYTES = 1400
"""The kernel hands over several segments as one frame; each of them may be lost."""
GET_ADDRESS, SET_ADDRESS, GET_MASK, SET_MASK = 0x8915, 0x8916, 0x891B, 0x891C
SET_FLAGS, SET_MTU, GET_MAC, SET_MAC = 0x8914, 0x8922, 0x8927, 0x8924
UP, NO_ARP, PROMISCUOUS = 0x1, 0x80, 0x100
NEW_TAP, TAP_WITH_HEADER = 0x400454CA, 0x0002 | 0x1000 | 0x4000
ALL_PROTOCOLS, SOL_PACKET, PACKET_IGNORE_OUTGOING, PACKET_VNET_HDR = 0x0003, 263, 23, 15


def take_over(mtu: int) -> tuple[int, socket.socket]:
    """Give the address of eth0 to a TAP device; return its file and a raw socket of eth0."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:

        def ask(request: int, name: bytes, value: bytes = b"") -> bytes:
            asked = struct.pack("16s24s", name, value)
            return fcntl.ioctl(control, request, asked)[16:32]

        raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ALL_PROTOCOLS))
        raw.setsockopt(SOL_PACKET, PACKET_VNET_HDR, 1)
        raw.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
        raw.bind((ETH.decode(), 0))
        tap = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(tap, NEW_TAP, struct.pack("16sH22x", TAP, TAP_WITH_HEADER))
        address, mask, mac = (ask(what, ETH) for what in (GET_ADDRESS, GET_MASK, GET_MAC))
        ask(SET_MAC, TAP, mac)
        ask(SET_MTU, TAP, struct.pack("i", mtu))
        ask(SET_ADDRESS, ETH, struct.pack("H14x", socket.AF_INET))
        ask(SET_FLAGS, ETH, struct.pack("H", UP | NO_ARP | PROMISCUOUS))
        ask(SET_ADDRESS, TAP, address)
        ask(SET_MASK, TAP, mask)
        ask(SET_FLAGS, TAP, struct.pack("H", UP))
    return tap, raw


class Direction:
    """Frames on their way from one side to the other."""

    def __init__(self, delay_s: float, loss: float, bits_per_s: float) -> None:
        self._delay_s, self._loss, self._bits_per_s = delay_s, loss, bits_per_s
        self._random = random.Random(1)
        self._free_s = 0.0
        self._under_way: list[tuple[float, int, bytes]] = []
        self._number = 0

    def enter(self, frame: bytes, now_s: float) -> None:
        segments = max(1, -(-len(frame) // SEGMENT_BYTES))
        begins_s = max(now_s, self._free_s)
        is_lost = any(self._random.random() < self._loss for _ in range(segments))
        if is_lost or begins_s - now_s > MOST_WAITING_S:
            return
        self._free_s = begins_s + 8.0 * (len(frame) - VNET_HEADER_BYTES) / self._bits_per_s
        self._number += 1
        heapq.heappush(self._under_way, (self._free_s + self._delay_s, self._number, frame))

    def leave(self, now_s: float, send: Callable[[bytes], object]) -> float:
        """Send what has arrived; return for how long nothing else does."""
        while self._under_way and self._under_way[0][0] <= now_s:
            frame = heapq.heappop(self._under_way)[2]
            try:
                send(frame)
            except OSError as error:  # a frame that the other side does not take is lost
                print(f"{len(frame)} bytes: {error}", flush=True)
        return self._under_way[0][0] - now_s if self._under_way else 1.0


def main(delay_s: float, loss: float, bits_per_s: float) -> None:
    tap, raw = take_over(int(Path(f"/sys/class/net/{ETH.decode()}/mtu").read_text()))
    out, back = (Direction(delay_s, loss, bits_per_s) for _ in range(2))
    wait_s = 1.0
    while True:
        ready, _, _ = select.select([tap, raw.fileno()], [], [], max(0.0, wait_s))
        now_s = time.monotonic()
        if tap in ready:
            out.enter(os.read(tap, 1 << 17), now_s)
        if raw.fileno() in ready:
            back.enter(raw.recv(1 << 17), now_s)
        wait_s = min(out.leave(now_s, raw.send), back.leave(now_s, lambda f: os.write(tap, f)))


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
