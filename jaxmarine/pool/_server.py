"""The page of the pool, and what it may ask for: on this machine only, from this page only."""

import json
import shlex
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pydantic

from .. import reports
from .._errors import InputError
from .._files import read_toml, validated
from .._local import HTTPStatus, LocalHandler, address_of, opened
from .._numbers import unit_on
from ..vehicle_io import packaged_vehicle
from ._pool import Pool

# Of what a page sends [bytes]: more than all commands and sizes of a craft.
_MOST_BYTES = 20_000
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
    server = opened(port, handler)
    flying = threading.Thread(target=pool.run, args=(server.shutdown,), daemon=True)
    flying.start()
    ready(address_of(server))
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
            unit=lambda fault, name: unit_on(fault.units()[name], fault.suspect.target),
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
    """Of what it gives: a thruster a force, others what they are told."""
    craft = pool.vehicle
    units = dict(zip(craft.command_names, craft.command_units, strict=True))
    return "N" if name in craft.thruster_names else units[name]


def _most(pool: Pool, name: str, usual: dict[str, float]) -> float:
    """Of what it gives, in its unit: the end of its bar."""
    if name in pool.vehicle.thruster_names:
        return float(pool.vehicle.thrusters.max_thrust[pool.vehicle.thruster_names.index(name)])
    return usual[name]


class _Handler(LocalHandler):
    """Hands out the page and the state of a pool, and takes what an operator does."""

    pool: ClassVar[Pool]
    pages: ClassVar[dict[str, tuple[str, bytes]]]
    policy = _POLICY

    def do_GET(self) -> None:
        if not self.at_home():
            return
        if self.path == "/state":
            self.say(HTTPStatus.OK, self.pool.view())
        elif self.path in self.pages:
            self.answer(HTTPStatus.OK, *self.pages[self.path])
        else:
            self.say(HTTPStatus.NOT_FOUND, {"error": "There is no such page; open /."})

    def do_POST(self) -> None:
        if not self.at_home():
            return
        # A page of somebody else's may send a form here, but not this kind of content, and not unasked.
        if self.headers.get_content_type() != "application/json" or "Transfer-Encoding" in self.headers:
            return self.refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "Send JSON of known length.")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and int(length[:9]) <= _MOST_BYTES and len(length) < 9):
            return self.refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"Send at most {_MOST_BYTES} bytes.")
        body = self.rfile.read(int(length))
        try:
            asked = json.loads(body)
            if self.path == "/steer":
                self.pool.steer(validated(_Steer, asked, "Steering").commands)
            elif self.path == "/switch":
                one = validated(_Switch, asked, "Switching")
                self.pool.switch(one.fault, one.on, one.values)
            else:
                return self.say(HTTPStatus.NOT_FOUND, {"error": "There is nothing to send there."})
        except InputError as error:
            return self.say(HTTPStatus.BAD_REQUEST, {"error": str(error)})
        except (ValueError, RecursionError):
            return self.say(HTTPStatus.BAD_REQUEST, {"error": "What was sent is not JSON."})
        self.say(HTTPStatus.OK, self.pool.view())
