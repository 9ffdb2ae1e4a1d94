"""The whole diagnosis, on data of a simulator that shares no code with the package.

The simulator is `experiments/blind`: its own equations, integrator, effects, commands and noise.
"""

import functools
import json
import math
import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxmarine as jm
from experiments.blind.cases import make_case
from experiments.blind.plant import Effect
from jaxmarine.effects import Suspect

# All logs are equally long, so that a vehicle's programs are compiled once.
TRAIN, TEST = 120.0, 60.0

NOTHING = None
WEAK = Effect("thruster_gain", "port_h", {"factor": 0.8})
CURRENT = Effect("steady_current", None, {"north": 0.05, "east": -0.03})
LATE = Effect("thruster_gain", "star_v", {"factor": 0.7}, since=60.0)
DELAY = Effect("input_delay", None, {"delay": 0.25})
SCALE = Effect("velocity_scale", None, {"factor": 1.08})
DRAG = Effect("quadratic_damping", "sway", {"value": 15.0})

QUICK = [("tethra", WEAK), ("cybership2", CURRENT)]
SLOW = [("tethra", LATE), ("tethra", DELAY), ("cybership2", SCALE), ("cybership2", DRAG)]
HIDDEN = [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]


@functools.cache
def case(name: str, hidden: str) -> tuple[dict, jm.Diagnosis, jm.Log]:
    """A vehicle with the effect of that name hidden in it: what the plant says, and the diagnosis."""
    effects = {repr(effect): effect for _, effect in (*QUICK, *SLOW)}
    known = [effects[hidden]] if hidden in effects else []
    with tempfile.TemporaryDirectory() as folder:
        answer = make_case(
            Path(folder), name, known, seed=7, duration_train=TRAIN, duration_test=TEST
        )
        vehicle = jm.load_vehicle(Path(folder) / "vehicle.toml")
        train, test = (jm.read_log(Path(folder) / f"{part}.csv", vehicle) for part in ("train", "test"))
    return answer, jm.diagnose(vehicle, train, test), test


def diagnosed(name: str, effect: Effect | None) -> tuple[dict, jm.Diagnosis, jm.Log]:
    return case(name, repr(effect))


@pytest.mark.parametrize("name,effect", HIDDEN)
def test_what_is_hidden_is_named_with_its_size(name, effect):
    answer, diagnosis, _ = diagnosed(name, effect)
    print(answer, diagnosis.findings, diagnosis.gain, diagnosis.white)
    assert diagnosis.verdict == "explained"
    assert [(f.effect, f.target) for f in diagnosis.findings] == [(effect.effect, effect.target)]
