"""A proxy that delivers what it forwards later, as a link with delay does."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from queue import SimpleQueue


class SlowProxy:
    """Forwards connections to a port of this machine, each way after `delay_s`."""

    def __init__(self, port: int, delay_s: float) -> None:
        self.delay_s = delay_s
        self._to = ("127.0.0.1", port)
        self._server = socket.create_server(("127.0.0.1", 0))
        self._sockets = [self._server]
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self._server.getsockname()[1]}"

    def cut(self) -> None:
        """End all connections."""
        for one in self._sockets[1:]:
            _end(one)

    def close(self) -> None:
        _end(self._server)
        self._threads[0].join()
        self.cut()
        for thread in self._threads:
            thread.join()
        for one in self._sockets:
            one.close()

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                here = self._server.accept()[0]
                there = socket.create_connection(self._to)
                self._sockets += [here, there]
                self._start(self._forward, here, there)
                self._start(self._forward, there, here)

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        queue: SimpleQueue[tuple[float, bytes]] = SimpleQueue()
        self._start(self._deliver, queue, target)
        with contextlib.suppress(OSError):
            while content := source.recv(1 << 16):
                queue.put((time.monotonic() + self.delay_s, content))
        queue.put((time.monotonic() + self.delay_s, b""))

    @staticmethod
    def _deliver(queue: "SimpleQueue[tuple[float, bytes]]", target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                due_s, content = queue.get()
                time.sleep(max(0.0, due_s - time.monotonic()))
                if not content:
                    target.shutdown(socket.SHUT_WR)
                    return
                target.sendall(content)


def _end(one: socket.socket) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def slow_proxy(endpoint: str, delay_s: float) -> Iterator[SlowProxy]:
    proxy = SlowProxy(int(endpoint.rpartition(":")[2]), delay_s)
    try:
        yield proxy
    finally:
        proxy.close()
