"""The command line. Every mistake in what is handed in ends with one sentence and exit code 2."""

import functools
import os
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated, TypeVar

from . import __version__
from ._errors import InputError
from ._extras import need, of_extra
from ._progress import FOUND, Estimate
from ._start import prepare

with of_extra("cli", "The command line"):
    import typer
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        SpinnerColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.text import Text

Result = TypeVar("Result")

_STOPPED = 130


class _Stopped(BaseException):
    """Ctrl-C while work goes on beside the main thread: what is left of it, in words."""


_FIRST_TIME = "the first time for a vehicle, programs are compiled for about a minute"

app = typer.Typer(
    help="Identifies marine vehicles from measured logs: simulates, fits, and names what a model gets wrong.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
# A thruster called `bow` is no picture.
_out = Console(emoji=False)
_err = Console(stderr=True, emoji=False)

VehicleOption = Annotated[Path, typer.Option("--vehicle", help="Vehicle file (TOML).", show_default=False)]
TrainOption = Annotated[
    list[Path],
    typer.Option(
        "--train",
        help="Training log (CSV, Parquet, bag, ...); repeat in order of time.",
        show_default=False,
    ),
]
ColumnsOption = Annotated[
    Path | None,
    typer.Option("--columns", help="Column map: where the recording keeps each column (TOML)."),
]


@contextmanager
def _progress(text: str):
    """A bar with the stage, the share done and the time left; lines of them where there is no terminal.

    Those lines go where the results go: what stands on stderr is what was wrong.
    """
    estimate = Estimate()
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(20),
        TimeElapsedColumn(),
        _Left(estimate),
    )
    with Progress(*columns, console=_err, transient=True, disable=not _err.is_terminal) as bar:
        task = bar.add_task(text, total=None)

        def tell(words: str) -> None:
            estimate.hear(words)
            # Without a share there is nothing to fill a bar by: it moves to and fro.
            bar.update(
                task, description=words, completed=estimate.share, total=1.0 if estimate.share else None
            )
            if not _err.is_terminal:
                told = str(estimate)
                print(f"{words} ... {told}".rstrip(), flush=True)

        yield tell


class _Left(ProgressColumn):
    """The share that is done and the time that is left."""

    def __init__(self, estimate: Estimate):
        super().__init__()
        self.estimate = estimate

    def render(self, task: Task) -> Text:
        del task
        return Text(str(self.estimate))


def _version(asked: bool) -> bool:
    if asked:
        _say(f"jaxmarine {__version__}")
        raise typer.Exit
    return asked


@app.callback()
def _options(
    asked: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Prints the version.")
    ] = False,
) -> None:
    del asked


@app.command(
    epilog="Example: `jaxmarine diagnose --vehicle rov.toml --train mon.csv --train tue.csv "
    "--test wed.csv --out report`"
)
def diagnose(
    vehicle: VehicleOption,
    train: TrainOption,
    test: Annotated[
        list[Path],
        typer.Option(
            "--test", help="Log on which the gain is measured; repeat for several.", show_default=False
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for report, diagnosis.json and extended.toml.")
    ] = Path("report"),
    columns: ColumnsOption = None,
    window: Annotated[
        float | None, typer.Option("--window", min=0.5, help="Length of the windows [s].")
    ] = None,
) -> None:
    """Shows what the vehicle file gets wrong on its logs, names the cause, and measures the gain."""
    prepare()
    from .diagnosis import diagnose as run
    from .logs import read_logs
    from .vehicle_io import load_vehicle

    _can_report(out)
    craft = load_vehicle(vehicle)
    columns_map = _columns(columns)
    logs = read_logs(train, craft, columns_map)
    held_out = read_logs(test, craft, columns_map)
    _note(*logs, *held_out)
    with _progress(f"diagnosing; {_FIRST_TIME}") as tell:
        result = _stoppable(
            lambda tell: run(craft, logs, held_out, window=window, progress=tell), tell, _import_reports
        )
    _write(result, out, said=_notes(*logs, *held_out))


def _can_report(out: Path) -> None:
    """Checks that a report could be written, before the work is done."""
    need(("jinja2", "matplotlib"), "report", "A report")
    _folder(out, make=False)


def _import_reports() -> None:
    """Takes seconds, which compiled programs leave to Python while they run."""
    import_module(".reports", __package__)


def _stoppable(
    work: Callable[[Callable[[str], None]], Result],
    tell: Callable[[str], None],
    meanwhile: Callable[[], None] = lambda: None,
    left: str = "nothing was written.",
) -> Result:
    """The result of long work, done beside the main thread: Ctrl-C ends the program at once.

    A compiled program looks up only when it has ended, which may take a minute; what was found until then
    is said. The main thread does `meanwhile`, and waits.
    """
    found = []

    def listen(words: str) -> None:
        tell(words)
        if words.startswith(FOUND):
            found.append(words.removeprefix(FOUND))

    try:
        future = ThreadPoolExecutor(1).submit(work, listen)
        meanwhile()
        while not future.done():
            wait([future], timeout=0.2)
        return future.result()
    except KeyboardInterrupt:
        so_far = f" Found so far, not settled: {', '.join(found)}." if found else ""
        raise _Stopped(left + so_far) from None


def _folder(out: Path, make: bool = True) -> None:
    """Makes the folder for the results, or only checks that it could be made."""
    nearest = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise InputError(f"{out}: is no folder that can be written; choose another --out.")
    if make:
        out.mkdir(parents=True, exist_ok=True)


def _file(out: Path) -> None:
    """Checks that a result could be written, before the work is done."""
    if out.is_dir() or not out.parent.is_dir() or not os.access(out.parent, os.W_OK):
        raise InputError(f"{out}: is no file that can be written; choose another --out.")


def _new_file(out: Path) -> None:
    """The same of a file that people go on to correct by hand: none is written over."""
    _file(out)
    if out.exists():
        raise InputError(f"{out}: exists, and may have been corrected; remove it, or choose another --out.")


def _say(text: str) -> None:
    """A line of results as it is: file names are no markup, and a pipe has no width to wrap at."""
    _out.print(text, markup=False, highlight=False, soft_wrap=True)


def _notes(*logs) -> tuple[str, ...]:
    """What reading the logs has changed or left out."""
    from .logs import merged

    return merged(note for log in logs for note in log.notes)


def _note(*logs) -> None:
    for note in _notes(*logs):
        _say(note)


def _columns(path: Path | None):
    from .logs import read_columns

    return None if path is None else read_columns(path)


def _write(result, out: Path, said: Sequence[str] = ()) -> None:
    """Writes the results and says in a few lines what they are; `said`: notes that were printed before."""
    from ._numbers import plus_minus, unit_on
    from .logs import moment
    from .reports import write_report
    from .vehicle_io import save_vehicle

    _folder(out)
    page = write_report(result, out)
    save_vehicle(result.extended, out / "extended.toml")
    _out.print(f"Verdict: [bold]{result.verdict.replace('_', ' ')}[/bold]")
    for finding in result.findings:
        values = ", ".join(
            f"{name} = {plus_minus(p.value, p.std, unit_on(p.unit, finding.target)).replace('−', '-')}"
            for name, p in finding.parameters.items()
        )
        since = ""
        if finding.since is not None:
            since = f" since {moment(finding.since, result.clock_of(finding))} of {finding.since_log}"
        _say(f"  {finding.label}{since}" + (f": {values}" if values else ""))
    if result.depends_on:
        _say(f"  what is left depends on {', '.join(result.depends_on)}")
    for one in result.dropped:
        _say(f"  dropped: {one.label}. {one.reason}")
    for note in result.notes:
        if note not in (*said, *result.warnings):
            _say(f"  note: {note}")
    for group in result.groups:
        causes = " ".join(f'--cause "{words}"' for words in result.causes_of(group))
        _say(
            f"These logs cannot tell {' from '.join(group)}; for a manoeuvre that would, run\n"
            f"  jaxmarine plan --vehicle VEHICLE {causes}"
        )
    _say_gain(result)
    _say(f"Extended vehicle: {out / 'extended.toml'}")
    _say(f"Report: {page}")


def _say_gain(result) -> None:
    """What the extension buys: first what it makes worse, then all channels together, then each quantity."""
    from ._types import ALL_SENSORS, CHANNEL_UNITS

    gain = result.gain
    for sentence in result.warnings:
        _say(sentence)
    held = "" if gain.held_out else ", not held out"
    _say(
        f"{gain.horizon:g} s prediction error on {result.test}: {gain.ratio:.3f} of what it was "
        f"({_interval(gain.ratio_ci95)}){held}"
    )
    for name, error in gain.quantities.items():
        if error is not None:
            unit = CHANNEL_UNITS[ALL_SENSORS[name][0]]
            channels = [channel for channel in ALL_SENSORS[name] if channel in gain.channels]
            each = ", ".join(f"{channel} {_ratio(gain.channels[channel])}" for channel in channels)
            _say(
                f"  {name}: {error.before:.3g} to {error.after:.3g} {unit}, {_ratio(error)} of it "
                f"({_interval(error.ratio_ci95)}); {each}"
            )
    for one in gain.per_log if len(gain.per_log) > 1 else ():
        held = "" if one.held_out else ", not held out"
        _say(f"  {one.name}: {one.ratio:.3f} ({_interval(one.ratio_ci95)}){held}")


def _interval(ends: tuple[float, float] | None) -> str:
    if ends is None:
        return "too short for an interval"
    return "95 %: {:.3f} to {:.3f}".format(*ends)


def _ratio(error) -> str:
    return "-" if error.ratio is None else f"{error.ratio:.3f}"


@app.command(epilog="Example: `jaxmarine fleet --out trials trials.csv`")
def fleet(
    table: Annotated[
        str,
        typer.Argument(
            help="Table of logs (CSV or Parquet, path or URL) with columns vehicle, train, test and, if you "
            "like, name, craft, date; train and test are paths or globs, separated by `;`.",
            metavar="TABLE",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for fleet.parquet, index.html and a report per log.")
    ] = Path("fleet"),
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", help="Address of a dask.distributed scheduler, whose workers do it."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes on this machine; default one per core.")
    ] = None,
    limit: Annotated[
        float, typer.Option("--limit", min=1.0, help="Longest time of one log [s]; then it is given up.")
    ] = 3600.0,
) -> None:
    """Diagnoses every log of a table on many cores or machines; started again, it goes on."""
    prepare()
    from .fleets import fleet as run

    if scheduler is not None and workers is not None:
        raise InputError("--workers: a scheduler has workers of its own; give one of the two.")
    _folder(out, make=False)
    with _progress(f"diagnosing; {_FIRST_TIME}") as tell:
        result = _stoppable(
            lambda tell: run(table, out, scheduler=scheduler, workers=workers, limit=limit, progress=tell),
            tell,
            left=f"what was done stands in {out}, and the same command goes on with it.",
        )
    count = result.verdicts
    told = ", ".join(f"{count[one]} {one.replace('_', ' ')}" for one in sorted(count) if one != "error")
    _say(f"{count.total()} logs" + (f": {told}" if told else ""))
    if count["error"]:
        _say(f"  {count['error']} could not be used; the table and the page say why")
    _say(f"Table: {out / 'fleet.parquet'}")
    _say(f"Page: {result.page}")


@app.command(epilog="Example: `jaxmarine simulate --vehicle rov.toml --log dive.csv --out simulated.csv`")
def simulate(
    vehicle: VehicleOption,
    log: Annotated[
        Path,
        typer.Option("--log", help="Log with the commands and the start state.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", help="Simulated log (CSV or Parquet).")] = Path(
        "simulated.csv"
    ),
    columns: ColumnsOption = None,
) -> None:
    """Simulates the vehicle under the commands of a log, from the log's first state."""
    prepare()
    import dataclasses

    import numpy as np

    from .logs import read_log, smooth_states, write_log
    from .simulation import initial_state
    from .simulation import simulate as run
    from .vehicle_io import load_vehicle

    _file(out)
    craft = load_vehicle(vehicle)
    recorded = read_log(log, craft, _columns(columns))
    _note(recorded)
    track = smooth_states(recorded, craft.dof)
    start = initial_state(craft, track.position[0], track.attitude[0], track.nu[0])
    with _progress("simulating") as tell:
        channels = _stoppable(lambda _: np.asarray(run(craft, recorded, start).channels), tell)
    if not np.isfinite(channels).all():
        raise InputError(
            f"{vehicle}: the simulation runs away on {log}; check the signs of damping and added mass."
        )
    write_log(dataclasses.replace(recorded, channels=channels), out)
    _say(f"Simulated log: {out}")


# What `jaxmarine fit --free` can name, beside kinds of actuators and effects.
_FREE = {
    "damping": lambda v: (v.damping.linear, v.damping.quadratic),
    "linear": lambda v: v.damping.linear,
    "quadratic": lambda v: v.damping.quadratic,
    "added_mass": lambda v: v.added_mass,
    "coupling": lambda v: (v.added_mass, v.damping.linear, v.damping.quadratic),
    "thrust": lambda v: v.thrusters.max_thrust,
    "reverse_thrust": lambda v: v.thrusters.max_thrust_reverse,
    "curve": lambda v: v.thrusters.quadratic,
    "advance_loss": lambda v: v.thrusters.advance_loss,
}
_OF_THRUSTERS = ("thrust", "reverse_thrust", "curve", "advance_loss")
# How wide a prior is where `all` is free and none is given.
_ALL_PRIOR = 0.3
# Of hulls under way also this, whether the file has it or not: without it a fit bends damping and added mass.
_OF_HULLS = ("hull_lift", "turning_lift")


def _kinds():
    """The kinds of actuators of which logs tell something."""
    from .actuators import KINDS

    return [kind.key for kind in KINDS if kind.told]


def _told(key, vehicle):
    """What logs tell of all actuators of a kind."""
    those = [one for one in vehicle.actuators if one.key == key]
    return tuple(getattr(one, field) for one in those for field in one.told)


def _checked_free(free):
    """Raises unless `--free` names what a fit can free, once."""
    from .effects import CATALOGUE

    names = (*_FREE, *_kinds())
    twice = "damping" in free and {"linear", "quadratic"} & {*free}
    twice = twice or ("coupling" in free and {"damping", "linear", "quadratic", "added_mass"} & {*free})
    if len(set(free)) < len(free) or twice or ("all" in free and {*names} & {*free}):
        raise InputError(
            "--free: names a coefficient twice (`damping` is `linear` and `quadratic`, `coupling` these and "
            "`added_mass`, `all` every one of these); once will do."
        )
    effects = {effect.name for effect in CATALOGUE}
    for name in free:
        if name not in (*names, "all") and name.partition(":")[0] not in effects:
            raise InputError(
                f"--free {name}: is not known; choose from {', '.join(names)}, take an effect of the "
                "catalogue, such as `turning_lift` or `thruster_gain:all`, or all."
            )


def _freed(free, craft):
    """What `--free` names of a vehicle: it with the effects to fit, the names, what selects each."""
    from .vehicle_io import with_effect

    kinds = _kinds()
    has = {one.key for one in craft.actuators}
    lacks = {*kinds} - has
    lacks |= set() if craft.thruster_names else {*_OF_THRUSTERS}
    # Of fixed thrusters alone.
    lacks |= {"advance_loss"} if "swivel" in has else set()
    if "all" in free:
        beside = [name for name in free if name != "all"]
        # What a log with a prior can tell of a craft.
        free = [name for name in ("coupling", *_OF_THRUSTERS, *kinds) if name not in lacks]
        if {"surge", "sway", "yaw"} <= {*craft.dof} and ("surface" in has or "heave" not in craft.dof):
            free += _OF_HULLS
        free += [name for name in beside if name not in free]
    chosen = []
    for name in free:
        if name in lacks:
            what = "thrusters" if name in _OF_THRUSTERS else name.replace("_", " ")
            raise InputError(f"--free {name}: {craft.name} has no {what}; free something else.")
        if name in _FREE:
            chosen.append(_FREE[name])
        elif name in kinds:
            chosen.append(functools.partial(_told, name))
        else:
            craft, which = with_effect(craft, name)
            chosen.append(lambda v, which=which: v.placed[which].effect)
    return craft, free, chosen


@app.command(
    epilog="Example: `jaxmarine fit --vehicle rov.toml --train dive.csv --free damping --out fitted.toml`"
)
def fit(
    vehicle: VehicleOption,
    train: TrainOption,
    free: Annotated[
        list[str],
        typer.Option(
            "--free",
            help=f"What is fitted: {', '.join(_FREE)}, a kind of actuators that the file has (propeller, "
            "surface, wind, ...), an effect, EFFECT[:TARGET], or all (of effects a hull's lift alone); "
            "repeat for several.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Fitted vehicle file.")] = Path("fitted.toml"),
    prior: Annotated[
        float | None,
        typer.Option("--prior", help="Relative width of a prior at the file's values."),
    ] = None,
    columns: ColumnsOption = None,
) -> None:
    """Fits coefficients that the vehicle file has, and effects, by the trajectory loss.

    Of matrices the diagonals; with `coupling` also what joins their axes.
    """
    if prior is not None and not prior > 0:
        raise InputError(f"--prior {prior:g}: is no width; give one above 0, such as 0.3.")
    prepare()
    from .fitting import fit as run
    from .logs import read_logs
    from .vehicle_io import load_vehicle, save_vehicle

    _checked_free(free)
    _file(out)
    prior = _ALL_PRIOR if prior is None and "all" in free else prior
    craft, free, chosen = _freed(free, load_vehicle(vehicle))
    columns_map = _columns(columns)
    logs = read_logs(train, craft, columns_map)
    _note(*logs)
    with _progress(f"fitting; {_FIRST_TIME}") as tell:
        result = _stoppable(
            lambda _: run(
                craft,
                logs,
                lambda v: tuple(select(v) for select in chosen),
                prior=prior,
                entries="coupled" if "coupling" in free else "diagonal",
                throw=False,
            ),
            tell,
        )
    if not result.converged:
        raise InputError(f"{train[0]}: the fit did not succeed: {result.result}")
    save_vehicle(result.vehicle, out)
    _say(str(result))
    _say(f"Fitted vehicle: {out}")


@app.command(epilog="Example: `jaxmarine check --vehicle rov.toml dive.csv`")
def check(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Log (CSV, Parquet, bag, ...); several in order of time.", metavar="LOG", show_default=False
        ),
    ],
    vehicle: VehicleOption,
    columns: ColumnsOption = None,
) -> None:
    """Says how well logs excite each axis, which coefficients they determine, and what to log next."""
    prepare()
    from .fitting import check as run
    from .fitting import disagreement, noise_of
    from .logs import read_logs
    from .vehicle_io import load_vehicle

    craft = load_vehicle(vehicle)
    columns_map = _columns(columns)
    recorded = read_logs(logs, craft, columns_map)
    _note(*recorded)
    with _progress("checking") as tell:
        result = _stoppable(lambda _: run(craft, recorded), tell)
    _say(str(result))
    contradicted = disagreement(craft, recorded, noise_of(craft, recorded))
    if contradicted is not None and not result.gross:
        _say(contradicted)


@app.command(
    epilog='Example: `jaxmarine plan --vehicle rov.toml --cause "buoyancy force=-5" '
    '--cause "constant_wrench:heave value=5" --out plan.csv`'
)
def plan(
    vehicle: VehicleOption,
    cause: Annotated[
        list[str],
        typer.Option(
            "--cause",
            help="EFFECT[:TARGET] with its parameters at what explains the log; repeat for each cause.",
            show_default=False,
        ),
    ],
    duration: Annotated[float, typer.Option("--duration", help="Length of the manoeuvre [s].")] = 60.0,
    out: Annotated[Path, typer.Option("--out", help="Commands and expected motion (CSV).")] = Path(
        "plan.csv"
    ),
    depth: Annotated[tuple[float, float], typer.Option("--depth", help="Shallowest and deepest [m].")] = (
        0.5,
        5.0,
    ),
    tilt: Annotated[float, typer.Option("--tilt", help="Largest roll and pitch [rad].")] = 0.6,
    speed: Annotated[float, typer.Option("--speed", help="Largest speed [m/s].")] = 1.5,
    radius: Annotated[float, typer.Option("--radius", help="Largest distance from the start [m].")] = 15.0,
) -> None:
    """Proposes the commands that would tell causes apart which a log could not, in a box of safe states."""
    prepare()
    from .diagnosis import Box
    from .diagnosis import plan as run
    from .logs import write_log
    from .vehicle_io import cause_named, load_vehicle

    _file(out)
    craft = load_vehicle(vehicle)
    causes = [cause_named(craft, text) for text in cause]
    box = Box(depth, tilt, speed, radius)
    with _progress("planning; for a new duration or kind of cause, programs compile for minutes") as tell:
        result = _stoppable(lambda tell: run(craft, causes, duration, box, progress=tell), tell)
    write_log(result.log, out)
    random = ", ".join(f"{evidence:.1f}" for evidence in sorted(result.random_evidence))
    _say(
        f"A log of this manoeuvre would tell the causes apart by {result.evidence:.1f} nats"
        + (f"; logs of random ones in the same box by {random}." if random else ".")
    )
    _say(f"Commands: {out}")


# Listed by name, as loading `exports` loads the compiler.
_FORMATS = sorted(one.stem for one in (Path(__file__).parent / "exports").glob("[a-z]*.py"))


@app.command(epilog="Example: `jaxmarine export rov.toml --to fmi3 --out rov.fmu`")
def export(
    vehicle: Annotated[
        Path, typer.Argument(help="Vehicle file (TOML).", metavar="VEHICLE", show_default=False)
    ],
    to: Annotated[str, typer.Option("--to", help=f"Format: {', '.join(_FORMATS)}.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="What is written.", show_default=False)],
) -> None:
    """Writes the vehicle for another program, and says what that cannot hold."""
    prepare()
    from .exports import export as run
    from .vehicle_io import load_vehicle

    _file(out)
    craft = load_vehicle(vehicle)
    with _progress("exporting") as tell:
        notes = _stoppable(lambda _: run(craft, out, to), tell)
    for note in notes:
        _say(f"Left behind: {note}")
    _say(f"Exported vehicle: {out}")


@app.command(name="import", epilog="Example: `jaxmarine import rov.sdf --out rov.toml`")
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            help="Gazebo world or model (.sdf), or a script of derivatives (.py, .m).",
            metavar="SOURCE",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Vehicle file (TOML).")] = Path("vehicle.toml"),
) -> None:
    """Makes a vehicle file of another program's, and says what it took for granted."""
    from .imports import import_vehicle

    _new_file(out)
    for note in import_vehicle(source, out):
        _say(f"Note: {note}")
    _say(f"Vehicle file: {out}")


class Kind(StrEnum):
    """Kinds of craft that `demo` and `init` know, by `examples.DEMOS` and `guesses.KINDS`."""

    ROV = "rov"
    AUV = "auv"
    SHIP = "ship"
    BOAT = "boat"


@app.command(
    epilog="Example: `jaxmarine init --like rov --mass 11.5 --length 0.46 --beam 0.58 --draft 0.25 "
    "--out rov.toml`"
)
def init(
    like: Annotated[
        Kind,
        typer.Option(
            "--like",
            help="An ROV with a frame, a torpedo, a ship with a rudder, or a boat with two thrusters.",
            show_default=False,
        ),
    ],
    mass: Annotated[float, typer.Option("--mass", help="Mass in air [kg].", show_default=False)],
    length: Annotated[float, typer.Option("--length", help="Length [m].", show_default=False)],
    beam: Annotated[float, typer.Option("--beam", help="Beam [m].", show_default=False)],
    draft: Annotated[
        float, typer.Option("--draft", help="Draft, of an rov or auv its height [m].", show_default=False)
    ],
    speed: Annotated[
        float | None,
        typer.Option("--speed", help="Top speed, by which thrust is sized [m/s]; default what is usual."),
    ] = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the vehicle; default its kind.")] = None,
    out: Annotated[Path, typer.Option("--out", help="Vehicle file (TOML).")] = Path("vehicle.toml"),
) -> None:
    """Guesses a vehicle file from main dimensions, with sources and with how far it may be off."""
    from .guesses import guess_vehicle

    _new_file(out)
    sizes = {"mass": mass, "length": length, "beam": beam, "draft": draft}
    guess_vehicle(out, like.value, **sizes, speed=speed, name=name)
    _say("All numbers are guesses, actuators placeholders: the file's comments say what to correct.")
    _say(f"Vehicle file: {out}")


@app.command(epilog="Example: `jaxmarine demo --craft ship --out demo-report`")
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for logs and report.")] = Path("demo-report"),
    craft: Annotated[
        Kind,
        typer.Option(
            "--craft",
            help="An ROV with a weak thruster, a torpedo with a stuck plane, a tanker whose rudder is off, "
            "or a ferry with a weak azimuth thruster.",
        ),
    ] = Kind.ROV,
) -> None:
    """Makes a log of a packaged craft with something hidden in it, and finds it."""
    prepare()
    from .diagnosis import diagnose as run
    from .examples import DEMOS
    from .logs import write_log
    from .vehicle_io import save_vehicle

    _can_report(out)
    shown = DEMOS[craft]
    vehicle = shown.vehicle()
    with _progress(f"simulating {vehicle.name}") as tell:
        train, test = _stoppable(lambda _: shown.logs(vehicle), tell)
        tell(f"diagnosing; {_FIRST_TIME}")
        result = _stoppable(lambda tell: run(vehicle, train, test, progress=tell), tell, _import_reports)
    _folder(out)
    save_vehicle(vehicle, out / "vehicle.toml")
    write_log(train, out / "train.csv")
    write_log(test, out / "test.csv")
    _say(f"Hidden in the log: {shown.told}.")
    _write(result, out)


@app.command(epilog="Example: `jaxmarine pool --craft rov --out pool`")
def pool(
    craft: Annotated[
        Kind, typer.Option("--craft", help="An ROV, a torpedo, a tanker's model or a ferry.")
    ] = Kind.ROV,
    out: Annotated[Path, typer.Option("--out", help="Folder for the log and the vehicle file.")] = Path(
        "pool"
    ),
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port on 127.0.0.1; 0 takes a free one.")
    ] = 8760,
) -> None:
    """A simulated craft to fly in the browser, with faults to switch on; it records a log."""
    need(("jinja2", "matplotlib"), "report", "The pool")
    _folder(out, make=False)
    prepare()
    from .pool import CRAFTS, Pool, commands_of, serve

    # Whoever ends it in the usual ways ends it whole.
    ended = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with _progress("compiling for some seconds") as tell:
            _folder(out)
            flown = _stoppable(lambda _: Pool(CRAFTS[craft], out), tell)
        try:
            with suppress(KeyboardInterrupt):
                serve(flown, port, lambda address: _say_pool(address, flown, commands_of(flown)))
        finally:
            flown.close()
        if not flown.log.count:
            _say("Ended; nobody flew, and nothing was recorded.")
            return
        _say(f"Ended after {flown.log.count} samples; log: {flown.log.path}")
        _say(f"Diagnose it:\n  {commands_of(flown)['diagnose']}")
    finally:
        signal.signal(signal.SIGTERM, ended)


def _say_pool(address: str, flown, commands: dict[str, str]) -> None:
    _say(f"Open {address} in a browser; Ctrl-C here ends it.")
    _say(f"Log: {flown.log.path}")
    _say(f"Watch it, in another terminal:\n  {commands['watch']}")


@app.command(
    epilog="Examples: `jaxmarine watch --vehicle rov.toml --page growing.csv`, "
    "`jaxmarine watch --vehicle rov.toml --columns link.toml udp://127.0.0.1:14550`"
)
def watch(
    vehicle: VehicleOption,
    source: Annotated[
        str,
        typer.Argument(
            help="A CSV that grows, `-` (a CSV on standard input), `udp://HOST:PORT` (MAVLink), or a "
            "recording that is replayed (.tlog, ROS 2 bag, ...).",
            metavar="SOURCE",
            show_default=False,
        ),
    ],
    columns: ColumnsOption = None,
    out: Annotated[
        Path, typer.Option("--out", help="Where the extended vehicle is written once a cause is named.")
    ] = Path("extended.toml"),
    false_alarms: Annotated[
        float, typer.Option("--false-alarms", min=1e-6, max=100.0, help="False names per day to allow for.")
    ] = 0.01,
    page: Annotated[
        bool, typer.Option("--page", help="Serves a page on 127.0.0.1, to this machine alone.")
    ] = False,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the page; 0: any.")] = 8642,
    state: Annotated[
        Path | None,
        typer.Option("--state", help="File in which the watch is kept; if it is there, the watch goes on."),
    ] = None,
    stop_after: Annotated[
        float | None,
        typer.Option("--stop-after", min=0.0, help="Ends where nothing has come for so long [s]."),
    ] = None,
) -> None:
    """Watches a craft under way: names a cause when it is sure, and says since when."""
    prepare()
    from .vehicle_io import load_vehicle, save_vehicle
    from .watching import Kept, Page, Watch, follow, open_source, sentence_of

    _file(out)
    if state is not None:
        _file(state)
    craft = load_vehicle(vehicle)
    watched = Watch(craft, false_alarms)
    opened = open_source(source, craft, _columns(columns))
    shown = Page(craft.name, opened.name, port) if page else None
    kept = None if state is None else Kept(state)
    if shown is not None:
        _say(f"Page: {shown.address}")
    _say(f"Watching {craft.name} from {opened.name}; {_FIRST_TIME}.")
    named = 0

    def each(watched: Watch) -> None:
        nonlocal named
        if len(watched.named) > named:
            named = len(watched.named)
            save_vehicle(watched.extended, out)
            say(f"The vehicle with what is named in it: {out}")
        if shown is not None:
            shown.shown(watched)

    def say(sentence: str) -> None:
        _say(sentence)
        sys.stdout.flush()

    try:
        follow(watched, opened, say, each, kept, stop_after)
    except KeyboardInterrupt:
        say("Stopped.")
    finally:
        opened.close()
        if kept is not None:
            kept.close()
        if shown is not None:
            shown.close()
    say(sentence_of(watched.status))


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except _Stopped as stopped:
        print(f"Stopped; {stopped}", file=sys.stderr, flush=True)
        # The thread that works would be waited for.
        os._exit(_STOPPED)
    except SystemExit as end:
        # what Typer makes of an interrupt, without a word
        if end.code == _STOPPED:
            print("Stopped; nothing was written.", file=sys.stderr)
        raise
