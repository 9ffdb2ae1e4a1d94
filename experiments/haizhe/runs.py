"""Runs of a small AUV that dives, each in one of five states, cut to the same length."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

STATES = ("Normal", "AddWeight", "PressureGain_constant", "PropellerDamage_slight", "PropellerDamage_bad")
DT = 0.05  # [s]
IDLE = 1100.0  # [µs] the command before the start
BLOCK = 4  # samples that are averaged to one observation: nothing in heave is faster than 0.2 s
BLOCKS = 45  # observations from the start on; every run is that long
SAMPLES = 1 + BLOCK * BLOCKS  # the last sample before the start, and those that are used
CLOCK = DT * np.arange(-1, SAMPLES - 1)  # [s] from the start
TIMES = np.append(CLOCK[0], CLOCK[1:].reshape(BLOCKS, BLOCK).mean(axis=1))  # [s] of the observations
PAUSE = 600.0  # [s] without a run: what follows is another session, with a fresh battery or another trim
GROUND = 0.78  # [m] runs that go down to some 0.82 m stay there: the floor of the tank, which is no heave


@dataclasses.dataclass(frozen=True)
class Runs:
    """Runs from their start on, the first sample with a command.

    - `state`: index into `STATES`; `clock` [s] of the day at which a run began.
    - `command` [µs]: of the last sample before the start and of all later ones.
    - `depth` [m]: mean before the start, then means of blocks; `samples`: how many there are in each, 0
      from the block on that is near the ground. What is before it does not know what comes.
    - `volts`: mean of the battery's voltage.
    """

    state: Int[np.ndarray, " runs"]
    clock: Float[np.ndarray, " runs"]
    command: Float[np.ndarray, "runs samples"]
    depth: Float[np.ndarray, "runs observations"]
    samples: Float[np.ndarray, "runs observations"]
    volts: Float[np.ndarray, " runs"]

    def __getitem__(self, rows: Any) -> "Runs":
        return Runs(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    @property
    def level(self) -> Float[np.ndarray, " runs"]:
        """Median of the command [µs]."""
        return np.median(self.command[:, 1:], axis=1)

    def at_one_level(self, level: float) -> "Runs":
        """The same runs as if all had had the same command: what heave says without it."""
        command = np.full_like(self.command, level)
        command[:, 0] = IDLE
        return dataclasses.replace(self, command=command)


def joined(parts: Sequence[Runs]) -> Runs:
    """Several sets of runs as one."""
    return Runs(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Runs)))


def read(data: Path, part: str) -> Runs:
    """The runs of `train` or `test`, cut to the same length from the start on."""
    rows = []
    for state, label in enumerate(STATES):
        table = pd.read_csv(data / f"{part}_{label}.csv.gz")
        for _, run in table.groupby("run", sort=False):
            command, depth = run["pwm1"].to_numpy(float), run["depth"].to_numpy(float)
            start = int((command > IDLE).argmax())
            used = slice(start, start + BLOCK * BLOCKS)
            blocks = depth[used].reshape(BLOCKS, BLOCK).mean(axis=1)
            above = np.logical_and.accumulate(blocks < GROUND)
            hours, rest = divmod(int(run["time"].iloc[0]), 10_000)
            minutes, seconds = divmod(rest, 100)
            rows.append(
                (
                    state,
                    3600.0 * hours + 60.0 * minutes + seconds,
                    np.append(IDLE, command[used]),
                    np.append(depth[:start].mean(), blocks),
                    np.append(start, BLOCK * above).astype(float),
                    run["voltage"].to_numpy(float)[used].mean(),
                )
            )
    return Runs(*(np.array(column) for column in zip(*rows, strict=True)))


def sessions(runs: Runs) -> Int[np.ndarray, " runs"]:
    """Numbers of sessions: runs of one state, without a pause in between.

    The logs have no date: two sessions of different days at the same time of the day are taken for one.
    """
    order = np.lexsort((runs.clock, runs.state))
    other = np.diff(runs.state[order], prepend=-1) != 0
    late = np.diff(runs.clock[order], prepend=0.0) > PAUSE
    out = np.empty(len(order), int)
    out[order] = np.cumsum(other | late) - 1
    return out
