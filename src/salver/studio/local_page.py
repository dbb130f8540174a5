"""A page that this machine serves to itself: text, small JSON messages, and server-sent events.

The server answers only this machine, and only requests with the token in the address, which other pages of the browser
do not know.
"""

from __future__ import annotations

import json
import secrets
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import closing
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, cast

from salver.errors import SalverError

HOST = "127.0.0.1"
HTML = "text/html; charset=utf-8"

Shown = tuple[bytes, str] | Generator[bytes] | None


class LocalPage(ThreadingHTTPServer):
    """The server of a page, on a thread for each request, from `start` to `close`."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, show: Callable[[str], Shown], say: Callable[[Any], Any], port: int, most: int):
        """show: returns the content at an address below the token's: bytes and their type, or events, or None. say:
        returns the answer to a posted message, for JSON. port: 0 for any free one. most: largest size of a message,
        bytes.

        Raises SalverError when the port is taken.
        """
        self.show, self.say, self.most, self.token = show, say, most, secrets.token_urlsafe(12)
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise SalverError(f"Port {port} cannot be used: {getattr(error, 'strerror', None) or error}.") from None
        self._thread = threading.Thread(target=self.serve_forever, name="page", daemon=True)

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_address[1]}/{self.token}/"

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()
        self._thread.join()

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # the page was closed while it was answered
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    @property
    def page(self) -> LocalPage:
        return cast(LocalPage, self.server)

    def do_GET(self) -> None:
        what = self._asked()
        shown = None if what is None else self.page.show(what)
        if shown is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif isinstance(shown, tuple):
            self._send(*shown)
        else:
            self._stream(shown)

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if self._asked() != "say":
            return self.send_error(HTTPStatus.NOT_FOUND)
        if not length.isdecimal():
            return self.send_error(HTTPStatus.LENGTH_REQUIRED)
        if (left := int(length)) > self.page.most:
            while left > 0 and (read := self.rfile.read(min(left, 2**16))):  # a browser sends all before it reads
                left -= len(read)
            problem = f"The message has {int(length) // 1000} kB; it may have at most {self.page.most // 1000} kB."
            return self._send(json.dumps({"problem": problem}).encode(), "application/json")
        try:
            message = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            return self.send_error(HTTPStatus.BAD_REQUEST)
        self._send(json.dumps(self.page.say(message)).encode(), "application/json")

    def _asked(self) -> str | None:
        """What of ours, or None: a wrong token, or a page that came by another name of this machine."""
        host, _, _ = self.headers.get("Host", "").rpartition(":")
        head = f"/{self.page.token}/"
        mine = host in (HOST, "localhost") and secrets.compare_digest(self.path[: len(head)].encode(), head.encode())
        return self.path[len(head) :] if mine else None

    def _send(self, body: bytes, kind: str) -> None:
        self._begin(kind, ("Content-Length", str(len(body))))
        self.wfile.write(body)

    def _stream(self, events: Generator[bytes]) -> None:
        self._begin("text/event-stream", ("Connection", "close"))
        with closing(events):  # who makes them learns at once that nobody listens any more
            for event in events:
                self.wfile.write(b"data: " + event + b"\n\n")

    def _begin(self, kind: str, *more: tuple[str, str]) -> None:
        self.send_response(HTTPStatus.OK)
        guarded = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
        for name, value in [("Content-Type", kind), *guarded.items(), *more]:
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass
