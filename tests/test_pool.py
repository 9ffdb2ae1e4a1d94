"""The pool: a flight is what the simulation says, its log is one, its page is for this machine alone."""

import _socket
import contextlib
import functools
import http.client
import json
import re
import shlex
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import diffrax
import numpy as np
import pytest

import jaxmarine as jm
from jaxmarine.effects import place
from jaxmarine.examples import operator
from jaxmarine.pool import CRAFTS, Pool, commands_of, serve
from jaxmarine.pool._basin import DT, STEPS
from jaxmarine.pool._crafts import Craft
from jaxmarine.pool._faults import faults_of, with_faults
from jaxmarine.pool._recording import Rows
from jaxmarine.pool._server import _craft
from jaxmarine.simulation import substeps

from .browser import CHROMIUM, browser, until
from .conftest import ROOT
from .shell import exit_code

ROV = CRAFTS["rov"]
WEAK = "thruster_gain:port_h"


def pool(folder: Path, craft: Craft = ROV, **given) -> Pool:
    """A flight of which a test is the clock."""
    return Pool(craft, folder, **({"seed": 0, "noisy": False, "clock": lambda: 0.0} | given))


def flown(flight: Pool, commands: np.ndarray) -> None:
    for row in commands:
        flight.steer(dict(zip(flight.columns, row.tolist(), strict=True)))
        flight.step()


def reached(flight: Pool) -> np.ndarray:
    """Pose and velocities at the last sample."""
    assert flight.sample is not None
    return np.append(flight.sample.pose, flight.sample.shown[6:12])


# --- the craft in the water ----------------------------------------------------------------------


def test_a_flight_with_faults_is_what_the_simulation_says(tmp_path):
    """A weak thruster from 2 s on and a current from 4 s on, by an adaptive method."""
    flight = pool(tmp_path)
    commands = operator(4, np.arange(80) * DT, seed=1)
    flown(flight, commands[:20])
    flight.switch(WEAK, True, {"factor": 0.4})
    flown(flight, commands[20:40])
    flight.switch("steady_current", True, {})
    flown(flight, commands[40:])
    flight.close()
    log = jm.read_log(flight.log.path, flight.vehicle)
    assert log.commands is not None
    # What was first asked for acts from the second sample on; nothing else is changed on the way.
    np.testing.assert_allclose(log.commands[1:], commands[1:], rtol=1e-8)
    assert not log.commands[0].any()
    faults, placed = faults_of(flight.vehicle, ROV.push), []
    for label, since, values in ((WEAK, 2.0, {"factor": 0.4}), ("steady_current", 4.0, None)):
        suspect = faults[label].suspect
        values = values or {name: size.value for name, size in faults[label].sizes.items()}
        placed.append(jm.Placed(place(suspect, flight.vehicle, values), suspect.target, since=since))
    start = jm.initial_state(flight.vehicle, position=(0.0, 0.0, ROV.depth))
    track = jm.simulate(flight.vehicle.place(*placed), log, start, diffrax.Tsit5())
    # Nine digits in the log, a relative 1e-8 in each of some hundred steps of the adaptive method.
    np.testing.assert_allclose(log.channels, track.channels, rtol=1e-6, atol=1e-7)


def test_a_fault_changes_the_force_as_its_effect_says(tmp_path):
    """By the contract's own formulas, in the order of the contract."""
    flight = pool(tmp_path)
    most = float(flight.vehicle.thrusters.max_thrust[flight.columns.index("port_h")])

    def given(command: float) -> float:
        flown(flight, np.array([[0.0, command, 0.0, 0.0]] * 2))
        return flight.view()["given"]["port_h"]

    plain = given(0.6)
    assert plain == pytest.approx(most * 0.6)
    flight.switch(WEAK, True, {"factor": 0.4})
    assert given(0.6) == pytest.approx(0.4 * plain)
    flight.switch("deadband", True, {"width": 0.1})
    assert given(0.6) == pytest.approx(0.4 * most * 0.5)
    assert given(0.05) == 0.0
    # What is set once stays, and what is switched off acts no longer.
    flight.switch(WEAK, True, {})
    assert given(0.6) == pytest.approx(0.4 * most * 0.5)
    flight.switch(WEAK, False, {})
    assert given(0.6) == pytest.approx(most * 0.5)
    flight.close()
    rows = flight.switched.path.read_text().splitlines()
    assert rows[0] == "t,fault,on,size"
    assert rows[1] == f"0.2,{WEAK},1,factor=0.4" and rows[-1] == f"1.0,{WEAK},0,factor=0.4"


# Of what a stick says it does: the place in the pose, or among the velocities after it, and the sign.
MEANT = {
    "ahead": (6, 1),
    "to starboard": (5, 1),
    "dive": (2, 1),
    "roll to starboard": (3, 1),
    "nose down": (4, -1),
    "sideways to starboard": (7, 1),
}


@pytest.mark.parametrize(
    "kind", [kind if kind == "rov" else pytest.param(kind, marks=pytest.mark.slow) for kind in CRAFTS]
)
def test_every_stick_does_what_it_says(kind, tmp_path):
    """Within 2 s, beside a craft under thrust alone, without which no fin and no azimuth does anything."""
    craft = CRAFTS[kind]
    first, *_ = told = _craft(pool(tmp_path, craft))["sticks"]
    for stick, shown in zip(craft.sticks, told, strict=True):
        moved, plain = pool(tmp_path, craft), pool(tmp_path, craft)
        for flight, pushed in ((moved, shown["columns"]), (plain, {})):
            thrust = {} if kind == "rov" or shown is first else first["columns"]
            row = [0.5 * (thrust.get(name, 0.0) + pushed.get(name, 0.0)) for name in flight.columns]
            flown(flight, np.tile(row, (20, 1)))
        place, sign = MEANT[stick.more[0]]
        assert sign * (reached(moved) - reached(plain))[place] > 1e-4


@pytest.mark.parametrize("kind", CRAFTS)
def test_a_sample_is_cut_finely_enough(kind):
    craft = CRAFTS[kind]
    vehicle = craft.vehicle()
    faults = faults_of(vehicle, craft.push)
    drag = {label: one for label, one in faults.items() if "damping" in label or "tether" in label}
    largest = {label: {name: size.high for name, size in one.sizes.items()} for label, one in drag.items()}
    assert drag
    assert substeps(with_faults(vehicle, drag, largest), DT, 3.0) <= STEPS


# --- what is recorded ----------------------------------------------------------------------------


def test_a_flight_leaves_a_log_that_can_be_checked(tmp_path):
    """With the noise of the file: its columns are the contract's, and its scatter is what the file states."""
    flight = pool(tmp_path, noisy=True)
    flown(flight, operator(4, np.arange(40) * DT, seed=1))
    held = np.tile(np.zeros(4), (60, 1))
    flown(flight, held)
    flight.close()
    vehicle = jm.load_vehicle(flight.vehicle_file)
    log = jm.read_log(flight.log.path, vehicle)
    assert len(log.t) == flight.log.count == 100
    np.testing.assert_allclose(np.diff(log.t), DT, rtol=1e-9)
    assert not log.notes


def test_each_flight_has_files_of_its_own_and_one_that_nobody_flew_has_none(tmp_path):
    first = pool(tmp_path)
    flown(first, np.zeros((1, 4)))
    second = pool(tmp_path)
    for flight in first, second:
        flight.close()
    assert first.log.path != second.log.path
    assert {path.name for path in tmp_path.iterdir()} == {"flight-1.csv", "vehicle.toml"}
    (tmp_path / "vehicle.toml").write_text("another's")
    with pytest.raises(jm.InputError, match="another craft's"):
        pool(tmp_path)


def test_who_says_nothing_for_long_drives_no_further(tmp_path):
    now = 0.0
    flight = pool(tmp_path, clock=lambda: now)
    flown(flight, np.full((2, 4), 0.5))
    assert set(flight.view()["commands"].values()) == {0.5}
    now = 3.1
    flight.step()
    assert set(flight.view()["commands"].values()) == {0.0}
    flight.close()


def test_a_log_that_cannot_be_written_ends_the_flight_with_a_sentence(tmp_path):
    flight = pool(tmp_path)
    flown(flight, np.zeros((2, 4)))
    flight.close()
    with pytest.raises(jm.InputError, match=r"flight-1\.csv: has ended"):
        flight.step()
    assert len(flight.log.path.read_text().splitlines()) == 3
    with pytest.raises(jm.InputError, match="cannot be written, because no such file"):
        Rows(tmp_path / "nowhere" / "flight-1.csv", ("t",))


@pytest.mark.parametrize(
    ("act", "sentence"),
    [
        (lambda p: p.steer({"port": 1.0}), r"Command `port`: is of no actuator; did you mean `port_[hv]`"),
        (lambda p: p.steer({"port_h": 1.5}), "must lie within 1 of 0"),
        (lambda p: p.steer({"port_h": float("nan")}), "must lie within 1 of 0"),
        (lambda p: p.switch("thruster_gain:port", True, {}), r"Fault `thruster_gain:port`: is not known"),
        (lambda p: p.switch(WEAK, True, {"factors": 1.0}), "has no parameter `factors`; give factor"),
        (lambda p: p.switch(WEAK, True, {"factor": 2.0}), "must lie from 0 to 1.5"),
        (lambda p: p.switch("disturbance", True, {"factor": 1.0}), "has no size"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(grounded, act, sentence):
    before = grounded.view()
    with pytest.raises(jm.InputError, match=sentence):
        act(grounded)
    assert grounded.view() == before


@pytest.fixture(scope="module")
def grounded(tmp_path_factory) -> Pool:
    flight = pool(tmp_path_factory.mktemp("grounded"))
    flown(flight, np.zeros((1, 4)))
    return flight


def test_on_a_machine_that_is_too_slow_the_log_is_as_it_should_be(tmp_path):
    """Each look at the clock is two seconds after the last."""
    looks = 0

    def clock() -> float:
        nonlocal looks
        looks += 1
        if looks > 30:
            flight.end()
        return 2.0 * looks

    flight = pool(tmp_path, clock=clock)
    flight.steer({})
    flight.run()
    flight.close()
    log = jm.read_log(flight.log.path, flight.vehicle)
    np.testing.assert_allclose(log.t, np.arange(len(log.t)) * DT, atol=1e-9)
    # It says how far the simulation has fallen behind; five looks at most are before the first sample and
    # after the last.
    passed = 2.0 * looks - log.t[-1]
    assert flight.view()["lost"] == pytest.approx(passed, abs=10.0) and passed > 40.0


@pytest.mark.slow  # a whole diagnosis
def test_what_breaks_in_a_flight_is_named(tmp_path):
    """By its own log, with the noise of the file and no other knowledge, with when it began."""
    flight = pool(tmp_path, noisy=True)
    commands = operator(4, np.arange(1200) * DT, seed=1)
    flown(flight, commands[:400])
    flight.switch(WEAK, True, {})
    flown(flight, commands[400:])
    flight.close()
    vehicle = jm.load_vehicle(flight.vehicle_file)
    log = jm.read_log(flight.log.path, vehicle)
    found = jm.diagnose(vehicle, log, log)
    assert found.verdict == "explained" and [one.label for one in found.findings] == [WEAK]
    factor = found.findings[0].parameters["factor"]
    assert abs(factor.value - 0.5) < 4 * factor.std < 0.02
    # As near as a diagnosis finds it elsewhere (tests/test_diagnosis.py).
    assert found.findings[0].since == pytest.approx(40.0, abs=0.5)


# --- the page ------------------------------------------------------------------------------------

EVIL = """<img src=x onerror=alert(1)>'"&"""


class Asked:
    """A browser of few words, whose answers are statuses and JSON or text."""

    def __init__(self, address: str):
        self.host, port = address.removeprefix("http://").rstrip("/").split(":")
        self.port = int(port)

    def __call__(self, path: str, body: bytes | None = None, **headers: str) -> tuple[int, str]:
        connection = http.client.HTTPConnection(self.host, self.port, timeout=30)
        kind = {} if body is None else {"Content-Type": "application/json"}
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request("GET" if body is None else "POST", path, body, kind | named)
        answer = connection.getresponse()
        status, said = answer.status, answer.read().decode()
        connection.close()
        return status, said


@pytest.fixture
def served(tmp_path, loopback) -> Iterator[tuple[Pool, Asked]]:
    """A flight in real time, in a folder with a name that is markup. It ends as on a full disk."""
    folder = tmp_path / EVIL.replace("/", "")
    folder.mkdir()
    flight = pool(folder, clock=time.monotonic)
    addresses, ends = [], []

    def until_it_fails():
        try:
            serve(flight, 0, addresses.append)
        except jm.InputError as error:
            ends.append(str(error))

    serving = threading.Thread(target=until_it_fails, daemon=True)
    serving.start()
    until(lambda: addresses)
    yield flight, Asked(addresses[0])
    flight.steer({})
    flight.close()
    serving.join(30.0)
    assert len(ends) == 1 and "has ended" in ends[0]


def test_a_flight_over_the_wire(served):
    """Sticks and faults go in, and what happens comes out and into the log, in real time."""
    flight, ask = served
    status, page = ask("/")
    assert status == 200 and "<img" not in page and "&lt;img src=x" in page
    assert all(ask(path)[0] == 200 for path in ("/page.css", "/pool.css", "/pool.js"))
    craft = json.loads(ask("/craft.json")[1])
    assert [one["name"] for one in craft["columns"]] == list(flight.columns)
    # The clock begins with the first word.
    assert json.loads(ask("/state")[1])["rows"] == 0
    ahead = json.dumps({"commands": {"port_h": 0.5, "star_h": 0.5}}).encode()
    began = time.monotonic()
    assert ask("/steer", ahead)[0] == 200
    weak = json.dumps({"fault": WEAK, "on": True, "values": {"factor": 0.4}}).encode()
    status, said = ask("/switch", weak)
    assert status == 200 and json.loads(said)["faults"][WEAK]["values"] == {"factor": 0.4}
    state = until(lambda: (now := json.loads(ask("/state")[1]))["rows"] >= 10 and now)
    assert time.monotonic() - began > 9 * DT - 0.01
    assert state["given"]["port_h"] == pytest.approx(0.4 * state["given"]["star_h"])
    # To starboard is positive, and the port thruster pushes that way: weak, it turns the craft to port.
    assert state["pose"][0] > 0.0 > state["pose"][5]
    last = flight.log.path.read_text().splitlines()[-1].split(",")
    assert [float(cell) for cell in last[-len(flight.columns) :]] == [0.5, 0.5, 0.0, 0.0]
    for typed in commands_of(flight).values():
        assert str(flight.vehicle_file) in shlex.split(typed)


def test_only_this_machine_and_this_page_are_answered(served):
    flight, ask = served
    rest = b'{"commands": {}}'
    home = f"127.0.0.1:{ask.port}"
    for status, path, body, headers in (
        (403, "/", None, {"Host": f"example.org:{ask.port}"}),
        (403, "/state", None, {"Host": "127.0.0.1:1"}),
        (403, "/steer", rest, {"Origin": "http://example.org"}),
        (403, "/steer", rest, {"Origin": "null"}),
        (415, "/steer", rest, {"Content_Type": "text/plain"}),
        (413, "/steer", rest, {"Content_Length": "99999999999"}),
        (413, "/steer", rest, {"Content_Length": "-1"}),
        (404, "/../../etc/passwd", None, {}),
        (404, "/elsewhere", rest, {}),
        (400, "/steer", b"{", {}),
        (400, "/steer", b"[" * 19000, {}),
        (400, "/steer", b'{"commands": {"port_h": NaN}}', {}),
        (400, "/steer", b'{"commands": {"port_h": "1"}}', {}),
        (400, "/steer", b'{"commands": {}, "more": 1}', {}),
        (400, "/switch", b'{"fault": "<b>", "on": true}', {}),
    ):
        answered, said = ask(path, body, **headers)
        assert (answered, list(json.loads(said))) == (status, ["error"]), (path, body, headers, said)
    assert flight.view()["rows"] == 0
    assert ask("/steer", rest, Host=home, Origin=f"http://{home}")[0] == 200
    # Another address of this machine has no such port.
    with socket.socket() as other, pytest.raises(OSError):
        _socket.socket.connect(other, ("127.0.0.2", ask.port))


def test_a_port_that_is_taken_is_said(grounded, loopback):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(jm.InputError, match=r"--port \d+: cannot be opened .*; choose another, or 0"):
            serve(grounded, taken.getsockname()[1], lambda _: None)


def test_a_folder_that_is_a_file_is_refused(tmp_path, capsys):
    (tmp_path / "pool").write_text("")
    assert exit_code("pool", "--out", tmp_path / "pool") == 2
    assert "pool: " in capsys.readouterr().err


# --- a real browser ------------------------------------------------------------------------------


@contextlib.contextmanager
def started(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command line in a process of its own, and its page's address."""
    words = [sys.executable, "-m", "jaxmarine", "pool", "--port", "0", "--out", str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        try:
            line = next(line for line in process.stdout if "http://" in line)
            yield process, re.findall(r"http://\S+", line)[0]
        finally:
            process.kill()


@pytest.mark.slow  # starts a browser, and flies in real time
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")
def test_a_browser_flies_breaks_a_thruster_and_leaves_a_log(tmp_path, loopback):
    with started(tmp_path / "pool") as (process, address), browser(tmp_path / "profile") as page:
        page.size(390, 844)
        page.open(address)
        state = functools.partial(page.value, "typeof state === 'undefined' || !state?.pose ? null : state")
        until(state)
        # Nothing is wider than a narrow window.
        page.value("document.querySelectorAll('details').forEach((one) => (one.open = true))")
        assert page.value("document.documentElement.scrollWidth") <= 390
        page.key("w", True)
        until(lambda: state()["commands"]["port_h"] == 1.0)
        page.value(f"$('faults').querySelector(`[data-fault='{WEAK}']`).click()")
        until(lambda: WEAK in state()["faults"])
        until(lambda: (now := state()["given"])["port_h"] == pytest.approx(0.5 * now["star_h"]) != 0.0)
        assert WEAK in page.value("document.getElementById('news').textContent")
        page.key("w", False)
        until(lambda: state()["commands"]["port_h"] == 0.0)
        page.key("ArrowDown", True)
        until(lambda: state()["commands"]["star_v"] == 1.0)
        # Who looks away has let go.
        page.value("dispatchEvent(new Event('blur'))")
        until(lambda: state()["commands"]["star_v"] == 0.0)
        drawn = "getContext('2d').getImageData(0, 0, 300, 300).data.some((shade) => shade)"
        assert page.value(f"$('top').{drawn} && $('side').{drawn}")
        assert not page.complaints
        # As Ctrl-C, which is ignored by what a shell has started in the background.
        process.terminate()
        assert process.wait(30.0) == 0
        assert process.stdout is not None and "jaxmarine diagnose" in process.stdout.read()
    vehicle = jm.load_vehicle(tmp_path / "pool" / "vehicle.toml")
    log = jm.read_log(tmp_path / "pool" / "flight-1.csv", vehicle)
    assert log.commands is not None and log.commands.max() == 1.0
    assert f",{WEAK},1,factor=0.5" in (tmp_path / "pool" / "faults-1.csv").read_text()
