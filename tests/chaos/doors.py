"""A gate (`tests.services.Gate`) that can fail in more ways than hanging."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections.abc import Callable

from tests.services import Gate

_ERROR = (
    b"HTTP/1.1 %s\r\nContent-Type: application/xml\r\nContent-Length: 0\r\n"
    b"Connection: close\r\n\r\n"
)
_STATUSES = (b"500 Internal Server Error", b"503 Slow Down")


class Door(Gate):
    """A TCP port that leads to a server.

    Ways to fail, several at once: "hang" (accepts and never answers), "late" (answers are held for
    so long), "lose" (what is asked is passed on, answers are dropped and the connection with them),
    "refuse" (no connection), "errors" (HTTP 500 and 503 to whatever is asked).
    """

    def __init__(self, reach: Callable[[], socket.socket]) -> None:
        self._faults: dict[int, tuple[str, float]] = {}
        self._numbers = itertools.count()
        self._answers = itertools.cycle(_STATUSES)
        self._guard = threading.Lock()
        super().__init__(reach)

    def begin(self, kind: str, late_s: float = 0.0) -> int:
        """Start to fail; returns what `end` takes."""
        with self._guard:
            number = next(self._numbers)
            self._faults[number] = (kind, late_s)
            if kind == "hang":
                self.hang()
        if kind == "refuse":
            self._drop_all()
        return number

    def end(self, number: int) -> None:
        """Stop one way of failing."""
        with self._guard:
            self._faults.pop(number, None)
            if not self._fails("hang"):
                self.open()

    def _fails(self, kind: str) -> bool:
        return any(one == kind for one, _ in self._faults.values())

    def _late_s(self) -> float:
        return max((late for one, late in [*self._faults.values()] if one == "late"), default=0.0)

    def _drop_all(self) -> None:
        sockets, self._sockets = self._sockets, []
        for one in sockets:
            _shut(one)

    def _serve(self, near: socket.socket, number: int) -> None:
        assert self._reach is not None
        self._open.wait()
        if self._fails("refuse"):
            return _shut(near)
        try:
            far = self._reach()
        except OSError:
            return _shut(near)
        self._sockets.append(far)
        threading.Thread(target=self._ask, args=(near, far), daemon=True).start()
        self._answer(far, near)

    def _ask(self, near: socket.socket, far: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := near.recv(1 << 16):
                self._open.wait()
                if self._fails("errors"):
                    near.sendall(_ERROR % next(self._answers))
                    break
                far.sendall(data)
            else:
                far.shutdown(socket.SHUT_WR)
                return
        _shut(near)
        _shut(far)

    def _answer(self, far: socket.socket, near: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := far.recv(1 << 16):
                arrived = time.monotonic()
                self._open.wait()
                while (left := arrived + self._late_s() - time.monotonic()) > 0:
                    time.sleep(min(left, 0.2))
                if self._fails("lose"):
                    break
                near.sendall(data)
        _shut(near)
        _shut(far)


def _shut(one: socket.socket) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)
    one.close()
