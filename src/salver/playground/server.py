"""The page and the way between it and the world: server-sent events there, small JSON messages back.

Only this machine is answered, and only who knows the address with its token, which other pages of the browser do not.
"""

from __future__ import annotations

import json
import secrets
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from salver.errors import SalverError, Status
from salver.live import Worker
from salver.playground.page import page
from salver.playground.world import World

HOST = "127.0.0.1"


class Playground:
    """The world runs and the page is served while it is entered."""

    def __init__(self, world: World, port: int = 0, *, process: bool = True) -> None:
        """port: 0 for one that is free. process: plan in another process, so that planning does not hold up the world.

        Raises SalverError when the port is taken.
        """
        self.world, self._token = world, secrets.token_urlsafe(12)
        self._worker = Worker(world.live, process=process)
        self._closing = threading.Event()
        self._frame, self._fresh = b"", threading.Condition()
        self.pace = 1.0
        self.page = page(world).encode()
        handler = type("Bound", (_Handler,), {"playground": self})
        try:
            self._server = _Server((HOST, port), handler)
        except (OSError, OverflowError) as error:
            raise SalverError(f"Port {port} cannot be used: {getattr(error, 'strerror', None) or error}.") from None
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for name, work in (("world", self._run), ("page", self._server.serve_forever))
        ]

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self._server.server_address[1]}/{self._token}/"

    def __enter__(self) -> Self:
        self._worker.start()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        with self._fresh:
            self._fresh.notify_all()
        self._server.shutdown()
        self._server.server_close()
        for thread in self._threads:
            thread.join()
        self._worker.close()

    def answer(self, message: Any) -> Status:
        return self.world.say(message)

    def frames(self) -> Any:
        """Each new frame, as JSON, until the end."""
        while not self._closing.is_set():
            with self._fresh:
                self._fresh.wait(1.0)
                frame = self._frame
            yield frame

    def _run(self) -> None:
        """The world, as fast as the clock; slower where the machine does not keep up, and it says so."""
        world, offset = self.world, time.perf_counter()
        due, marks = 0.0, [(time.perf_counter(), world.t)]
        behind = 0.05  # s behind the clock, from where on the world's clock is slowed instead of caught up
        while not self._closing.is_set():
            try:
                now = time.perf_counter()
                if now - offset - world.t > behind:
                    offset = now - world.t - behind
                while world.t <= now - offset:
                    world.advance()
                    if time.perf_counter() - now > behind:
                        break
                if now >= due:
                    due = now + 1 / 30
                    marks = [mark for mark in marks if now - mark[0] < 1.0] + [(now, world.t)]
                    spent = now - marks[0][0]
                    self.pace = (world.t - marks[0][1]) / spent if spent > 0.2 else self.pace
                    self._show()
            except SalverError as error:
                world.note = str(error)
                self._show()
                return
            time.sleep(2e-3)

    def _show(self) -> None:
        frame = {**self.world.frame(), "pace": round(self.pace, 3), "planner": self._worker.alive}
        with self._fresh:
            self._frame = json.dumps(frame, separators=(",", ":")).encode()
            self._fresh.notify_all()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False


class _Handler(BaseHTTPRequestHandler):
    playground: Playground
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        what = self._asked()
        if what == "":
            self._send(self.playground.page, "text/html; charset=utf-8")
        elif what == "frames":
            self._stream()
        else:
            self._refuse(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if self._asked() != "say":
            return self._refuse(HTTPStatus.NOT_FOUND)
        try:
            length = int(self.headers.get("Content-Length", ""))
        except ValueError:
            length = -1
        if not 0 <= length <= 10_000:
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            message = json.loads(self.rfile.read(length))
        except (ValueError, RecursionError):
            return self._refuse(HTTPStatus.BAD_REQUEST)
        status = self.playground.answer(message)
        self._send(json.dumps({"ok": status.ok, "sentence": status.sentence}).encode(), "application/json")

    def _asked(self) -> str | None:
        """What of ours, or None: a wrong token, or a page that came by another name of this machine."""
        host, _, _ = self.headers.get("Host", "").rpartition(":")
        head = f"/{self.playground._token}/"
        mine = host in (HOST, "localhost") and secrets.compare_digest(self.path[: len(head)].encode(), head.encode())
        return self.path[len(head) :] if mine else None

    def _send(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self._headers(kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _headers(self, kind: str) -> None:
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")

    def _stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self._headers("text/event-stream")
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        try:
            for frame in self.playground.frames():
                self.wfile.write(b"data: " + frame + b"\n\n")
                self.wfile.flush()
        except OSError:  # the page was closed
            pass

    def _refuse(self, status: HTTPStatus) -> None:
        self.close_connection = True
        self.send_response(status)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass
