"""A watch on the command line that is killed, and goes on as if it had not been."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxmarine.effects import place
from jaxmarine.logs import write_log
from jaxmarine.vehicle import Placed
from jaxmarine.vehicle_io import load_vehicle, save_vehicle, suspect_named
from jaxmarine.watching import Kept, Status, Watch
from tests.boats import boat, record, steps

# A snapshot is written after 80 s; it is killed beyond that, and what grew weak at 48 s is named before.
SINCE, SAMPLES, KILLED = 48.0, 1000, b'"t": 90.0'


def kept_at(state: Path) -> Status:
    """Where the watch stands that is kept in a file beside its vehicle's."""
    watch, kept = Watch(load_vehicle(state.parent / "boat.toml")), Kept(state)
    kept.opened(watch)
    kept.close()
    return watch.status


@pytest.mark.slow
def test_the_command_line_goes_on_after_sigkill(tmp_path):
    weak = place(suspect_named(boat(), "thruster_gain", "starboard"), boat(), {"factor": 0.6})
    log = record(boat().place(Placed(weak, "starboard", SINCE)), steps(SAMPLES), seed=1)
    save_vehicle(boat(), tmp_path / "boat.toml")
    write_log(log, tmp_path / "whole.csv")
    lines = (tmp_path / "whole.csv").read_text().splitlines(keepends=True)
    grown = tmp_path / "grown.csv"
    grown.write_text("".join(lines[:950]))

    def command(source: Path, state: str) -> list[str]:
        run = [sys.executable, "-m", "jaxmarine", "watch", "--vehicle", str(tmp_path / "boat.toml")]
        kept = ["--out", str(tmp_path / f"{state}.toml"), "--state", str(tmp_path / state)]
        return [*run, *kept, "--stop-after", "2", str(source)]

    first = subprocess.Popen([*command(grown, "broken")[:-3], str(grown)], stdout=subprocess.PIPE, text=True)
    journal, until = tmp_path / "broken.rows", time.monotonic() + 900
    while time.monotonic() < until and not (journal.exists() and KILLED in journal.read_bytes()):
        time.sleep(0.05)
    os.kill(first.pid, signal.SIGKILL)
    first.communicate()
    assert first.returncode == -signal.SIGKILL and (tmp_path / "broken").exists()
    grown.write_text("".join(lines))
    second = subprocess.run(command(grown, "broken"), capture_output=True, text=True, timeout=900)
    assert second.returncode == 0, second.stderr
    assert "Goes on from t = 9" in second.stdout and "thruster_gain:starboard" in second.stdout
    whole = subprocess.run(command(tmp_path / "whole.csv", "whole"), capture_output=True, timeout=900)
    assert whole.returncode == 0
    # Not a nat is lost: both have taken the same rows.
    again, once = kept_at(tmp_path / "broken"), kept_at(tmp_path / "whole")
    assert (again.t, again.blocks) == (once.t, once.blocks) and len(once.nats) > 20
    assert [(n.label, n.since, n.at) for n in again.named] == [(n.label, n.since, n.at) for n in once.named]
    assert again.nats == pytest.approx(once.nats, rel=1e-9, abs=1e-9)
    assert (tmp_path / "broken.toml").exists()
