"""Work on a log that takes no time and goes wrong as it is told; and runs in processes of their own."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from jaxmarine._errors import InputError
from jaxmarine.fleets._job import Job, Outcome

# Not that of `conftest`, which imports JAX: each worker that is begun would wait for it.
ROOT = Path(__file__).resolve().parent.parent


def told(job: Job) -> Outcome:
    """Does what the training log says: `weak 0.8` is a finding, all else a way to fail."""
    log = Path(job.train[0])
    words = log.read_text().split()
    with log.with_suffix(".tries").open("a") as tries:
        tries.write("x")
    match words[0]:
        case "weak":
            finding = {"effect": "thruster_gain", "target": "port", "parameters": ["factor"], "nats": 50.0}
            finding |= {"sizes": [float(words[1])], "std": [0.01], "units": ["1"]}
            finding |= {
                "kind": "boat",
                "verdict": "explained",
                "gain": 0.2,
                "gain_low": 0.1,
                "gain_high": 0.3,
            }
            return Outcome((finding,), {"index.html": b"<p>a report", "figures/a.png": b"png"})
        case "fine":
            return Outcome(({"kind": "boat", "verdict": "nothing_found", "gain": 1.0},))
        case "broken":
            return Outcome(error=str(InputError(f"{job.name}: is broken; mend it.")))
        case "raises":
            raise ZeroDivisionError("no number")
        case "late":
            time.sleep(600)
        case "kills":
            os.kill(os.getpid(), signal.SIGKILL)
        case "kills-once" if log.with_suffix(".tries").read_text() == "x":
            os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(({"kind": "boat", "verdict": "nothing_found", "gain": 1.0},))


def environment() -> dict[str, str]:
    """Of a process of its own, which finds the package and the tests."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def child(code: str, *words: str | Path, **more: str) -> subprocess.CompletedProcess[str]:
    """A script run to its end; a process of the tests may open no connection, one of its own may.

    - `more`: what its environment has beside.
    """
    program = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(program, capture_output=True, text=True, timeout=300, env=environment() | more)
