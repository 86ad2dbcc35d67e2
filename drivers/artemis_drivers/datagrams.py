"""Many datagrams with one call of the system: recvmmsg(2) of 64-bit Linux, into the rows of an array.

A call for each of some thousand packets a second costs most of its time around the call: the interpreter's lock is
let go and fought for again, an address and a list of ancillary data are made as objects.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket

import numpy as np
from numpy.typing import NDArray

SO_TIMESTAMPNS, SO_RXQ_OVFL = 35, 40

_ADDRESS = np.dtype([("family", "u2"), ("port", "u2"), ("ip", "u1", (4,)), ("zero", "u8")])  # sockaddr_in
_VECTOR = np.dtype([("base", "u8"), ("size", "u8")])  # iovec
_HEADER = [("size", "u8"), ("level", "i4"), ("kind", "i4")]  # cmsghdr
# What the kernel attaches: when a datagram came (timespec) and, once it dropped any, how many it has dropped.
_CONTROL = np.dtype(
    [
        ("first", np.dtype([*_HEADER, ("s", "i8"), ("ns", "i8")])),
        ("second", np.dtype([*_HEADER, ("drops", "u8")])),
    ]
)
_MESSAGE = np.dtype(
    [
        ("name", "u8"), ("name_size", "u8"), ("vector", "u8"), ("vectors", "u8"),
        ("control", "u8"), ("control_size", "u8"), ("flags", "u8"), ("size", "u8"),
    ]
)  # fmt: skip
"""mmsghdr: lengths of 32 bits with their padding, little-endian."""

_receive = ctypes.CDLL(None, use_errno=True).recvmmsg
_receive.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
_receive.restype = ctypes.c_int
_TRY_AGAIN = (errno.EINTR, errno.ECONNREFUSED)  # the latter: an earlier answer of ours met a closed port
_LOW_HALF = (1 << 32) - 1
_NO_WAIT, _TRUNCATED = int(socket.MSG_DONTWAIT), int(socket.MSG_TRUNC)
_SECOND_NS = 1_000_000_000


class Datagrams:
    """Receives up to ``most`` datagrams at a time into consecutive rows of ``data`` uint8 (rows, bytes), contiguous.

    After ``receive`` of n, the first n of ``sizes`` (bytes), ``truncated``, ``senders`` (n, 4), ``stamps_ns`` (the
    kernel's, of the wall clock, 0 where there is none) and ``drops`` (counter of the socket, 0 where none is told)
    tell about them.
    """

    def __init__(self, data: NDArray[np.uint8], most: int) -> None:
        if not data.flags.c_contiguous:
            raise ValueError("datagrams are received into contiguous rows")
        self._data = data  # kept: the kernel writes to its address
        self._base, self._rows = data.ctypes.data + np.arange(len(data)) * data.strides[0], np.arange(most)
        self._address, self._control = np.zeros(most, _ADDRESS), np.zeros(most, _CONTROL)
        self._vector, self._message = np.zeros(most, _VECTOR), np.zeros(most, _MESSAGE)
        self._vector["size"] = data.shape[1]
        self._message["vectors"] = 1
        for name, parts in (("name", self._address), ("vector", self._vector), ("control", self._control)):
            self._message[name] = parts.ctypes.data + np.arange(most) * parts.itemsize
        self._place = self._message.ctypes.data

    def receive(self, sock: socket.socket, row: int, limit: int) -> int:
        """How many waiting datagrams were put into the rows from ``row`` on, which go on with the first one."""
        self._vector["base"][:limit] = self._base[(row + self._rows[:limit]) % len(self._base)]
        self._message["name_size"][:limit] = _ADDRESS.itemsize
        self._message["control_size"][:limit] = _CONTROL.itemsize
        self._control["first"]["kind"][:limit] = self._control["second"]["kind"][:limit] = 0
        while True:
            count = int(_receive(sock.fileno(), self._place, limit, _NO_WAIT, None))
            if count >= 0:
                return count
            code = ctypes.get_errno()
            if code == errno.EAGAIN:
                return 0
            if code not in _TRY_AGAIN:
                raise OSError(code, os.strerror(code))

    def sizes(self, count: int) -> NDArray[np.int64]:
        """Bytes of each."""
        return self._message["size"][:count].astype(np.int64)

    def truncated(self, count: int) -> NDArray[np.bool_]:
        """Which were longer than a row."""
        truncated: NDArray[np.bool_] = (self._message["flags"][:count] & _TRUNCATED) != 0
        return truncated

    def senders(self, count: int) -> NDArray[np.uint8]:
        """IPv4 addresses (count, 4)."""
        return self._address["ip"][:count]

    def stamps_ns(self, count: int) -> NDArray[np.int64]:
        """When the kernel got each, ns since 1970; 0 where it does not say."""
        stamp = self._control["first"][:count]
        known = stamp["kind"] == SO_TIMESTAMPNS
        return np.where(known, stamp["s"] * _SECOND_NS + stamp["ns"], 0)

    def drops(self, count: int) -> int:
        """How many datagrams the socket had lost when the last of these came; 0 where the kernel does not say."""
        told = self._control["second"][:count]
        counts = told["drops"][told["kind"] == SO_RXQ_OVFL]
        return int(counts[-1]) & _LOW_HALF if len(counts) else 0
