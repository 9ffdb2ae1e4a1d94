"""A watch kept on disk, so that a restart goes on where it was.

A snapshot of what blocks have said, written whole or not at all whenever older blocks are let go, and the
rows since then, line by line. To go on is to take the snapshot and those rows once more: what was computed
between is computed again, and comes out the same.
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
from ..effects import ExchangedThrusters
from ..vehicle import Placed
from ._blocks import Begun, Bench, Rows
from ._evidence import Acting, Member, Sum
from ._ledger import Account
from ._status import Name
from ._watch import Watch

# Of a source, and rows after it that were taken (`_follow.py`); None where it has none.
Place = list[int] | None

# Of what is written: another one when it changes.
FORMAT = 11
# What is plain numbers.
_COURSE = ("gap", "within", "next", "split")
_LEDGER = ("t", "blocks", "held", "let_go")
_JUDGE = (
    "estimated_at",
    "asked_at",
    "asked_with",
    "asked_about",
    "patience",
    "swell_at",
    "calm",
    "in_step",
)


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
        if watch.parts is None or watch.parts.passage.ledger.let_go == max(self._generation, 0):
            return
        write_state(watch, self.path, place)
        self._generation = watch.parts.passage.ledger.let_go
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


def write_state(watch: Watch, path: Path, place: Place) -> None:
    """Writes all that a watch holds, whole or not at all."""
    assert watch.parts is not None
    passage, judge = watch.parts
    bench, course, ledger = passage.bench, passage.course, passage.ledger
    held = ledger.held
    arrays: dict[str, Any] = {"noise": bench.noise, "speed": course.speed}
    arrays |= {"columns": passage.columns, "trail": course.trail}
    arrays |= {f"blocks{i}": one[:held] for i, one in enumerate(ledger.of_blocks)}
    if judge.nats is not None:
        arrays["nats"] = judge.nats
    for i, account in enumerate(ledger.accounts):
        for what in ("before", "message", "force"):
            for j, leaf in enumerate(jax.tree.leaves(getattr(account, what))):
                arrays[f"{what}{i}_{j}"] = np.asarray(leaf)
        arrays[f"learned{i}"] = account.learned
        arrays |= {f"said{i}_{j}": one[:held] for j, one in enumerate(account.said)}
        arrays |= {f"sums{i}_{j}": np.array(one) for j, one in enumerate(zip(*account.sums, strict=True))}
    arrays |= {f"about{j}": z for j, (_, z) in enumerate(ledger.about.parts)}
    waiting = Rows.joined(*course.waiting) if course.waiting else None
    for what, some in (("rows", course.rows), ("waiting", waiting), ("recent", passage.rows)):
        arrays |= {f"{what}{j}": one for j, one in enumerate(() if some is None else some.arrays)}
    if course.begun is not None:
        arrays |= {f"begun{j}": np.asarray(one) for j, one in enumerate(course.begun)}
    intake = watch.intake
    meta = {
        "format": FORMAT,
        "vehicle": _print_of(watch),
        "place": place,
        "dt": bench.dt,
        "course": [_plain(getattr(course, name)) for name in _COURSE],
        "ledger": [_plain(getattr(ledger, name)) for name in _LEDGER],
        "judge": [_plain(getattr(judge, name)) for name in _JUDGE],
        "accounts": [
            [account.minus_twice, account.gates, account.force.drifts, account.force.flows]
            for account in ledger.accounts
        ],
        "about": [_or_none(since) for since, _ in ledger.about.parts],
        "set_back": [k for k, (_, set_back) in enumerate(passage.recent) if set_back],
        "members": [[m.suspect, _or_none(m.since)] for m in judge.members],
        "exchanged": [one.target for one in judge.exchanged],
        "named": [dataclasses.asdict(one) for one in judge.named],
        "undecided": judge.undecided,
        "told": watch.told,
        "intake": [intake.last, intake.offset, intake.held.tolist(), intake.driven, sorted(intake.said)],
    }
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    with written_whole(path) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
        file.flush()
        os.fsync(file.fileno())


def _or_none(since: float) -> float | None:
    """JSON knows no infinity."""
    return None if since == -np.inf else since


def _or_always(since: float | None) -> float:
    return -np.inf if since is None else since


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
    if meta.get("format") != FORMAT:
        raise InputError(f"{path}: is the state of a watch of another version; remove it, or choose another.")
    if meta["vehicle"] != _print_of(watch):
        raise InputError(f"{path}: is the state of a watch of another vehicle; choose another, or remove it.")
    passage, judge = watch.begin(
        Bench.with_noise(watch.vehicle, arrays["noise"], meta["dt"], watch.catalogue)
    )
    judge.exchanged = tuple(Placed(ExchangedThrusters(), target) for target in meta["exchanged"])
    passage.columns = arrays["columns"]
    course, ledger = passage.course, passage.ledger
    for part, names in (("course", _COURSE), ("ledger", _LEDGER), ("judge", _JUDGE)):
        one = {"course": course, "ledger": ledger, "judge": judge}[part]
        for name, value in zip(names, meta[part], strict=True):
            setattr(one, name, value)

    def several(name: str) -> list[np.ndarray]:
        return [arrays[f"{name}{j}"] for j in range(4)] if f"{name}0" in arrays else []

    course.speed, course.trail = arrays["speed"], arrays["trail"]
    course.rows = Rows(*some) if (some := several("rows")) else None
    course.waiting = [Rows(*some)] if (some := several("waiting")) else []
    course.begun = Begun(*some) if (some := several("begun")) else None
    held = ledger.held
    for i, one in enumerate(ledger.of_blocks):
        one[:held] = arrays[f"blocks{i}"]
    ledger.accounts = [
        _account(ledger.accounts[0].branched(), arrays, i, *one) for i, one in enumerate(meta["accounts"])
    ]
    judge.nats = arrays.get("nats")
    ledger.about = Acting(
        tuple((_or_always(since), arrays[f"about{j}"]) for j, since in enumerate(meta["about"]))
    )
    recent = Rows(*several("recent"))
    passage.recent.extend((recent.part(k, k + 1), k in meta["set_back"]) for k in range(len(recent)))
    judge.members = tuple(Member(i, _or_always(since)) for i, since in meta["members"])
    judge.named = tuple(_name(one) for one in meta["named"])
    judge.undecided, watch.told = tuple(meta["undecided"]), meta["told"]
    intake = watch.intake
    intake.last, intake.offset, held, intake.driven, said = meta["intake"]
    intake.held, intake.said = np.array(held), set(said)
    return meta["place"], ledger.let_go


def _account(
    blank: Account,
    arrays: dict[str, np.ndarray],
    i: int,
    minus_twice: float,
    gates,
    drifts: bool,
    flows: bool,
) -> Account:
    """The account with the number i; `blank`: one of the same form, that is filled."""
    blank.force = dataclasses.replace(blank.force, drifts=drifts, flows=flows)
    for what in ("before", "message", "force"):
        leaves, form = jax.tree.flatten(getattr(blank, what))
        filled = [jnp.asarray(arrays[f"{what}{i}_{j}"]) for j in range(len(leaves))]
        setattr(blank, what, jax.tree.unflatten(form, filled))
    for j, one in enumerate(blank.said):
        said = arrays[f"said{i}_{j}"]
        one[: len(said)] = said
    sums = zip(*(arrays[f"sums{i}_{j}"] for j in range(4)), strict=True)
    blank.sums = [Sum(float(t), int(seen), g, h) for t, seen, g, h in sums]
    blank.minus_twice, blank.learned = minus_twice, arrays[f"learned{i}"]
    blank.gates = tuple((tuple(columns), since) for columns, since in gates)
    return blank


def _name(one: dict[str, Any]) -> Name:
    parameters = {name: (value, std, unit) for name, (value, std, unit) in one["parameters"].items()}
    return Name(one["label"], one["since"], one["at"], one["nats"], parameters)
