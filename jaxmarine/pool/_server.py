"""The page of the pool, and what it may ask for: on this machine only, from this page only."""

import json
import shlex
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pydantic

from .. import reports
from .._errors import InputError
from .._files import read_toml, validated
from ..vehicle_io import packaged_vehicle
from ._faults import Fault
from ._pool import Pool

HOST = "127.0.0.1"
# Of what a page sends [bytes]: more than all commands and sizes of a craft.
_MOST_BYTES = 20_000
# After so long [s] a connection that says nothing is closed.
_IDLE = 30.0
# Nothing but what this server hands out is loaded, run or shown in a frame.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)

_Number = pydantic.FiniteFloat


class _Asked(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", strict=True)


class _Steer(_Asked):
    commands: dict[str, _Number] = pydantic.Field(description="a table of numbers by actuators' names")


class _Switch(_Asked):
    fault: str = pydantic.Field(description="a fault's name", max_length=200)
    on: bool = pydantic.Field(description="true or false")
    values: dict[str, _Number] = pydantic.Field(
        default_factory=dict, description="a table of numbers by parameters' names"
    )


def serve(pool: Pool, port: int, ready: Callable[[str], None]) -> None:
    """Serves the page, and lets the pool run, until `KeyboardInterrupt` or a failure, which it raises.

    - `port`: 0 takes a free one. `ready` is called with the page's address.

    Raises `InputError` where the port is taken, and where the flight could not go on.
    """
    handler = type("Handler", (_Handler,), {"pool": pool, "pages": _pages(pool)})
    try:
        server = ThreadingHTTPServer((HOST, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(f"--port {port}: cannot be opened ({error}); choose another, or 0.") from error
    server.daemon_threads = True
    flying = threading.Thread(target=pool.run, args=(server.shutdown,), daemon=True)
    flying.start()
    ready(f"http://{HOST}:{server.server_port}/")
    try:
        server.serve_forever(poll_interval=0.2)
    finally:
        pool.end()
        flying.join()
        server.server_close()
    if pool.failure is not None:
        raise pool.failure


def commands_of(pool: Pool) -> dict[str, str]:
    """What to type in a shell, while it is flown and afterwards."""
    vehicle, log = (shlex.quote(str(path)) for path in (pool.vehicle_file, pool.log.path))
    report = shlex.quote(str(pool.log.path.with_suffix("")) + "-report")
    return {
        "watch": f"jaxmarine watch --vehicle {vehicle} --page {log}",
        "check": f"jaxmarine check --vehicle {vehicle} {log}",
        "diagnose": f"jaxmarine diagnose --vehicle {vehicle} --train {log} --test {log} --out {report}",
    }


def _pages(pool: Pool) -> dict[str, tuple[str, bytes]]:
    """Everything that does not change: kind and content by path."""
    here = Path(__file__).parent
    look = (here.parent / "reports" / "page.css").read_bytes()
    page = (
        reports.templates(here)
        .get_template("pool.html.j2")
        .render(
            name=pool.vehicle.name,
            pool=pool,
            keys=_keys(pool),
            said=commands_of(pool),
            faults=_groups(pool),
            levers=any(stick.lever for stick in pool.craft.sticks),
            units=lambda fault, name: _of(fault, name),
        )
    )
    return {
        "/": ("text/html", page.encode()),
        "/page.css": ("text/css", look),
        "/pool.css": ("text/css", (here / "pool.css").read_bytes()),
        "/pool.js": ("text/javascript", (here / "pool.js").read_bytes()),
        "/craft.json": ("application/json", json.dumps(_craft(pool), allow_nan=False).encode()),
    }


def _groups(pool: Pool) -> dict[str, list]:
    """Faults by the name of their effect, each with its heading once."""
    out: dict[str, list] = {}
    for fault in pool.faults.values():
        out.setdefault(fault.suspect.effect.name, []).append(fault)
    return out


def _of(fault: Fault, parameter: str) -> str:
    """The unit of a parameter; of one that is for forces or moments, the one that the axis has."""
    forces, _, moments = fault.units()[parameter].partition(" or ")
    turns = fault.suspect.target in ("roll", "pitch", "yaw")
    return moments if moments and turns else forces


def _keys(pool: Pool) -> list[tuple[int, int, str, str]]:
    """Of each key: the stick's place, the way it pushes, its name and what it does."""
    signs = {"ArrowUp": "↑", "ArrowDown": "↓"}
    return [
        (i, way, signs.get(key, key.upper()), words)
        for i, stick in enumerate(pool.craft.sticks)
        for way, (words, key) in ((1, stick.more), (-1, stick.less))
    ]


def _craft(pool: Pool) -> dict[str, Any]:
    """What the script needs to know of the craft."""
    usual = {name: 1.0 for name in pool.vehicle.thruster_names}
    for one in pool.vehicle.actuators:
        usual |= {name: float(high) for name, (_, high) in zip(one.columns, one.usual, strict=True)}
    tables = read_toml(packaged_vehicle(pool.craft.packaged))
    return {
        "columns": [
            {"name": name, "limit": usual[name], "unit": _unit(pool, name), "most": _most(pool, name, usual)}
            for name in pool.columns
        ],
        "sticks": [
            {
                "more": stick.more[1],
                "less": stick.less[1],
                "columns": {name: share * usual[name] for name, share in stick.columns.items()},
                "pad": stick.pad,
                "lever": stick.lever,
            }
            for stick in pool.craft.sticks
        ],
        "size": pool.craft.size,
        "middle": pool.craft.middle,
        "hull": pool.craft.packaged,
        "pushers": [
            {key: table.get(key) for key in ("name", "position", "direction", "swivel")}
            for kind in ("thruster", "propeller")
            for table in tables.get(kind, [])
        ],
        "surfaces": [
            {key: table[key] for key in ("name", "position", "axis")} for table in tables.get("surface", [])
        ],
    }


def _unit(pool: Pool, name: str) -> str:
    if name in pool.vehicle.thruster_names:
        return "N"
    return "rev/s" if any(o.key == "propeller" and name in o.names for o in pool.vehicle.actuators) else "rad"


def _most(pool: Pool, name: str, usual: dict[str, float]) -> float:
    """Of what it gives, in its unit: the end of its bar."""
    if name in pool.vehicle.thruster_names:
        return float(pool.vehicle.thrusters.max_thrust[pool.vehicle.thruster_names.index(name)])
    return usual[name]


class _Handler(BaseHTTPRequestHandler):
    """One connection; what is asked for wrongly is answered with one sentence, and changes nothing."""

    pool: ClassVar[Pool]
    pages: ClassVar[dict[str, tuple[str, bytes]]]
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "jaxmarine", ""
    timeout = _IDLE

    def do_GET(self) -> None:
        if not self._at_home():
            return
        if self.path == "/state":
            self._say(HTTPStatus.OK, self.pool.view())
        elif self.path in self.pages:
            self._answer(HTTPStatus.OK, *self.pages[self.path])
        else:
            self._say(HTTPStatus.NOT_FOUND, {"error": "There is no such page; open /."})

    def do_POST(self) -> None:
        if not self._at_home():
            return
        # A page of somebody else's may send a form here, but not this kind of content, and not unasked.
        if self.headers.get_content_type() != "application/json" or "Transfer-Encoding" in self.headers:
            return self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "Send JSON of known length.")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and int(length[:9]) <= _MOST_BYTES and len(length) < 9):
            return self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"Send at most {_MOST_BYTES} bytes.")
        body = self.rfile.read(int(length))
        try:
            asked = json.loads(body)
            if self.path == "/steer":
                self.pool.steer(validated(_Steer, asked, "Steering").commands)
            elif self.path == "/switch":
                one = validated(_Switch, asked, "Switching")
                self.pool.switch(one.fault, one.on, one.values)
            else:
                return self._say(HTTPStatus.NOT_FOUND, {"error": "There is nothing to send there."})
        except InputError as error:
            return self._say(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        except (ValueError, RecursionError):
            return self._say(HTTPStatus.BAD_REQUEST, {"error": "What was sent is not JSON."})
        self._say(HTTPStatus.OK, self.pool.view())

    def _at_home(self) -> bool:
        """Whether it was asked for by this address, from this page: another's name may lead here as well."""
        port = self.connection.getsockname()[1]
        names = {f"{name}:{port}" for name in (HOST, "localhost")}
        origin = self.headers.get("Origin")
        if self.headers.get("Host") in names and (origin is None or origin.removeprefix("http://") in names):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "This page is for this machine only.")
        return False

    def _refuse(self, status: HTTPStatus, sentence: str) -> None:
        """What was sent is left unread, so the connection ends."""
        self.close_connection = True
        self._say(status, {"error": sentence})

    def _say(self, status: HTTPStatus, words: dict[str, Any]) -> None:
        self._answer(status, "application/json", json.dumps(words, allow_nan=False).encode())

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Ten requests a second are no news."""
        del format, args
