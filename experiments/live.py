"""A craft that is watched: the same answer as afterwards, how soon, how often a false one, how fast.

usage: python -m experiments.live --out DIR [--quick]

Logs of the independent plant (`experiments/blind`) at 10 Hz, half of them by sticks and half under feedback:

- *Same*: a thruster that is weak from the first sample on. Nats of the suspect that `diagnose` names first,
  at the log's end, beside those of a watch that names nothing; and the names of one that does. Those of its
  first round are alike: the file may bend there, as where a craft is watched, and in an answer that holds it
  as it is a name does more.
- *Delay*: a thruster that grows weak under way, from hardly to badly.
- *False alarms*: nothing hidden, in calm water, gusts, slow forces and a current that wanders.
- *Hours*: nothing hidden, in these and in waves, an hour each, most of them at 1 Hz, watched at three
  settings of `--false-alarms`. The craft is commanded as often as its log has a row.
- *Pace*: logs of six axes at 50 Hz, drawn by the package itself, with the whole catalogue: nothing hidden,
  and a thruster that grows weak. Seconds of the processor per second of the log, once programs are compiled;
  what first compiles while the thruster is named counts.
- *Long*: a day in gusts, drawn likewise, at 1 Hz. Memory of the process hour by hour.

It goes on where it was cut. Writes results.json and results.md.
"""

import json
import shutil
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import psutil
import typer

import jaxmarine as jm
from experiments._study import program, save_figure, study, write_results
from experiments.blind.cases import DT, make_case
from experiments.blind.disturbances import KINDS as WEATHERS
from experiments.blind.plant import Effect
from jaxmarine._types import CHANNELS
from jaxmarine.disturbances import RandomWrench
from jaxmarine.effects import place
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle_io import suspect_named

HERE = Path(__file__).parent / "live"
CRAFT, THRUSTER = "cybership2", "port"
STEERINGS = ("rich", "pilot")
DISTURBANCES = ("none", "gusts", "slow", "current")
WORDS = {"rich": "sticks", "pilot": "a pilot"}
WATERS = {
    "none": "calm",
    "gusts": "gusts",
    "slow": "slow forces",
    "waves": "waves",
    "current": "a current that wanders",
}
# Factors of a thruster that grows weak at 150 s of a log of 300 s, and of one that always is.
FACTORS, SINCE, DURATION, SEEN = (0.95, 0.9, 0.8, 0.6, 0.3), 150.0, 300.0, 0.8
# Logs of each factor and steering, and how much later each begins than the one before [s]: at any time of a
# window or a block.
DRAWS, LATER = 6, 0.7
# Of logs that are timed: sample time [s], duration [s], when the clock starts [s], and what becomes of a
# thruster in the middle of what is timed.
FAST, TIMED, WARM, WEAK = 0.02, 240.0, 120.0, 0.5
# Of a long log: sample time [s], and its hours.
SLOW, HOURS = 1.0, 24
# Of logs of an hour: how often each weather and steering is drawn, and the sample times of 10 in turn [s].
TIMES, HOUR, EVERY = 10, 3600.0, (0.1, *[1.0] * 9)
# False names a day that are allowed.
SETTINGS = (0.01, 1.0, 100.0)
KINDS = ("position", "attitude", "velocity", "rate")
Row = dict[str, Any]


def rows_of(log: Log):
    """What a link would send of a log, row by row."""
    assert log.commands is not None
    for t, channels, commands in zip(log.t, log.channels, log.commands, strict=True):
        yield {
            "t": float(t),
            **dict(zip(CHANNELS, channels.tolist(), strict=True)),
            **dict(zip(log.command_names, commands.tolist(), strict=True)),
        }


def watched(vehicle: jm.Vehicle, log: Log, **options: Any) -> jm.Watch:
    """A watch that has seen a log."""
    watch = jm.Watch(vehicle, **options)
    for row in rows_of(log):
        watch.update(row)
    return watch


def names_of(watch: jm.Watch) -> list[Row]:
    return [{"label": n.label, "since": n.since, "at": n.at, "nats": n.nats} for n in watch.named]


def opened(
    folder: Path,
    hidden: list[Effect],
    seed: int,
    duration: float,
    steering: str,
    disturbance: str,
    held: int = 1,
):
    """A case of the independent plant: its vehicle file and its two logs; `held`: as of `make_case`."""
    make_case(
        folder,
        CRAFT,
        hidden,
        seed,
        duration_train=duration,
        duration_test=DURATION / 2,
        disturbance=disturbance,
        excitation=steering,
        held=held,
    )
    vehicle = jm.load_vehicle(folder / "vehicle.toml")
    return vehicle, *(jm.read_log(folder / name, vehicle) for name in ("train.csv", "test.csv"))


def same(folder: Path, factor: float, seed: int, steering: str, disturbance: str) -> Row:
    """One log, watched and diagnosed."""
    hidden = [Effect("thruster_gain", THRUSTER, {"factor": factor})]
    vehicle, train, test = opened(folder, hidden, seed, DURATION, steering, disturbance)
    watch, open_end = watched(vehicle, train), watched(vehicle, train, false_alarms=0.0).status.nats
    diagnosis = jm.diagnose(vehicle, train, test)
    found = diagnosis.findings
    first = found[0] if found else None
    leading = max(open_end, key=lambda label: open_end[label])
    return {
        "factor": factor,
        "named": names_of(watch),
        "diagnosed": [[one.label, one.log_evidence] for one in found],
        "leading": [leading, open_end[leading]],
        "first": None if first is None else nats_of(first.label, diagnosis, open_end),
    }


def nats_of(label: str, diagnosis: jm.Diagnosis, watched: Mapping[str, float]) -> list[Any]:
    """A name, its nats in the answer, in the first round and of a watch; None where it was not weighed.

    An answer may hold the file as it is; in the first round it may bend, as where a craft is watched.
    """
    answered = next(one.log_evidence for one in diagnosis.findings if one.label == label)
    weighed = (one.log_evidence for one in next(iter(diagnosis.rounds), ()) if one.label == label)
    return [label, answered, next(weighed, None), watched.get(label)]


def delay(folder: Path, factor: float, since: float, seed: int, steering: str, disturbance: str) -> Row:
    """How long after its beginning a weak thruster is named; None: not within the log."""
    hidden = [Effect("thruster_gain", THRUSTER, {"factor": factor}, since)]
    vehicle, train, _ = opened(folder, hidden, seed, DURATION, steering, disturbance)
    named = names_of(watched(vehicle, train))
    right = [one for one in named if one["label"] == f"thruster_gain:{THRUSTER}"]
    return {
        "factor": factor,
        "since": since,
        "named": named,
        "false": sum(one["at"] < since for one in named),
        "first_right": bool(named) and named[0] in right,
        "delay": right[0]["at"] - since if right and right[0]["at"] >= since else None,
        "off": right[0]["since"] - since if right and right[0]["since"] is not None else None,
    }


def null(folder: Path, duration: float, seed: int, steering: str, disturbance: str) -> Row:
    """What is named of a log that hides nothing."""
    vehicle, train, _ = opened(folder, [], seed, duration, steering, disturbance)
    watch = watched(vehicle, train)
    return {"hours": duration / 3600.0, "named": names_of(watch), "most": max(watch.status.nats.values())}


def hour(folder: Path, seconds: float, dt: float, seed: int, steering: str, disturbance: str) -> Row:
    """What is named of a long log that hides nothing, at each setting: none where the loosest names none.

    The craft is commanded as often as its log has a row: what such rows do not show, none could explain.
    """
    every = round(dt / DT)
    vehicle, train, _ = opened(folder, [], seed, seconds, steering, disturbance, every)
    shutil.rmtree(folder)
    assert train.commands is not None
    each = slice(None, None, every)
    sparse = train.t[each], train.channels[each], train.commands[each], None
    log = Log(*sparse, train.command_names, train.name)
    named: dict[str, list[Row]] = {}
    for setting in sorted(SETTINGS, reverse=True):
        quiet = bool(named) and not list(named.values())[-1]
        named[f"{setting:g}"] = [] if quiet else names_of(watched(vehicle, log, false_alarms=setting))
    return {"hours": seconds / 3600.0, "dt": dt, "named": named}


def drawn(vehicle: jm.Vehicle, t: np.ndarray, size: np.ndarray, held: float, seed: int) -> Log:
    """A log of a craft in gusts of some size [N, N m], whose commands are held so long [s]."""
    rng = np.random.default_rng(seed)
    names = vehicle.command_names
    steps = rng.uniform(-0.4, 0.4, (round(t[-1] / held) + 2, len(names)))
    commands = steps[(t / held).astype(int)]
    push = RandomWrench(size, np.full(6, 4.0)).draw(t, seed + 1)
    blank = Log(t, np.full((len(t), 18), np.nan), commands, None, names, "drawn")
    clean = np.asarray(simulate(vehicle, blank, initial_state(vehicle), push=push).channels)
    # Accelerations are not measured, all else as the file states it.
    std = np.repeat([*(dict(vehicle.sensors)[kind] for kind in KINDS), np.nan, np.nan], 3)
    return Log(t, clean + std * rng.normal(size=clean.shape), commands, None, names, "drawn")


def pace(timed: float, warm: float, factor: float) -> Row:
    """Seconds of the processor per second of a log of six axes at 50 Hz; its first thruster grows weak."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("bluerov2_heavy"))
    thruster, since = vehicle.thruster_names[0], 0.5 * (timed + warm)
    weak = place(suspect_named(vehicle, "thruster_gain", thruster), vehicle, {"factor": factor})
    size, t = np.array([2.0, 2.0, 2.0, 0.2, 0.2, 0.5]), np.arange(0.0, timed, FAST)
    log = drawn(vehicle.place(jm.Placed(weak, thruster, since)), t, size, 4.0, 1)
    watch, calls, wall, spent = jm.Watch(vehicle), [], 0.0, 0.0
    for row in rows_of(log):
        wall, spent = time.perf_counter(), time.process_time()
        watch.update(row)
        if row["t"] >= warm:
            calls.append((time.perf_counter() - wall, time.process_time() - spent))
    walls, spents = np.array(calls).T
    seconds = len(calls) * FAST
    return {
        "factor": factor,
        "axes": int(vehicle.free.sum()),
        "rate": 1.0 / FAST,
        "suspects": len(watch.status.nats),
        "seconds": seconds,
        "wall_share": float(walls.sum() / seconds),
        "processor_share": float(spents.sum() / seconds),
        "longest": float(walls.max()),
        "named": names_of(watch),
    }


def long(hours: float) -> Row:
    """Memory of the process [MiB] hour by hour of a log in which nothing is hidden."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle(CRAFT))
    t = np.arange(0.0, 3600.0 * hours, SLOW)
    log = drawn(vehicle, t, np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.03]), 8.0, 3)
    watch, memory, begun = jm.Watch(vehicle), [], time.process_time()
    for k, row in enumerate(rows_of(log), 1):
        watch.update(row)
        if k % round(3600.0 / SLOW) == 0:
            memory.append(round(psutil.Process().memory_info().rss / 2**20, 1))
    spent = time.process_time() - begun
    return {
        "hours": hours,
        "memory": memory,
        "processor_share": spent / (3600.0 * hours),
        "blocks": watch.status.blocks,
        "named": names_of(watch),
    }


Job = tuple[str, tuple[Any, ...]]
MEASURED = {"same": same, "delay": delay, "null": null, "hour": hour}
DRAWN = {"pace": pace, "long": long}


def planned(quick: bool) -> dict[str, Job]:
    """What is measured: of each row its name, what kind of it, and by what."""
    steerings = STEERINGS[:1] if quick else STEERINGS
    calm = DISTURBANCES[:1] if quick else DISTURBANCES[:2]
    timed = (24.0, 12.0) if quick else (TIMED, WARM)
    plan: dict[str, Job] = {"pace": ("pace", (*timed, 1.0))}
    if not quick:
        plan |= {"pace_weak": ("pace", (*timed, WEAK)), "long": ("long", (HOURS,))}
    for j, steering in enumerate(steerings):
        for k, water in enumerate(calm):
            plan[f"same_{j}{k}"] = "same", (SEEN, 100 + 10 * k + j, steering, water)
        for i, factor in enumerate((SEEN,) if quick else FACTORS):
            for n in range(1 if quick else DRAWS):
                # Calm and gusts in turn.
                water = calm[(i + j + n) % len(calm)]
                by = factor, SINCE + LATER * n, 200 + 2000 * n + 10 * i + j, steering, water
                plan[f"delay_{j}{i}{n}"] = "delay", by
        for k, water in enumerate(calm if quick else DISTURBANCES):
            # Logs of calm water and gusts are watched before a fault as well; a current fools most.
            for n in range(1 if water in calm else 5 if water == "current" else 3):
                seed = 300 + 100 * n + 10 * k + j
                plan[f"null_{j}{k}{n}"] = "null", (60.0 if quick else DURATION, seed, steering, water)
    for n in range(1 if quick else TIMES):
        for k, water in enumerate(WEATHERS[:1] if quick else WEATHERS):
            for j, steering in enumerate(steerings):
                by = (60.0 if quick else HOUR), EVERY[n], 1000 + 100 * n + 10 * k + j, steering, water
                plan[f"hour_{n}{k}{j}"] = "hour", by
    return plan


def row(name: str, job: Job, out: Path) -> Row:
    """One of them, kept beside its log."""
    kept = out / f"{name}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    kind, by = job
    if kind in DRAWN:
        found = DRAWN[kind](*by)
    else:
        found = {"steering": by[-2], "disturbance": by[-1]} | MEASURED[kind](out / name, *by)
    found = {"name": name, "kind": kind, **found, "program": program()}
    kept.write_text(json.dumps(found, indent=1) + "\n")
    return found


# --- summary -------------------------------------------------------------------------------------


def summary(rows: list[Row]) -> Row:
    """What all rows say together."""

    def of(kind: str) -> list[Row]:
        return [one for one in rows if one["kind"] == kind]

    sizes = []
    for factor in sorted({one["factor"] for one in of("delay")}, reverse=True):
        for water in DISTURBANCES[:2]:
            some = [one for one in of("delay") if (one["factor"], one["disturbance"]) == (factor, water)]
            if some:
                sizes.append({"factor": factor, "disturbance": water, **size_of(some)})
    quiet = []
    for water in DISTURBANCES:
        # What is named before the fault of a log with one is as false.
        nulls = [one for one in of("null") if one["disturbance"] == water]
        before = [one for one in of("delay") if one["disturbance"] == water]
        labels = [name["label"] for one in nulls for name in one["named"]]
        labels += [name["label"] for one in before for name in one["named"] if name["at"] < one["since"]]
        if nulls or before:
            hours = sum(one["hours"] for one in nulls) + sum(one["since"] for one in before) / 3600.0
            quiet.append({"disturbance": water, "hours": hours, "names": sorted(labels)})
    return {
        "same": of("same"),
        "sizes": sizes,
        "quiet": quiet,
        "settings": [settings_of(of("hour"), water) for water in WEATHERS],
        "pace": of("pace"),
        "long": of("long"),
    }


def size_of(some: list[Row]) -> Row:
    """Of logs with a fault of one size: what was named, and seconds from the fault to its name.

    None, of a delay's median and of what 95 % do not exceed: longer than the log.
    """
    delays = sorted(one["delay"] for one in some if one["delay"] is not None)
    every = [*delays, *[np.inf] * (len(some) - len(delays))]
    # Of an order, as what was not named in time has no number to be between.
    at = np.quantile(every, [0.5, 0.95], method="inverted_cdf").tolist()
    median, most = (None if one == np.inf else one for one in at)
    return {
        "logs": len(some),
        "named": len(delays),
        "first": sum(one["first_right"] for one in some),
        "false": sum(bool(one["named"]) and not one["first_right"] for one in some),
        "delays": delays,
        "median": median,
        "most": most,
    }


def settings_of(hours: list[Row], water: str) -> Row:
    """Of long logs in some water: hours, and the names at each setting."""
    some = [one for one in hours if one["disturbance"] == water]
    names = {
        f"{setting:g}": sorted(name["label"] for one in some for name in one["named"][f"{setting:g}"])
        for setting in SETTINGS
    }
    return {"disturbance": water, "hours": sum(one["hours"] for one in some), "names": names}


def counted(labels: list[str]) -> str:
    """How often each was named, the most frequent first."""
    counts = sorted(Counter(labels).items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} `{label}`" for label, count in counts)


def compared(answered: float, bending: float, watched: float) -> str:
    """Nats by a diagnosis, in its answer and beside a file that may bend, and by a watch."""
    return f"{answered:.0f} | {bending:.0f} | {watched:.0f} | {watched / bending:.2f}"


def table(found: Row) -> str:
    """What stands in `docs/live.md`, as Markdown."""
    out = ["| log | watch named | `diagnose` named | its nats | of its first round | of a watch | ratio |"]
    out.append("| --- | --- | --- | --- | --- | --- | --- |")
    for one in found["same"]:
        watched = ", ".join(f"`{name['label']}`" for name in one["named"]) or "nothing"
        diagnosed = ", ".join(f"`{label}`" for label, _ in one["diagnosed"]) or "nothing"
        unweighed = one["first"] is None or None in one["first"]
        nats = " | | | " if unweighed else compared(*one["first"][1:])
        steering = WORDS.get(one["steering"], one["steering"])
        out.append(f"| {steering}, {WATERS[one['disturbance']]} | {watched} | {diagnosed} | {nats} |")
    out += [
        "",
        "| factor of the thrust | water | named, of logs | first | another first | median [s] | 95 % [s] |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in found["sizes"]:
        at = " | ".join("not in time" if one[k] is None else f"{one[k]:.0f}" for k in ("median", "most"))
        out.append(
            f"| {one['factor']:g} | {WATERS[one['disturbance']]} | {one['named']} of {one['logs']} | "
            f"{one['first']} | {one['false']} | {at} |"
        )
    out += ["", "| water | hours watched | false names | which |", "| --- | --- | --- | --- |"]
    for one in found["quiet"]:
        names = counted(one["names"])
        out.append(f"| {WATERS[one['disturbance']]} | {one['hours']:.2f} | {len(one['names'])} | {names} |")
    said = " | ".join(f"at {setting:g} a day" for setting in SETTINGS)
    out += ["", f"| water | hours watched | {said} |", "| --- | --- |" + " --- |" * len(SETTINGS)]
    for one in found["settings"]:
        if one["hours"]:
            names = " | ".join(counted(one["names"][f"{setting:g}"]) or "none" for setting in SETTINGS)
            out.append(f"| {WATERS[one['disturbance']]} | {one['hours']:.2f} | {names} |")
    for one in found["pace"]:
        names = ", ".join(f"`{name['label']}`" for name in one["named"]) or "nothing"
        hidden = "nothing hidden" if one["factor"] == 1 else f"a thruster that falls to {one['factor']:g}"
        out += [
            "",
            f"{one['axes']} axes at {one['rate']:.0f} Hz, {hidden}, {names} named: "
            f"{one['processor_share']:.2f} s of the processor and {one['wall_share']:.2f} s by the clock per "
            f"second of the log; the longest call of `update` took {one['longest']:.1f} s.",
        ]
    for one in found["long"]:
        first, *_, last = memory = one["memory"]
        out += [
            "",
            f"{one['hours']} hours in gusts at {1 / SLOW:g} Hz, {one['blocks']} blocks: the process holds "
            f"{first:.0f} MiB after the first hour, {last:.0f} MiB after the last and {max(memory):.0f} MiB "
            f"at most; {len(one['named'])} names, {one['processor_share']:.3f} s of the processor per second "
            "of the log.",
        ]
    return "\n".join(out) + "\n"


def delays(sizes: list[Row], path: Path) -> None:
    """Seconds from a fault to its name over its size: each log, median, and what 95 % do not exceed."""
    plot, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    never = DURATION - SINCE
    for water, colour, aside in (("none", "#1f6fb5", -0.006), ("gusts", "#c2571a", 0.006)):
        some = [one for one in sizes if one["disturbance"] == water]
        lost = np.array([1.0 - one["factor"] for one in some])
        for one, x in zip(some, lost, strict=True):
            ax.plot([x + aside] * len(one["delays"]), one["delays"], "o", color=colour, ms=3, alpha=0.5)
            unnamed = one["logs"] - one["named"]
            if unnamed:
                ax.annotate(str(unnamed), (x + 2 * aside, never), color=colour, fontsize=8, ha="center")
        for key, style, text in (("median", "-", "median"), ("most", "--", "95 %")):
            at = [np.nan if one[key] is None else one[key] for one in some]
            ax.plot(lost, at, style, color=colour, lw=1.2, label=f"{WATERS[water]}, {text}")
    ax.set(
        yscale="log",
        xlabel="share of its thrust that a thruster loses",
        ylabel="from the fault to its name [s]",
        ylim=(1.0, 1.3 * never),
    )
    ax.set_yticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
    ax.minorticks_off()
    ax.legend(frameon=False, fontsize=8, loc="upper right")
    ax.spines[["top", "right"]].set_visible(False)
    save_figure(plot, path)


def main(
    out: Annotated[Path, typer.Option(help="Where logs, rows and results are written.")],
    quick: Annotated[bool, typer.Option("--quick", help="One log of each kind.")] = False,
) -> None:
    """Watches logs with a known answer."""
    with study(out, quick):
        rows = [row(name, job, out) for name, job in planned(quick).items()]
        found = summary(rows)
        write_results(out, {"program": program(), **found, "rows": rows}, table(found))
        delays(found["sizes"], out / "delays.png")
    print((out / "results.md").read_text())


if __name__ == "__main__":
    typer.run(main)
