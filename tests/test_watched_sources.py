"""Sources of rows and the page of a watch: what comes in bit by bit, and who may read."""

import http.client
import io
import json
import os
import socket
import time

import numpy as np
import pytest

from jaxmarine import InputError
from jaxmarine.logs import ColumnMap, read_columns, read_log
from jaxmarine.watching import Page, Watch, follow, open_source
from tests import recordings
from tests.boats import boat

CSV = b"t,x,y,psi,port,starboard,bow\n0.0,1,2,0.1,0,0,0\n0.1,1.5,2,,0.5,0,0\n"


def test_a_csv_is_followed_while_it_grows(tmp_path):
    path = tmp_path / "growing.csv"
    path.write_bytes(CSV[:-8])
    source = open_source(str(path), boat(), None)
    assert source.take(0.0) == [{"t": 0.0, "x": 1, "y": 2, "psi": 0.1, "port": 0, "starboard": 0, "bow": 0}]
    assert source.take(0.0) == []
    with path.open("ab") as file:
        file.write(CSV[-8:])
    (row,) = source.take(0.0)
    assert row["t"] == 0.1 and row["port"] == 0.5 and np.isnan(row["psi"])
    # A restart goes on behind the last whole line, of which it knows the place alone.
    with path.open("ab") as file:
        file.write(b"0.2,1.6,2,0.2,0.5,0,0\n0.3,bad\n0.4,1")
    again = open_source(str(path), boat(), None)
    again.go_on(source.place)
    assert [row["t"] for row in again.take(0.0)] == [0.2]
    assert again.place == len(CSV) + 30 and "2 cells in the place of 7" in again.told[0]
    path.write_bytes(CSV)
    assert [row["t"] for row in again.take(0.0)] == [0.0, 0.1] and "shorter than it was" in again.told[-1]


def test_a_csv_by_a_column_map_and_one_without_time(tmp_path):
    path = tmp_path / "growing.csv"
    path.write_bytes(b"seconds,heading,port,starboard,bow\n1,180,0,0,0\n")
    columns = ColumnMap.model_validate(
        {"columns": {"t": "seconds", "psi": {"from": "heading", "unit": "deg"}}}
    )
    (row,) = open_source(str(path), boat(), columns).take(0.0)
    assert row["t"] == 1.0 and row["psi"] == pytest.approx(np.pi)
    with pytest.raises(InputError, match="has no column `t`"):
        open_source(str(path), boat(), None).take(0.0)
    for wrong in ("udp://nowhere", "tcp://127.0.0.1:1", str(tmp_path / "none.csv")):
        with pytest.raises(InputError):
            open_source(wrong, boat(), None)


def test_standard_input_is_read_until_it_ends(monkeypatch):
    reader, writer = os.pipe()
    stdin = os.fdopen(reader)
    monkeypatch.setattr("sys.stdin", stdin)
    source = open_source("-", boat(), None)
    assert source.take(0.01) == []
    os.write(writer, CSV)
    assert [row["t"] for row in source.take(1.0)] == [0.0, 0.1]
    os.close(writer)
    assert source.take(1.0) is None
    stdin.close()


TELEMETRY = ColumnMap.model_validate(
    {
        "columns": {
            "phi": "ATTITUDE.roll",
            "psi": "ATTITUDE.yaw",
            "x": "LOCAL_POSITION_NED.x",
            "port": {"from": "SERVO_OUTPUT_RAW.servo1_raw", "scale": 0.0025, "offset": -3.75},
        },
        "time": {"dt": 0.1},
    }
)


def sent(link, k: int) -> None:
    """What a craft sends every tenth of a second, its position half as often."""
    link.attitude_send(100 * k, 0.01 * k, 0.0, 0.1, 0.0, 0.0, 0.0)
    if k % 2 == 0:
        link.local_position_ned_send(100 * k, 0.5 * k, 0.0, 0.0, 0.0, 0.0, 0.0)
    link.servo_output_raw_send(100_000 * k, 0, 1500 + 4 * k, *(1500,) * 7)


def check(rows, count: int) -> None:
    # A link has no first message: rows are counted from the first one that has all commands.
    assert len(rows) >= count
    for row in rows[:count]:
        k = round(row["phi"] / 0.01)
        assert row["psi"] == pytest.approx(0.1) and row["port"] == pytest.approx(0.01 * k, abs=1e-9)
        assert ("x" in row) == (k % 2 == 0) and row.get("x", 0.5 * k) == pytest.approx(0.5 * k)
    assert np.diff([row["t"] for row in rows]) == pytest.approx(0.1)


def test_mavlink_over_udp_becomes_rows(loopback):
    from pymavlink import mavutil

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    source = open_source(f"udp://127.0.0.1:{port}", boat(), TELEMETRY)
    assert source.take(0.01) == []
    sender = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}")
    rows = []
    for k in range(30):
        sent(sender.mav, k)
        rows += source.take(0.05)
    until = time.monotonic() + 5.0
    while len(rows) < 20 and time.monotonic() < until:
        rows += source.take(0.05)
    sender.close()
    source.close()
    check(rows, 20)


def test_a_telemetry_log_is_replayed_as_it_came(tmp_path):
    from pymavlink.dialects.v20 import ardupilotmega

    class Recorder:
        def __init__(self):
            self.file, self.now = io.BytesIO(), 0

        def write(self, data):
            self.file.write(int(self.now).to_bytes(8, "big") + data)

    recorder = Recorder()
    link = ardupilotmega.MAVLink(recorder, srcSystem=1, srcComponent=1)
    for k in range(40):
        recorder.now = 1_700_000_000_000_000 + 100_000 * k
        sent(link, k)
    path = tmp_path / "flight.tlog"
    path.write_bytes(recorder.file.getvalue())
    source = open_source(str(path), boat(), TELEMETRY)
    rows = []
    while (some := source.take(0.0)) is not None:
        rows += some
    source.close()
    check(rows, 40)


def test_a_ros_2_bag_is_replayed_row_by_row(tmp_path, unchecked):
    path = recordings.write_bag(tmp_path / "bag", recordings.odometry(2))
    columns = recordings.MAPS / "ros_odometry.toml"
    log = read_log(path, recordings.ROV, columns)
    source = open_source(str(path), recordings.ROV, read_columns(columns))
    rows = []
    while (some := source.take(0.0)) is not None:
        rows += some
    assert len(rows) == len(log.t) and rows[7]["t"] == log.t[7]
    assert rows[7]["t3"] == log.commands[7, 2]


class Silent:
    """A source that gives one row, nothing for a while, and ends."""

    def __init__(self):
        self.name, self.told, self.place = "link", [], None
        self.left = [[{"t": 0.0, "port": 0, "starboard": 0, "bow": 0}], [], [{"t": 0.1}], None]

    def go_on(self, place):
        del place

    def take(self, wait):
        time.sleep(0.02)
        return self.left.pop(0)


def test_a_source_that_stops_is_told(monkeypatch):
    monkeypatch.setattr("jaxmarine.watching._follow.QUIET", 0.01)
    told = []
    watch = Watch(boat())
    follow(watch, Silent(), told.append, lambda _: None)
    assert told == [
        "Nothing has come from link for 0.01 s; it is waited for.",
        "link goes on.",
        "link has ended.",
    ]
    assert len(watch.opening) == 2


def asked(page: Page, path: str, host: str | None = None, method: str = "GET"):
    port = int(page.address.rstrip("/").rpartition(":")[2])
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer, body


def test_the_page_is_read_here_alone_and_escaped(loopback):
    evil = "<script>alert(1)</script>"
    page = Page(evil, 'x"><b>', 0)
    try:
        assert page.address.startswith("http://127.0.0.1:")
        answer, body = asked(page, "/")
        assert answer.status == 200 and evil not in body and "&lt;script&gt;alert" in body
        assert 'x"><b>' not in body and "default-src 'none'" in answer.headers["Content-Security-Policy"]
        # What comes later is set as text; nothing in the page makes markup of words.
        assert "innerHTML" not in body and "document.write" not in body
        page.shown(Watch(boat()))
        state = json.loads(asked(page, "/state.json")[1])
        assert state["vehicle"] == "boat" and state["t"] is None and state["named"] == []
        assert asked(page, "/../etc/passwd")[0].status == 404
        assert asked(page, "/state.json", host="evil.example:80")[0].status == 403
        assert asked(page, "/", method="POST")[0].status == 501
    finally:
        page.close()
