"""The page of a watch, served on this machine alone: it is read, and changes nothing."""

import json
import threading
from collections import deque
from importlib import resources

import jax.numpy as jnp
import numpy as np

from .._extras import of_extra
from .._local import HTTPStatus, LocalHandler, address_of, opened
from .._numbers import unit_on
from .._types import DOFS
from ..fitting import PLANE
from ..physics import to_euler
from ._status import Status, moment_of, sentence_of
from ._watch import Watch

with of_extra("report", "The page of a watch"):
    import jinja2

# Suspects whose nats are drawn, and moments that are drawn of a watch: of two neighbours one goes where there
# are more.
SHOWN, MOMENTS = 6, 400
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class History:
    """Nats of the suspects that led, over time; as many moments as are drawn, however long it goes on."""

    def __init__(self):
        self.moments: deque[tuple[float, dict[str, float]]] = deque()

    def add(self, status: Status) -> None:
        if not status.nats or (self.moments and self.moments[-1][0] >= status.t):
            return
        best = sorted(status.nats.items(), key=lambda item: -item[1])[:SHOWN]
        named = {name.label: name.nats for name in status.named}
        self.moments.append((status.t, {label: nats for label, nats in best if nats > 0.0} | named))
        if len(self.moments) > MOMENTS:
            kept = [one for k, one in enumerate(self.moments) if k % 2 or k > MOMENTS * 3 // 4]
            self.moments = deque(kept)


def told_of(watch: Watch, status: Status, history: History, source: str) -> dict:
    """What the page shows of a watch at its `status`, as plain numbers and words."""
    state = {}
    if status.state is not None:
        angles = np.degrees(np.asarray(to_euler(jnp.asarray(status.state.attitude))))
        values = [*status.state.position, *angles, *status.state.velocity[:3]]
        values += [*np.degrees(status.state.velocity[3:])]
        units = ["m"] * 3 + ["deg"] * 3 + ["m/s"] * 3 + ["deg/s"] * 3
        names = ("north", "east", "down", "roll", "pitch", "yaw", "u", "v", "w", "p", "q", "r")
        state = {
            f"{name} [{unit}]": round(float(v), 3) for name, unit, v in zip(names, units, values, strict=True)
        }
    return {
        "vehicle": watch.vehicle.name,
        "source": source,
        "t": status.t if np.isfinite(status.t) else None,
        "verdict": sentence_of(status),
        "bound": status.bound if np.isfinite(status.bound) else None,
        "named": [
            {
                "label": name.label,
                "since": moment_of(name.since),
                "nats": name.nats,
                "values": {k: [v, s, u] for k, (v, s, u) in name.parameters.items()},
            }
            for name in status.named
        ],
        "state": state,
        "disturbance": disturbance_of(status),
        "unseen": list(status.unseen),
        "nats": [[t, some] for t, some in history.moments],
        "told": watch.told[-12:],
    }


def disturbance_of(status: Status) -> list[dict]:
    """What disturbs the craft: now, its size and memory, on each axis; sizes of a swell; a drift; the water.

    Now is all that pushes on an axis.
    """
    state, force = status.state, status.disturbance
    if state is None:
        return []

    def row(axis: str, unit: str, now: float | None, size: float, memory: float | None) -> dict:
        return {"axis": axis, "unit": unit, "now": now, "size": float(size), "memory": memory}

    axes = [(name, unit_on("N or N m", name), DOFS.index(name)) for name in status.axes]
    out = [
        row(name, unit, now, force.size[i], float(force.memory[i]))
        for (name, unit, i), now in zip(axes, state.wrench.tolist(), strict=True)
    ]
    if force.period is not None:
        swell = f"swell of {force.period:.2g} s"
        out += [
            row(f"{name}, {swell}", unit, None, force.swell[i], force.swell_memory) for name, unit, i in axes
        ]
    if force.drift_memory is not None:
        some = ("north", "east")
        out += [row(f"drift, {where}", "N", None, force.drift, force.drift_memory) for where in some]
    if force.current_memory is not None:
        out += [
            row(f"water, {where}", "m/s", now, force.current, force.current_memory)
            for where, now in zip(("north", "east"), state.push[-PLANE:].tolist(), strict=True)
        ]
    return out


class Page:
    """Serves the page of a watch on 127.0.0.1; `shown` hands it what is new."""

    def __init__(self, vehicle: str, source: str, port: int):
        text = resources.files("jaxmarine.watching").joinpath("watch.html.j2").read_text("utf-8")
        template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(text)
        page = template.render(vehicle=vehicle, source=source).encode()
        self.source, self.history = source, History()
        self._state = b"{}"

        def state() -> bytes:
            return self._state

        class Handler(LocalHandler):
            policy = _POLICY

            def do_GET(self):
                if not self.at_home():
                    return
                if self.path == "/":
                    self.answer(HTTPStatus.OK, "text/html", page)
                elif self.path == "/state.json":
                    self.answer(HTTPStatus.OK, "application/json", state())
                else:
                    self.say(HTTPStatus.NOT_FOUND, {"error": "There is no such page; open /."})

        self._server = opened(port, Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        return address_of(self._server)

    def shown(self, watch: Watch) -> None:
        """Takes over where the watch stands."""
        status = watch.status
        self.history.add(status)
        told = told_of(watch, status, self.history, self.source)
        self._state = json.dumps(told, allow_nan=False).encode()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
