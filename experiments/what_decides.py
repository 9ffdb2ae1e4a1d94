"""What decides a diagnosis? Each number of `Criteria` moved by 30 %, and each kind of move left out.

usage: python -m experiments.what_decides --cases DIR --out DIR [--jobs 1] [--quick]

`--cases` is a folder of logs with known answers that `python -m experiments.blind_matrix` drew (`cases_…`).
Writes a row per log below rows/, results.json and results.md.

Most of what is moved changes nothing on most logs, and that needs no second diagnosis. Criteria are handed
over as numbers that hold 30 % less and 30 % more beside their own value, through all arithmetic: where no
comparison of a diagnosis comes out otherwise with one of them, the diagnosis is the same with it. So is one
without a move that was asked for and did nothing. All others are made once more. It goes on where it was cut.
"""

import contextlib
import dataclasses
import json
import multiprocessing
import operator
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import jax
import numpy as np
import typer
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import program, write_results
from experiments.blind import grading
from experiments.blind_matrix import BLOCK, GROUPS, detectable, written
from jaxmarine.diagnosis import (
    Criteria,
    _coefficients,
    _diagnose,
    _prepare,
    _search,
    _settle,
    _shared,
    _unnamed,
)
from jaxmarine.diagnosis._search import Trial
from jaxmarine.diagnosis._workbench import Workbench

SHARE = 0.3
# Numbers of which more than comparisons is made: where one is asked for, the diagnosis is made once more.
COUNTED_WITH = ("file_error", "steerable")
Row = dict[str, Any]


# --- criteria -------------------------------------------------------------------------------------


class Spread:
    """A number with others in its place, by name: arithmetic goes through all of them alike.

    A comparison comes out as that of the number itself. For which of the others it would come out otherwise
    is noted in `otherwise`.
    """

    __array_ufunc__ = None  # arrays leave arithmetic with it to it

    def __init__(self, own: Any, others: dict[str, Any], otherwise: set[str]):
        self.own, self.others, self.otherwise = own, others, otherwise

    def _each(self, apply: Callable, other: Any) -> "Spread":
        names = self.others | (other.others if isinstance(other, Spread) else {})
        out = {name: apply(_at(self, name), _at(other, name)) for name in names}
        return Spread(apply(self.own, _at(other, None)), out, self.otherwise)

    def _compared(self, compare: Callable, other: Any) -> Any:
        told = self._each(compare, other)
        self.otherwise |= {name for name, x in told.others.items() if np.any(x != told.own)}
        return told.own

    def __add__(self, other: Any) -> "Spread":
        return self._each(operator.add, other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> "Spread":
        return self._each(operator.sub, other)

    def __rsub__(self, other: Any) -> "Spread":
        return self._each(lambda own, first: first - own, other)

    def __mul__(self, other: Any) -> "Spread":
        return self._each(operator.mul, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> "Spread":
        return self._each(operator.truediv, other)

    def __rtruediv__(self, other: Any) -> "Spread":
        return self._each(lambda own, first: first / own, other)

    __hash__ = None  # type: ignore[assignment]

    def __bool__(self) -> bool:
        raise TypeError("a criterion is compared with something, or the study sees nothing of it")

    def __eq__(self, other: object) -> Any:
        return self._compared(operator.eq, other)

    def __ne__(self, other: object) -> Any:
        return self._compared(operator.ne, other)

    def __lt__(self, other: Any) -> Any:
        return self._compared(operator.lt, other)

    def __le__(self, other: Any) -> Any:
        return self._compared(operator.le, other)

    def __gt__(self, other: Any) -> Any:
        return self._compared(operator.gt, other)

    def __ge__(self, other: Any) -> Any:
        return self._compared(operator.ge, other)


def _at(x: Any, name: str | None) -> Any:
    """The number by that name of a spread, its own where it has none; of anything else that itself."""
    if not isinstance(x, Spread):
        return x
    return x.own if name is None else x.others.get(name, x.own)


class Watched(Criteria):
    """The default criteria, which note for which of their variants a diagnosis may differ, in `otherwise`."""

    def __init__(self) -> None:
        super().__init__()
        object.__setattr__(self, "otherwise", set())

    def __getattribute__(self, name: str) -> Any:
        if name not in FIELDS and name not in ("nats", "close"):
            return super().__getattribute__(name)
        others: dict[str, Any] = {one: getattr(other, name) for one, other in VARIANTS.items()}
        own = getattr(Criteria(), name)
        others = {one: x for one, x in others.items() if x != own}
        if name in COUNTED_WITH:
            self.otherwise.update(others)
            return own
        return Spread(own, others, self.otherwise)


FIELDS = tuple(field.name for field in dataclasses.fields(Criteria))


def moved(field: str, share: float) -> Criteria:
    """The default criteria with one of them larger by a share; a count by at least one."""
    own = getattr(Criteria(), field)
    value = own * (1 + share)
    if isinstance(own, int):
        value = max(own + 1, round(value)) if share > 0 else min(own - 1, round(value))
    return dataclasses.replace(Criteria(), **{field: value})


VARIANTS = {
    f"{field} {sign}": moved(field, share)
    for field in FIELDS
    for sign, share in (("-", -SHARE), ("+", SHARE))
}


# --- moves ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Move:
    """One kind of move of a diagnosis.

    - `parts`: the function or functions that make it: owner, name, what stands in its place where it is left
      out, and whether it did something, by its arguments and what it returned.
    """

    words: str
    parts: tuple[tuple[Any, str, Callable, Callable[[tuple, Any], bool]], ...]


def _other_model(args: tuple, out: Any) -> bool:
    return out is not args[1]


MOVES = {
    "columns": Move(
        "columns are read otherwise where commands and answers show it",
        (
            (_prepare, "misconnected", lambda *_: (), lambda _, out: len(out) > 0),
            (_shared, "misconnected", lambda *_: (), lambda _, out: len(out) > 0),
        ),
    ),
    "beginning": Move(
        "a cause may begin within the log",
        ((Workbench, "may_begin", lambda *_: False, lambda _, out: out),),
    ),
    "shift": Move(
        "a beginning is moved in the end to where it costs least",
        ((_settle, "_beginnings_refined", lambda _, model: model, _other_model),),
    ),
    "drop": Move(
        "backward elimination: what is not needed beside the others is dropped",
        (
            (_settle, "pruned", lambda _, model: model, _other_model),
            (_unnamed, "pruned", lambda _, model: model, _other_model),
        ),
    ),
    "swap": Move(
        "another cause in the place of one, now that the others are known",
        (
            (_settle, "_reweighed", lambda _, model, *__: model, _other_model),
            (
                _coefficients,
                "_instead",
                lambda _, model, member, __: (model, (Trial(member, model, 0.0),)),
                # What else was weighed there are a finding's alternatives.
                lambda args, out: out[0] is not args[1] or len(out[1]) > 1,
            ),
        ),
    ),
    "held": Move(
        "a second look beside the file held as it is",
        (
            (_search, "beside_file", lambda *_: [], lambda _, out: len(out) > 0),
            (_settle, "beside_file", lambda *_: [], lambda _, out: len(out) > 0),
        ),
    ),
    "coefficients": Move(
        "which coefficients of the file are off, the others held as filed",
        ((_settle, "settle", lambda _, model, *__: (model, True, ()), lambda _, out: not out[1]),),
    ),
    "unknown": Move(
        "forces without a name that depend on signals",
        (
            (_unnamed, "_dependences", lambda _, now, *__: (now, ()), lambda _, out: len(out[1]) > 0),
            (_unnamed, "size_only", lambda *_: (), lambda _, out: len(out) > 0),
        ),
    ),
    "disturbance": Move(
        "a disturbance in the model where commands answer what was measured",
        (
            (_diagnose, "disturbed", lambda _, model: model, _other_model),
            (_search, "disturbed", lambda _, model: model, _other_model),
        ),
    ),
    "worth": Move(
        "names are dropped that predict no better than the file, or than the model without them",
        (
            (
                _diagnose,
                "_worthwhile",
                lambda *args: (args[2], None, []),
                lambda args, out: out[0] is not args[2],
            ),
            (_settle, "_without_harm", lambda _, model, __: model, _other_model),
        ),
    ),
}


@contextlib.contextmanager
def without(move: Move) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for owner, name, instead, _ in move.parts:
            stack.enter_context(patch.object(owner, name, instead))
        yield


@contextlib.contextmanager
def watching(moves: dict[str, Move]) -> Iterator[set[str]]:
    """The moves that did something in what is done meanwhile."""
    acted = set[str]()

    def watched(key: str, made: Callable, did: Callable) -> Callable:
        def call(*args: Any, **options: Any) -> Any:
            out = made(*args, **options)
            if did(args, out):
                acted.add(key)
            return out

        return call

    with contextlib.ExitStack() as stack:
        for key, move in moves.items():
            for owner, name, _, did in move.parts:
                stack.enter_context(patch.object(owner, name, watched(key, getattr(owner, name), did)))
        yield acted


# --- one log --------------------------------------------------------------------------------------


def row(folder: Path) -> Row:
    """One log: the grade of its diagnosis, and of each that is made otherwise and may differ."""
    answer = json.loads((folder / "answer.json").read_text())
    vehicle = jm.load_vehicle(folder / "vehicle.toml")
    train, test = (jm.read_log(folder / name, vehicle) for name in ("train.csv", "test.csv"))

    def graded(criteria: Criteria) -> Row:
        said = jm.diagnose(vehicle, train, test, criteria=criteria).to_json()
        grade = grading.grade(answer, said)
        names = [[f["effect"], f["target"], f["since"]] for f in said["findings"]]
        return {"first": grade["first"], "whole": grade["whole"], "verdict": said["verdict"], "named": names}

    watched = Watched()
    with watching(MOVES) as acted:
        own = graded(watched)
    others = {name: or_refused(graded, VARIANTS[name]) for name in sorted(watched.otherwise)}
    for name in sorted(acted):
        with without(MOVES[name]):
            others[f"without {name}"] = or_refused(graded, Criteria())
    options = answer["options"]
    return {
        "case": folder.name,
        "kind": grading.kind(answer),
        "vehicle": options["vehicle"],
        "severity": options["severity"],
        "steering": options.get("steering", GROUPS[0]),
        **own,
        "again": others,
    }


def or_refused(graded: Callable[[Criteria], Row], criteria: Criteria) -> Row:
    """The grade, or that no answer came: of a craft that runs away, as with columns that are exchanged."""
    try:
        return graded(criteria)
    except jm.InputError:
        return {"first": False, "whole": False, "verdict": "refused", "named": []}


def kept(folders: Sequence[Path], out: Path) -> int:
    """Rows of some logs of one vehicle, each in a file of its own."""
    jax.config.update("jax_enable_x64", True)
    by = program()
    for folder in folders:
        whole = json.dumps({**row(folder), "program": by}, indent=1) + "\n"
        (out / f"{folder.name}.json").write_text(whole, encoding="utf-8")
    return len(folders)


def waiting(cases: Path, out: Path) -> list[list[Path]]:
    """Logs without a row, block by block, those of a vehicle together."""
    parts: dict[tuple[str, str], list[Path]] = {}
    for path in sorted(cases.glob("*/answer.json")):
        folder = path.parent
        if not (out / f"{folder.name}.json").exists():
            ship = json.loads(path.read_text())["options"]["vehicle"]
            parts.setdefault((folder.name.split("_")[1], ship), []).append(folder)
    return [parts[key] for key in sorted(parts)]


# --- what comes of it -----------------------------------------------------------------------------


def summary(rows: Sequence[Row]) -> Row:
    """Of each variant how often it was made anew, and the rate of whole answers beside that by default."""
    seen = [r for r in rows if detectable(r)]
    names = (*VARIANTS, *(f"without {move}" for move in MOVES))
    return {
        "logs": len(rows),
        "seen": len(seen),
        "right": sum(r["whole"] for r in seen),
        "programs": sorted({r["program"] for r in rows}),
        "variants": {name: variant(name, seen) for name in names},
    }


def variant(name: str, seen: Sequence[Row]) -> Row:
    right = sum(r["again"].get(name, r)["whole"] for r in seen)
    lost, won = (
        [r["case"] for r in seen if name in r["again"] and (r["whole"], r["again"][name]["whole"]) == moves]
        for moves in ((True, False), (False, True))
    )
    changed = [r for r in seen if name in r["again"] and differs(r, r["again"][name])]
    return {
        "again": sum(name in r["again"] for r in seen),
        "changed": len(changed),
        "right": right,
        "points": 100 * (right - sum(r["whole"] for r in seen)) / max(len(seen), 1),
        "lost": lost,
        "won": won,
    }


def differs(own: Row, other: Row) -> bool:
    """Whether an answer has another verdict or other names."""
    return any(own[key] != other[key] for key in ("verdict", "named"))


def table(s: Row) -> str:
    """The summary as Markdown."""
    lines = [
        f"{s['logs']} logs, {s['seen']} of them with nothing hidden or something detectable, of which "
        f"{s['right']} are answered wholly right by default.",
        *([f"Rows are by {len(s['programs'])} programs."] if len(s["programs"]) > 1 else []),
        "",
        "| criterion | default | by | made once more | other names | right | points | lost | won |",
        "|---" * 9 + "|",
    ]

    def cells(one: Row) -> tuple[str, ...]:
        cases = (", ".join(f"`{case}`" for case in one[key]) or "–" for key in ("lost", "won"))
        counts = (one["again"], one["changed"], one["right"])
        return (*map(str, counts), f"{one['points']:+.1f}", *cases)

    for name in VARIANTS:
        field, sign = name.split()
        first = (f"`{field}`", f"{getattr(Criteria(), field):g}", f"{sign}{100 * SHARE:.0f} %")
        lines.append("| " + " | ".join((*first, *cells(s["variants"][name]))) + " |")
    lines += [
        "",
        "| left out | made once more | other names | right | points | lost | won |",
        "|---" * 7 + "|",
    ]
    for name, move in MOVES.items():
        lines.append("| " + " | ".join((move.words, *cells(s["variants"][f"without {name}"]))) + " |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for rows and results.")],
    cases: Annotated[Path | None, typer.Option(help="Folder of logs that `blind_matrix` drew.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Two logs of one craft, drawn here.")] = False,
) -> None:
    """Diagnoses logs with known answers by other criteria, and without each kind of move."""
    if cases is None and not quick:
        raise typer.BadParameter("needs the folder of logs that blind_matrix drew", param_hint="--cases")
    rows_at = out / "rows"
    rows_at.mkdir(parents=True, exist_ok=True)
    if cases is None:
        cases = out / "cases"
        written(cases, 0, 1, ("cybership2",), dict.fromkeys(BLOCK, 0) | {"nulls": 1, "singles": 1}, 0.0)
    # A process ends after each of its tasks: programs of many vehicles would be too many maps.
    spawn = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(jobs, mp_context=spawn, max_tasks_per_child=1) as pool,
        Progress(transient=True) as bar,
    ):
        left = waiting(cases, rows_at)
        doing = bar.add_task("diagnosing", total=sum(map(len, left)))
        for future in as_completed([pool.submit(kept, folders, rows_at) for folders in left]):
            bar.advance(doing, future.result())
    rows = [json.loads(path.read_text()) for path in sorted(rows_at.glob("*.json"))]
    found = summary(rows)
    write_results(out, {**found, "rows": rows}, table(found))
    print((out / "results.md").read_text())


if __name__ == "__main__":
    typer.run(main)
