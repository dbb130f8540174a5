"""A page that this machine serves to itself: text, small JSON messages, and server-sent events.

Only this machine is answered, and only who knows the address with its token, which other pages of the browser do not.
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
from typing import Any

from salver.errors import SalverError

HOST = "127.0.0.1"
HTML = "text/html; charset=utf-8"

Shown = tuple[bytes, str] | Generator[bytes] | None


class LocalPage:
    """The server of a page, on a thread for each request."""

    def __init__(self, show: Callable[[str], Shown], say: Callable[[Any], Any], port: int = 0, most: int = 10_000):
        """show: what stands at an address below the token's: bytes and their kind, or events, or None. say: the answer,
        for JSON, to a message that was posted. port: 0 for one that is free. most: bytes of a message.

        Raises SalverError when the port is taken.
        """
        self.show, self.say, self.most, self.token = show, say, most, secrets.token_urlsafe(12)
        try:
            self._server = _Server((HOST, port), type("Bound", (_Handler,), {"served": self}))
        except (OSError, OverflowError) as error:
            raise SalverError(f"Port {port} cannot be used: {getattr(error, 'strerror', None) or error}.") from None
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self._server.server_address[1]}/{self.token}/"

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # the page was closed while it was answered
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    served: LocalPage
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        what = self._asked()
        shown = None if what is None else self.served.show(what)
        if shown is None:
            self._refuse(HTTPStatus.NOT_FOUND)
        elif isinstance(shown, tuple):
            self._send(*shown)
        else:
            self._stream(shown)

    def do_POST(self) -> None:
        if self._asked() != "say":
            return self._refuse(HTTPStatus.NOT_FOUND)
        try:
            length = int(self.headers.get("Content-Length", ""))
        except ValueError:
            length = -1
        if not 0 <= length <= self.served.most:
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            message = json.loads(self.rfile.read(length))
        except (ValueError, RecursionError):
            return self._refuse(HTTPStatus.BAD_REQUEST)
        self._send(json.dumps(self.served.say(message)).encode(), "application/json")

    def _asked(self) -> str | None:
        """What of ours, or None: a wrong token, or a page that came by another name of this machine."""
        host, _, _ = self.headers.get("Host", "").rpartition(":")
        head = f"/{self.served.token}/"
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

    def _stream(self, events: Generator[bytes]) -> None:
        self.send_response(HTTPStatus.OK)
        self._headers("text/event-stream")
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        with closing(events):  # who makes them learns at once that nobody listens any more
            for event in events:
                self.wfile.write(b"data: " + event + b"\n\n")
                self.wfile.flush()

    def _refuse(self, status: HTTPStatus) -> None:
        self.close_connection = True
        self.send_response(status)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass
