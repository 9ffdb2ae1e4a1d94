"""A watch kept on disk, so that a restart goes on where it was.

A snapshot of what blocks have said, written whole or not at all whenever older blocks are let go, and the rows
since then, line by line. To go on is to take the snapshot and those rows once more: what was computed between
is computed again, and comes out the same.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from .._files import written_whole
from ._blocks import Begun, Bench, Rows
from ._evidence import Account, Member, Sum
from ._watch import CHUNK, Name, Watch

# Of a source, and rows after it that were taken (`_follow.py`); None where it has none.
Place = list[int] | None

_PLAIN = ("t", "blocks", "estimated_at", "estimated_once", "gap", "within", "next", "split", "patience")
_ARRAYS = ("begun_at", "counts", "speed")


class Kept:
    """The file of a watch, `path`, and the rows since it was written, beside it."""

    def __init__(self, path: Path):
        self.path = path
        self.journal = path.with_name(path.name + ".rows")
        self._file: Any = None
        self._generation = -1

    def opened(self, watch: Watch) -> tuple[list[str], Place]:
        """Brings a new watch to where the one that is kept was; what it told, and the place of its source."""
        told: list[str] = []
        place, done = None, -1
        if self.path.exists():
            place, done = restore(watch, self.path)
        self._generation = done
        if self.journal.exists():
            for line in self.journal.read_bytes().split(b"\n"):
                try:
                    generation, place_now, row = json.loads(line)
                except ValueError:
                    continue  # the last line, of a process that was killed while it wrote
                if generation == done:
                    told += watch.update(row)
                    place = place_now
        self._file = self.journal.open("ab")
        if self.journal.stat().st_size:
            self._file.write(b"\n")
        return told, place

    def add(self, row: Mapping[str, float], place: Place) -> None:
        """Keeps a row that the watch is about to take."""
        line = json.dumps([self._generation, place, {k: v for k, v in row.items() if v == v}])
        self._file.write(line.encode() + b"\n")
        self._file.flush()

    def after(self, watch: Watch, place: Place) -> None:
        """Writes a snapshot where the watch has let blocks go since the last one."""
        if watch.bench is None or watch.committed == max(self._generation, 0):
            return
        save(watch, self.path, place)
        self._generation = watch.committed
        self._file.close()
        # Rows of an older generation are read no more, whether they go or a kill comes first.
        self._file = self.journal.open("wb")

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


def _print_of(watch: Watch) -> str:
    """Tells vehicles apart."""
    leaves, form = jax.tree.flatten(watch.vehicle)
    found = hashlib.sha256(str(form).encode())
    for leaf in leaves:
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()


def save(watch: Watch, path: Path, place: Place) -> None:
    """Writes all that a watch holds, whole or not at all."""
    bench, rows = watch.bench, watch.rows
    assert bench is not None
    arrays: dict[str, Any] = {"noise": bench.noise}
    arrays |= {name: getattr(watch, name) for name in _ARRAYS}
    for i, leaf in enumerate(jax.tree.leaves(watch.windows)):
        arrays[f"windows{i}"] = leaf[:CHUNK]
    for i, account in enumerate(watch.accounts):
        for what in ("before", "message", "force"):
            for j, leaf in enumerate(jax.tree.leaves(getattr(account, what))):
                arrays[f"{what}{i}_{j}"] = np.asarray(leaf)
        arrays[f"learned{i}"] = account.learned
        for j, one in enumerate(account.said):
            arrays[f"said{i}_{j}"] = one[:CHUNK]
        for j, one in enumerate(zip(*account.sums, strict=True)):
            arrays[f"sums{i}_{j}"] = np.array(one)
    for what, some in (("rows", rows), ("waiting", Rows.joined(*watch.waiting) if watch.waiting else None)):
        for j, one in enumerate(some.arrays if some is not None else ()):
            arrays[f"{what}{j}"] = one
    if watch.begun is not None:
        arrays |= {f"begun{j}": np.asarray(one) for j, one in enumerate(watch.begun)}
    intake = watch.intake
    meta = {
        "vehicle": _print_of(watch),
        "place": place,
        "held": watch.held,
        "committed": watch.committed,
        "dt": bench.dt,
        "accounts": [[account.minus_twice, account.gates] for account in watch.accounts],
        "members": [[m.suspect, None if m.since == -np.inf else m.since] for m in watch.members],
        "named": [dataclasses.asdict(one) for one in watch.named],
        "undecided": watch.undecided,
        "told": watch.told,
        "intake": [intake.last, intake.offset, intake.held.tolist(), intake.driven, sorted(intake.said)],
    } | {name: _plain(getattr(watch, name)) for name in _PLAIN}
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    with written_whole(path) as beside, beside.open("wb") as file:
        np.savez(file, **arrays)
        file.flush()
        os.fsync(file.fileno())


def _plain(value):
    return value.item() if isinstance(value, np.generic) else value


def restore(watch: Watch, path: Path) -> tuple[Place, int]:
    """Fills a new watch from a file; the place of its source, and how often it had let blocks go."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(arrays["meta"].tobytes())
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: is no state of a watch ({error}); remove it, or choose another."
        ) from error
    if meta["vehicle"] != _print_of(watch):
        raise InputError(f"{path}: is the state of a watch of another vehicle; choose another, or remove it.")
    bench = Bench.with_noise(watch.vehicle, arrays["noise"], meta["dt"], watch.catalogue)
    watch.begin(bench)
    for i, leaf in enumerate(jax.tree.leaves(watch.windows)):
        leaf[:CHUNK] = arrays[f"windows{i}"]
    fresh = watch.accounts[0]

    def like(tree, name: str):
        leaves, form = jax.tree.flatten(tree)
        return jax.tree.unflatten(form, [jnp.asarray(arrays[f"{name}_{j}"]) for j in range(len(leaves))])

    watch.accounts = []
    for i, (minus_twice, gates) in enumerate(meta["accounts"]):
        said = tuple(np.zeros_like(one) for one in fresh.said)
        for j, one in enumerate(said):
            one[:CHUNK] = arrays[f"said{i}_{j}"]
        sums = [
            Sum(float(t), int(count), g, h)
            for t, count, g, h in zip(*(arrays[f"sums{i}_{j}"] for j in range(4)), strict=True)
        ]
        acts = tuple((tuple(columns), since) for columns, since in gates)
        watch.accounts.append(
            Account(
                like(fresh.force, f"force{i}"),
                like(fresh.before, f"before{i}"),
                like(fresh.message, f"message{i}"),
                minus_twice,
                sums,
                (said[0], said[1], said[2]),
                arrays[f"learned{i}"],
                acts,
            )
        )
    for name in _ARRAYS:
        setattr(watch, name, arrays[name])
    for name in _PLAIN:
        setattr(watch, name, meta[name])
    watch.rows = Rows(*(arrays[f"rows{j}"] for j in range(4))) if "rows0" in arrays else None
    if "waiting0" in arrays:
        watch.waiting = [Rows(*(arrays[f"waiting{j}"] for j in range(4)))]
    watch.begun = Begun(*(arrays[f"begun{j}"] for j in range(4))) if "begun0" in arrays else None
    watch.held, watch.committed = meta["held"], meta["committed"]
    watch.members = tuple(Member(i, -np.inf if t is None else t) for i, t in meta["members"])
    watch.named = tuple(_name(one) for one in meta["named"])
    watch.undecided, watch.told = tuple(meta["undecided"]), meta["told"]
    intake = watch.intake
    intake.last, intake.offset, held, intake.driven, said = meta["intake"]
    intake.held, intake.said = np.array(held), set(said)
    return meta["place"], meta["committed"]


def _name(one: dict[str, Any]) -> Name:
    parameters = {name: tuple(value) for name, value in one["parameters"].items()}
    return Name(**(one | {"parameters": parameters}))
