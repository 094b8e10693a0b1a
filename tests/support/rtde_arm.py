"""An arm of Universal Robots as ur_rtde hears it: RTDE, protocol 2, at 125 Hz, for one client after
another. In a process of its own: while ur_rtde connects, its own process stands still."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import suppress
from itertools import count

PORT = 30004
_TICK_S = 0.008
_VERSION, _ASKED, _OUTPUTS, _INPUTS, _START, _PAUSE, _DATA = b"VvOISPU"
_VECTORS = "target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q"
_VECTORS += "actual_qd", "actual_current", "joint_control_output", "actual_TCP_pose"
_VECTORS += "actual_TCP_speed", "actual_TCP_force", "target_TCP_pose", "target_TCP_speed"
_VECTORS += "joint_temperatures", "actual_joint_voltage", "ft_raw_wrench", "payload_inertia"
_TRIPLES = "actual_tool_accelerometer", "payload_cog"
_BITS = "actual_digital_input_bits", "actual_digital_output_bits"


def _type(name: str) -> tuple[str, str]:
    """Of a variable: the protocol's name, and struct's format."""
    if name in _VECTORS:
        return "VECTOR6D", "6d"
    if name in _TRIPLES:
        return "VECTOR3D", "3d"
    if name in _BITS:
        return "UINT64", "Q"
    if name == "joint_mode":
        return "VECTOR6INT32", "6i"
    if name.endswith(("_bits", "runtime_state")) or "bit_registers" in name:
        return "UINT32", "I"
    if "int_register" in name or name.endswith("_mode"):
        return "INT32", "i"
    return "DOUBLE", "d"


class RtdeArm:
    """At ``host``, an address of this machine that no other test of this process has."""

    _hosts = count(2)

    def __init__(self) -> None:
        self.host = f"127.{os.getpid() >> 8 & 127}.{os.getpid() & 255}.{next(self._hosts)}"
        self._process = subprocess.Popen(
            [sys.executable, __file__, self.host],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.say("")

    def say(self, words: str) -> None:
        """``silence``: connected, without a package; ``speak``; ``cut``: the network is gone;
        ``mend``; ``push N``: a force at the tool; ``turn``: by 1 rad/s, and off by 100 mm/s."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{words}\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline()

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


class _Controller:
    def __init__(self, host: str) -> None:
        self.host, self.silent, self.turning, self.push_n = host, False, False, 0.0
        self.mend()

    def mend(self) -> None:
        self._cut = threading.Event()
        self._server = socket.create_server((self.host, PORT))
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        self._cut.set()
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join()

    def obey(self, word: str, *values: str) -> None:
        if word == "push":
            self.push_n = float(values[0])
        elif word == "turn":
            self.turning = True
        elif word in ("silence", "speak"):
            self.silent = word == "silence"
        else:
            getattr(self, word)()

    def _pose(self) -> list[float]:
        if not self.turning:
            return [0.4, 0.0, 0.5, 0.0, 0.0, 0.0]
        seconds = time.time() % 100
        return [0.1 * seconds, 0.2, 0.3, 0.0, seconds % 3, 0.0]

    def _accept(self) -> None:
        while not self._cut.is_set():
            with suppress(OSError):
                link, _ = self._server.accept()
                with link:
                    self._serve(link)

    def _serve(self, link: socket.socket) -> None:
        """One client, until it goes, or the network."""
        link.settimeout(_TICK_S)
        heard, names, began_s, on = b"", [""], time.monotonic(), False
        while not self._cut.is_set():
            try:
                more = link.recv(65536)
                if not more:
                    return
                heard += more
            except TimeoutError:
                pass
            while len(heard) >= 3 and len(heard) >= (size := struct.unpack(">H", heard[:2])[0]):
                kind, body, heard = heard[2], heard[3:size], heard[size:]
                if kind == _OUTPUTS:
                    names = body[8:].decode().split(",")
                on = kind == _START or (on and kind != _PAUSE)
                link.sendall(_packed(kind, _answer(kind, body, names)))
            if on and not self.silent:
                values = {
                    "timestamp": [time.monotonic() - began_s],
                    "actual_TCP_pose": self._pose(),
                    "safety_mode": [1],
                    "actual_TCP_force": [0.0, self.push_n, -4.0, 9.0, 9.0, 9.0],
                }
                content = b"\x01"
                for name in names:
                    form = _type(name)[1]
                    zeros = [0] * (int(form[:-1] or 1))
                    content += struct.pack(f">{form}", *values.get(name, zeros))
                link.sendall(_packed(_DATA, content))


def _packed(kind: int, content: bytes) -> bytes:
    return struct.pack(">HB", 3 + len(content), kind) + content


def _answer(kind: int, body: bytes, names: list[str]) -> bytes:
    if kind == _ASKED:
        return struct.pack(">4I", 5, 12, 0, 0)
    if kind == _OUTPUTS:
        return b"\x01" + ",".join(_type(name)[0] for name in names).encode()
    if kind == _INPUTS:
        return b"\x01" + ",".join(_type(name)[0] for name in body.decode().split(",")).encode()
    return b"\x01"


if __name__ == "__main__":
    controller = _Controller(sys.argv[1])
    for line in sys.stdin:
        if line.strip():
            controller.obey(*line.split())
        print("done", flush=True)
