"""Hands that a test moves, in OpenXR: what the remote driver of Monado 25.0 hears over TCP (its file drivers/remote/r_interface.h)."""

import json
import os
import socket
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

from waiting import wait_until

_EYE = struct.pack("<4f 7f 4x", -0.8, 0.8, 0.8, -0.8, 0, 0, 0, 1, 0, 0, 0)
_HEAD = struct.pack("<7f 4x", 0, 0, 0, 1, 0, 1.6, 0)  # quaternion xyzw, m


@dataclass
class RemoteHand:
    """A controller: where it is in the room, m, how it is turned, xyzw, and what is pressed."""

    place: tuple[float, float, float]
    turned: tuple[float, float, float, float] = (0, 0, 0, 1)
    squeeze: bool = False
    trigger: bool = False
    a: bool = False
    b: bool = False
    seen: bool = True

    def packed(self) -> bytes:
        """As the driver takes it."""
        amounts = [self.trigger, self.squeeze, 0, 0, 0, 0, 0, 0]
        switches = [self.seen, self.seen, 0, 0, self.a, self.a, self.b, self.b, *[0] * 8]
        return struct.pack("<7f 6f 5f 8f 16B", *self.turned, *self.place, *[0] * 11, *amounts, *switches)


class Monado:
    """The service with its remote driver, in a folder of its own. Programs find it by the environment variable XDG_RUNTIME_DIR."""

    def __init__(self, folder: Path, port: int):
        self.runtime = folder / "runtime"
        self.runtime.mkdir(mode=0o700, parents=True)
        (folder / ".config/monado").mkdir(parents=True)
        (folder / ".config/monado/config_v0.json").write_text(
            json.dumps({"active": "remote", "remote": {"version": 0, "port": port, "view_count": 2}})
        )
        own = {"HOME": str(folder), "XDG_CONFIG_HOME": str(folder / ".config"), "XDG_RUNTIME_DIR": str(self.runtime)}
        environment = {**os.environ, **own, "XRT_COMPOSITOR_NULL": "1", "XRT_NO_STDIN": "1"}
        with (folder / "log.txt").open("w") as log:
            self._process = subprocess.Popen(["monado-service"], env=environment, stdout=log, stderr=log)
        self._socket: socket.socket | None = None
        try:
            wait_until(lambda: self._connected(port), 20, "monado-service to listen")
        except BaseException:
            self.stop()
            raise

    def _connected(self, port: int) -> bool:
        assert self._process.poll() is None, "monado-service has ended"
        if not (self.runtime / "monado_comp_ipc").exists():
            return False
        try:
            self._socket = socket.create_connection(("127.0.0.1", port))
        except OSError:
            return False
        return True

    def tell(self, right: RemoteHand, left: RemoteHand) -> None:
        """Put the hands somewhere."""
        assert self._socket is not None
        self._socket.sendall(b"mndrmt3\0" + 2 * _EYE + _HEAD + left.packed() + right.packed())

    def stop(self) -> None:
        """End it, as if it crashed."""
        if self._socket is not None:
            self._socket.close()
        self._process.kill()
        self._process.wait(60)
