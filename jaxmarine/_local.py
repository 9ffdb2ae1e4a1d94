"""Pages that are served to this machine alone: what both the pool and a watch say to a browser."""

import json
from http import HTTPStatus as HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar

from ._errors import InputError

HOST = "127.0.0.1"
# After so long [s] a connection that says nothing is closed.
_IDLE = 30.0


class LocalHandler(BaseHTTPRequestHandler):
    """One connection; what is asked for wrongly is answered with one sentence, and changes nothing.

    - `policy`: what a page may load and run, as a Content-Security-Policy.
    """

    policy: ClassVar[str]
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "jaxmarine", ""
    timeout = _IDLE

    def at_home(self) -> bool:
        """Whether it was asked for by this address, from this page: another's name may lead here as well."""
        port = self.connection.getsockname()[1]
        names = {f"{name}:{port}" for name in (HOST, "localhost")}
        origin = self.headers.get("Origin")
        if self.headers.get("Host") in names and (origin is None or origin.removeprefix("http://") in names):
            return True
        self.refuse(HTTPStatus.FORBIDDEN, "This page is for this machine only.")
        return False

    def refuse(self, status: HTTPStatus, sentence: str) -> None:
        """What was sent is left unread, so the connection ends."""
        self.close_connection = True
        self.say(status, {"error": sentence})

    def say(self, status: HTTPStatus, words: dict[str, Any]) -> None:
        self.answer(status, "application/json", json.dumps(words, allow_nan=False).encode())

    def answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", self.policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Ten requests a second are no news."""
        del format, args


def opened(port: int, handler: type[LocalHandler]) -> ThreadingHTTPServer:
    """A server on 127.0.0.1, not running yet; raises `InputError` where the port is taken.

    - `port`: 0 takes a free one.
    """
    try:
        server = ThreadingHTTPServer((HOST, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(f"--port {port}: cannot be opened ({error}); choose another, or 0.") from error
    server.daemon_threads = True
    return server


def address_of(server: ThreadingHTTPServer) -> str:
    return f"http://{HOST}:{server.server_port}/"
