"""Cases with a known answer: what the user believes, two logs, and what is hidden in them.

usage: python -m experiments.blind.cases OUT --nulls 6 --singles 30 --pairs 8 --outside 5 --seed 1

A case is a folder of `vehicle.toml`, `train.csv`, `test.csv` and `answer.json`. Its `options` state
how it was made; `severity` is the factor by which what is hidden raises the error of 5 s open-loop
predictions on the test log, root mean square over channels in units of the noise, above the floor
that noise and disturbance leave.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from . import catalogue, disturbances, outside
from .catalogue import DAMP, LASTING, Draw, Scales, scales
from .disturbances import gauss_markov
from .excitation import ALONE, axes, surroundings
from .excitation import commands as operator
from .feedback import STEERINGS, Controller, wrapped
from .plant import SENSOR, Disturbance, Effect, Model, Outside, Run, observed, simulate
from .severity import altered, equivalents, likeness, nearest, prediction_error
from .vehicle import DOFS, FOLDER, GEARED, Array, Vehicle, from_tables, load, perturbed

DT = 0.1  # s
GEARS = tuple(sorted(path.stem for path in GEARED.glob("*.toml")))
STEEPEST = 1.05  # rad, pitch and roll that a case may reach
LATEST = 12  # samples: more than any sensor of the catalogue is late
STRANGE = 0.3  # squared share of an effect outside the catalogue that the nearest named one has to leave
SPREAD = 0.15  # relative error of the coefficients of a wrong vehicle file
RIVALS = (
    {"input_delay", "thruster_lag"},
    {"deadband", "thrust_curve", "saturation", "thruster_gain", "reverse_thrust", "inflow_loss"},
    {"velocity_scale", "velocity_misalignment", "velocity_in_earth_axes", "velocity_lever_arm"},
)
Hidden = Effect | Outside


class Unruly(Exception):
    """The vehicle left sane attitudes or its controller's hands, or the run diverged."""


@dataclass
class Log:
    """One simulated log: true run, commands, and the sensors' noise (K, 18) where a controller saw it."""

    run: Run
    commands: Array
    effects: list[Effect] = field(default_factory=list)
    noise: Array | None = None

    @property
    def times(self) -> Array:
        """Sample times [s]."""
        return DT * np.arange(len(self.commands))

    def seen(self) -> Array:
        """What sensors without noise log, (K, 18)."""
        return observed(self.effects, self.times, self.run.signals())[:, :, 0]


@dataclass
class Loop:
    """A controller in the loop: it sees a sample with its noise, and its commands are kept for the log.

    - `commands` (K, thrusters): those given so far; `noise` (K, 18).
    - `held`: for how many samples a command stays before the controller is asked again.
    """

    controller: Controller
    effects: list[Effect]
    outside: list[Outside]
    commands: Array
    noise: Array
    held: int = 1

    def __post_init__(self) -> None:
        self.signals = np.zeros((len(self.commands), 18, 1))
        self.acting = np.zeros_like(self.commands)
        self.distorted = any(e.effect in SENSOR for e in self.effects)
        self.altering = [o.commands for o in self.outside if o.commands is not None]

    def __call__(self, k: int, s: Array) -> Array:
        """What the thrusters see at sample k, (thrusters, 1), in the state s (13, 1)."""
        self.signals[k, :12] = s[:12]
        clean = self.signals[k, :, 0]
        if self.distorted and k:  # at the first sample there is nothing late yet
            past = np.arange(max(0, k - LATEST), k + 1)
            clean = observed(self.effects, DT * past, self.signals[past])[-1, :, 0]
        seen = clean + self.noise[k]
        seen[3:6] = wrapped(seen[3:6])
        craft = self.controller.vehicle
        steered = len(craft.steered)
        given = self.commands[k : k + 1, steered:]
        if k % self.held:
            now = np.append(self.commands[k - 1, :steered], given)
        else:
            now = craft.asked(self.controller(k, seen[:12])[None], given)[0]
        self.commands[k] = now
        # What such an effect makes of a command depends on it, and on what it made of the one before.
        for alter in self.altering:
            pair = np.array([self.acting[k - 1] if k else now, now])
            now = alter(DT * np.array([k - 1, k]), pair)[1]
        self.acting[k] = now
        return now[:, None]


def roll_out(
    vehicle: Vehicle,
    hidden: Sequence[Hidden],
    commands: Array,
    heading: float,
    disturbance: Disturbance | None = None,
) -> Log:
    """A run from rest at the origin with what is hidden acting from its `since`."""
    named, unnamed = parted(hidden)
    seen = altered(unnamed, DT * np.arange(len(commands)), commands)
    return Log(sailed(vehicle, hidden, seen, heading, disturbance), commands, named)


def close_loop(
    vehicle: Vehicle,
    hidden: Sequence[Hidden],
    controller: Controller,
    noise: Array,
    heading: float,
    disturbance: Disturbance | None = None,
    given: Array | float = 0.0,
    held: int = 1,
) -> Log:
    """The same under a controller, that sees each sample with its noise (K, 18).

    - `given`: what the surroundings fill of the columns, if there are such; `held`: as of `Loop`.
    """
    named, unnamed = parted(hidden)
    commands = np.zeros((len(noise), len(vehicle.columns)))
    commands[:, len(vehicle.steered) :] = given
    loop = Loop(controller, named, unnamed, commands, noise, held)
    run = sailed(vehicle, hidden, loop.commands, heading, disturbance, loop)
    if held * controller.strayed > 0.5 * len(noise):
        raise Unruly(f"{vehicle.name} does not keep its heading")
    return Log(run, loop.commands, named, noise)


def regulated(
    vehicle: Vehicle,
    hidden: Sequence[Hidden],
    steering: str,
    samples: int,
    rng: np.random.Generator,
    level: float,
    disturbance: Disturbance | None = None,
    held: int = 1,
) -> Log:
    """A run of so many samples with set-points, noise and heading at the start drawn at random."""
    controller = Controller(vehicle, steering, samples, rng, level, DT * held)
    noise = vehicle.noise * rng.standard_normal((samples, 18))
    heading, given = float(rng.uniform(-np.pi, np.pi)), surroundings(vehicle, samples, rng)
    return close_loop(vehicle, hidden, controller, noise, heading, disturbance, given, held)


def parted(hidden: Sequence[Hidden]) -> tuple[list[Effect], list[Outside]]:
    """What is in the catalogue, and what is outside it."""
    named = [e for e in hidden if isinstance(e, Effect)]
    return named, [e for e in hidden if isinstance(e, Outside)]


def sailed(
    vehicle: Vehicle,
    hidden: Sequence[Hidden],
    commands: Array,
    heading: float,
    disturbance: Disturbance | None,
    steer: Loop | None = None,
) -> Run:
    """The run of commands as thrusters see them, or of a loop."""
    named, unnamed = parted(hidden)
    afloat = disturbance is not None and disturbance.water is not None
    starts = sorted({0, *(round(e.since / DT) for e in named if e.since is not None)})
    schedule = [
        (
            k,
            Model(
                vehicle,
                [e for e in named if e.since is None or round(e.since / DT) <= k],
                unnamed,
                afloat,
            ),
        )
        for k in starts
    ]
    start = np.zeros((13, 1))
    start[5] = heading
    with np.errstate(all="ignore"):
        run = simulate(
            schedule, commands[:, :, None], start, len(commands), disturbance=disturbance, steer=steer
        )
    tilt = np.abs(run.states[:, 3:5]).max()
    if not np.isfinite(run.states).all() or tilt > STEEPEST:
        raise Unruly(f"{vehicle.name} tilts by {tilt:.2f} rad")
    return run


def believed_error(vehicle: Vehicle, log: Log) -> float:
    """Mean square prediction error of the vehicle without what is hidden, in units of the noise."""
    return prediction_error(Model(vehicle), log.run, log.commands, log.seen())


def floor_error(vehicle: Vehicle, hidden: Sequence[Hidden], log: Log) -> float:
    """Mean square prediction error that the disturbance leaves to the true model."""
    named, unnamed = parted(hidden)
    seen = altered(unnamed, log.times, log.commands)
    return prediction_error(Model(vehicle, named, unnamed), log.run, seen, log.seen())


def table(vehicle: Vehicle, log: Log, noise: Array, rng: np.random.Generator) -> str:
    """The log as CSV text, angles wrapped, six digits.

    With white noise of these deviations (18), or with that which its controller saw.
    """
    drawn = noise * rng.standard_normal((len(log.commands), 18)) if log.noise is None else log.noise
    signals = log.seen() + drawn
    signals[:, 3:6] = wrapped(signals[:, 3:6])
    channels = vehicle.signals()
    columns = np.column_stack([log.times, signals[:, [row for _, row in channels]], log.commands])
    head = ",".join(["t", *(name for name, _ in channels), *vehicle.columns])
    return head + "\n" + "\n".join(",".join(f"{x:.6g}" for x in row) for row in columns) + "\n"


def always(hidden: Sequence[Hidden]) -> list[Hidden]:
    """The same effects, acting from the start: the test log follows the training log."""
    return [replace(e, since=None) if isinstance(e, Effect) else e for e in hidden]


def rounded(parameters: dict[str, float]) -> dict[str, float]:
    """Parameters to five digits, as the answer states them and the plant uses them."""
    return {k: float(f"{v:.5g}") for k, v in parameters.items()}


def with_noise(raw: dict[str, Any], scale: float) -> dict[str, Any]:
    """The vehicle file's tables with all noise deviations times a factor."""
    return raw | {"sensors": {k: round(v * scale, 9) for k, v in raw["sensors"].items()}}


def make_case(
    out_dir: Path,
    vehicle: str,
    hidden: Sequence[Hidden],
    seed: int,
    *,
    duration_train: float = 300.0,
    duration_test: float = 150.0,
    noise: float = 1.0,
    disturbance: float | str = 0.0,
    misfit: bool = False,
    excitation: str = "rich",
    held: int = 1,
) -> dict[str, Any]:
    """Writes one case and returns its answer.

    - `noise`: factor on the file's noise deviations, in the logs and in the written file.
    - `disturbance`: deviation of a coloured wrench, as a share of what `Scales.wrench` calls a
      moderate push, or one of `disturbances.KINDS`.
    - `misfit`: the written file has every damping and added-mass coefficient wrong by 15 %.
    - `excitation`: of `excitation.commands`, by sticks, or one of `feedback.STEERINGS`.
    - `held`: for how many samples a command stays, as a craft has it whose computer is slower.
    """
    rng = np.random.default_rng([seed, 1])
    raw = with_noise(load(vehicle).raw, noise)
    truth = from_tables(raw)
    hidden = [replace(e, parameters=rounded(e.parameters)) if isinstance(e, Effect) else e for e in hidden]
    tau = float(rng.uniform(1.0, 5.0))

    kind, coloured = (disturbance, 0.0) if isinstance(disturbance, str) else (None, disturbance)
    weather = None if kind in (None, "none") else disturbances.draw(kind, rng)

    def push(samples: int) -> Disturbance | None:
        if weather is not None:
            return disturbances.over(weather, truth, samples, rng)
        if not coloured:
            return None
        size = typical(truth, excitation).wrench * np.isin(np.arange(6), truth.free)
        return Disturbance(gauss_markov(samples, coloured * size, tau, rng))

    def log(duration: float, effects: Sequence[Hidden], level: float) -> Log:
        samples = round(duration / DT)
        if excitation in STEERINGS:
            return regulated(truth, effects, excitation, samples, rng, level, push(samples), held)
        commands = (level * operator(truth, samples, rng, excitation)).round(6)
        steered = slice(len(truth.steered))
        commands[:, steered] = commands[np.arange(samples) // held * held, steered]
        pushed = push(samples)
        return roll_out(truth, effects, commands, float(rng.uniform(-np.pi, np.pi)), pushed)

    level = 1.0
    while True:
        try:
            train = log(duration_train, hidden, level)
            test = log(duration_test, always(hidden), level)
            break
        except Unruly:
            level *= 0.7
            if level < 0.2:
                raise
    error, floor = believed_error(truth, test), floor_error(truth, always(hidden), test)
    answer = describe(truth, hidden, test, error)
    answer["options"] |= {
        "severity": round(float(np.sqrt((1.0 + error) / (1.0 + floor))), 3),
        "floor": round(float(np.sqrt(1.0 + floor)), 3),
        "vehicle": vehicle,
        "excitation": excitation,
        "level": level,
        "headings": [float(x.run.states[0, 5, 0]) for x in (train, test)],
        "noise": noise,
        "disturbance": disturbance,
        "seed": seed,
    }
    if kind is not None:
        answer["options"]["steering"] = excitation if excitation in STEERINGS else "sticks"
    if weather is not None:
        answer["options"]["weather"] = asdict(weather)
    if kind == "waves" and not hidden:
        answer["also"] = ["waves"]
    if held > 1:
        answer["options"]["held"] = held
    if misfit:
        raw = perturbed(raw, SPREAD, rng)
        answer["options"]["misfit"] = True
    out_dir.mkdir(parents=True, exist_ok=True)
    (out_dir / "vehicle.toml").write_text(tomli_w.dumps(raw))
    (out_dir / "train.csv").write_text(table(truth, train, truth.noise, rng))
    (out_dir / "test.csv").write_text(table(truth, test, truth.noise, rng))
    (out_dir / "answer.json").write_text(json.dumps(answer, indent=1) + "\n")
    return answer


def describe(vehicle: Vehicle, hidden: Sequence[Hidden], test: Log, error: float) -> dict[str, Any]:
    """The answer's findings, or its unknown degrees of freedom and the signals they depend on."""
    unnamed = [e for e in hidden if isinstance(e, Outside)]
    if unnamed:
        dofs = sorted({d for e in unnamed for d in e.dofs}, key=DOFS.index)
        signals = sorted({s for e in unnamed for s in e.depends_on})
        likest = nearest(vehicle, unnamed, test.run, test.commands)
        options = {"outside": [e.name for e in unnamed], "nearest": likest}
        return {"unknown": dofs, "depends_on": signals, "options": options}
    findings = [
        {
            "accept": [
                [e.effect, e.target],
                *equivalents(vehicle, replace(e, since=None), test.run, test.commands, error),
            ],
            "since": e.since,
            "parameters": e.parameters,
        }
        for e in hidden
        if isinstance(e, Effect)
    ]
    return {"findings": findings, "options": {}}


def trial(vehicle: Vehicle, excitation: str, hidden: Sequence[Hidden] = (), disturbance: str = "none") -> Log:
    """A short run with always the same commands, to measure magnitudes on.

    Under a controller always the same are its set-points, the noise, and a middling disturbance of a kind.
    """
    rng = np.random.default_rng(0)
    seconds = ALONE * len(axes(vehicle)) if excitation == "single" else 60.0
    samples, fed = round(seconds / DT), excitation in STEERINGS
    commands = np.empty(0) if fed else operator(vehicle, samples, rng, excitation)
    weather = None if disturbance == "none" else disturbances.middling(disturbance)
    level = 1.0
    while True:
        try:
            if not fed:
                return roll_out(vehicle, hidden, level * commands, 0.5)
            rng = np.random.default_rng(0)
            push = None if weather is None else disturbances.over(weather, vehicle, samples, rng)
            return regulated(vehicle, hidden, excitation, samples, rng, level, push)
        except Unruly:
            level *= 0.7
            if level < 0.3:
                raise


def typical(vehicle: Vehicle, excitation: str) -> Scales:
    """Scales of a run with nothing hidden."""
    log = trial(vehicle, excitation)
    return scales(vehicle, log.run.states[:, 6:12, 0], log.commands)


def sized(vehicle: Vehicle, d: Draw, severity: float, excitation: str) -> Hidden | None:
    """The drawn effect at the magnitude that gives about this severity, or None where it cannot.

    Prediction errors grow about as the magnitude, so each trial scales it by the ratio of the
    wanted to the found error; where that leaves the bracket, the bracket is halved. What has no
    magnitude is as it is.
    """
    wanted, a, low, high = severity**2 - 1.0, d.guess, d.low, d.high
    best: tuple[float, Hidden] | None = None
    if d.low == d.high:
        return d.build(a)
    for _ in range(8):
        effect = d.build(a)
        try:
            error = believed_error(vehicle, trial(vehicle, excitation, [effect]))
        except Unruly:
            high, a = a, float(np.sqrt(low * a))
            continue
        ratio = float(np.sqrt(wanted / max(error, 1e-6)))
        if best is None or abs(np.log(ratio)) < abs(np.log(best[0])):
            best = ratio, effect
        if 0.85 < ratio < 1.18 or (ratio > 1.0 and a >= d.high) or (ratio < 1.0 and a <= d.low):
            break
        low, high = (a, high) if ratio > 1.0 else (low, a)
        a = float(np.clip(a * np.clip(ratio, 0.2, 4.0), d.low, d.high))
        a = a if low <= a <= high else float(np.sqrt(low * high))
    return best[1] if best and 0.6 < best[0] < 1.7 else None


def spread_severities(n: int, low: float, high: float, rng: np.random.Generator) -> Array:
    """n numbers spread evenly on a logarithmic scale, in random order."""
    steps = (np.arange(n) + rng.uniform(0.0, 1.0, n)) / max(n, 1)
    return rng.permutation(low * (high / low) ** steps)


def named(
    vehicle: Vehicle,
    name: str,
    severity: float,
    excitation: str,
    rng: np.random.Generator,
    train: float,
) -> Effect | None:
    """A random effect of this name and severity; some lasting ones begin within the log."""
    s = typical(vehicle, excitation)
    for _ in range(6):
        found = sized(vehicle, catalogue.draw(name, vehicle, s, rng), severity, excitation)
        if isinstance(found, Effect):
            late = name in LASTING and rng.random() < 0.25
            since = round(float(rng.uniform(0.3, 0.7)) * train, 1) if late else None
            return replace(found, since=since)
    return None


def compatible(first: str, second: str) -> bool:
    """Whether two names differ in what they do to the vehicle."""
    return first != second and not any({first, second} <= rivals for rivals in RIVALS)


def pair(
    vehicle: Vehicle,
    both: tuple[str, str],
    severities: Array,
    excitation: str,
    rng: np.random.Generator,
    train: float,
) -> list[Hidden]:
    """Two effects of these names, or none where they are alike or too much for the vehicle."""
    made = [named(vehicle, n, s, excitation, rng, train) for n, s in zip(both, severities, strict=True)]
    a, b = made
    if a is None or b is None:
        return []
    log = trial(vehicle, excitation)
    if likeness(vehicle, replace(a, since=None), replace(b, since=None), log.run, log.commands) > 0.9:
        return []
    try:
        trial(vehicle, excitation, always([a, b]))
    except Unruly:
        return []
    return [a, b]


def disturbance_level(vehicle: Vehicle, floor: float, excitation: str) -> float:
    """Share of `Scales.wrench` whose coloured wrench raises the floor to about this factor."""
    if floor == 1.0:
        return 0.0
    log = trial(vehicle, excitation)
    size = typical(vehicle, excitation).wrench * np.isin(np.arange(6), vehicle.free)
    push = Disturbance(gauss_markov(len(log.commands), 0.05 * size, 2.5, np.random.default_rng(0)))
    error = believed_error(vehicle, roll_out(vehicle, [], log.commands, 0.5, push))
    return round(float(0.05 * np.sqrt((floor**2 - 1.0) / error)), 4)


def floor_under(vehicle: Vehicle, steering: str, disturbance: str) -> float:
    """Factor by which a middling disturbance of this kind raises the error of the true model."""
    if disturbance == "none":
        return 1.0
    log = trial(vehicle, steering, disturbance=disturbance)
    return float(np.sqrt(1.0 + floor_error(vehicle, [], log)))


@dataclass(frozen=True)
class Plan:
    """How many cases of each kind, and how long their logs are [s]."""

    nulls: int
    singles: int
    pairs: int
    outside: int
    misfit: int
    train: float
    test: float
    severity: tuple[float, float] | None = None
    noises: tuple[float, ...] = (1.0,)  # factors on the noise, one drawn for each case
    feedback: float = 0.0  # share of the cases of each kind that a controller steers
    geared: float = (
        0.0  # share of the cases of each kind on craft with propellers, surfaces or turning thrusters
    )


KINDS = ("nulls", "singles", "pairs", "outside", "misfit")
SEVERITIES = {
    "singles": (1.3, 8.0),
    "pairs": (1.8, 5.0),
    "outside": (1.8, 8.0),
    "misfit": (2.0, 8.0),
}
# Largest error by an effect under feedback, in units of the noise, and how far above the error that a
# disturbance leaves where that is as large: more would be grosser than what its craft could be steered with.
GROSS, PLAIN = 8.0, 2.0
DISTURBED = {"nulls": 0.34, "misfit": 1.0}


def turn(number: int, share: float) -> bool:
    """Whether it is this number's turn, of numbers from 0 of which a share has theirs."""
    return int((number + 1) * share) > int(number * share)


class Designer:
    """Random choices that take turns: vehicles and effects are cards dealt from shuffled decks."""

    def __init__(self, plan: Plan, vehicles: Sequence[str], seed: int) -> None:
        self.plan = plan
        self.rng = np.random.default_rng(seed)
        self.fleet = {name: load(name) for name in (*vehicles, *GEARS) if plan.geared or name in vehicles}
        self.decks: dict[str, list[str]] = {}
        self.known = sorted({n for v in self.fleet.values() for n in catalogue.names(v)})
        self.strange = sorted({n for v in self.fleet.values() for n in outside.names(v)})

    def deal(self, deck: str, content: Sequence[str], fit: Sequence[str]) -> str:
        """The next card that fits; the deck is filled anew when none is left."""
        cards = self.decks.setdefault(deck, [])
        if not any(c in fit for c in cards):
            cards.extend(self.rng.permutation(content).tolist())
        return cards.pop(next(i for i, c in enumerate(cards) if c in fit))

    def hidden(
        self, kind: str, vehicle: Vehicle, severity: float, floor: float, excitation: str
    ) -> list[Hidden]:
        """What is hidden in one case; severities count above the floor of the disturbance."""
        above = np.array([severity, self.rng.uniform(1.8, 4.0)])
        if excitation in STEERINGS:
            above = np.minimum(above, max(PLAIN, GROSS / floor))
        sizes = np.sqrt(1.0 + (above**2 - 1.0) * floor**2)
        if kind == "nulls":
            return []
        if kind == "pairs":
            while True:
                fit = catalogue.names(vehicle)
                first = self.deal(kind, self.known, fit)
                second = self.deal(kind, self.known, [n for n in fit if compatible(first, n)])
                if made := pair(vehicle, (first, second), sizes, excitation, self.rng, self.plan.train):
                    return made
        size, found = float(sizes[0]), None
        while found is None:
            if kind == "outside":
                name = self.deal(kind, self.strange, outside.names(vehicle))
                d = outside.draw(name, vehicle, typical(vehicle, excitation), self.rng)
                found = sized(vehicle, d, size, excitation)
                continue
            barred = DAMP if kind == "misfit" else ()
            content = [n for n in self.known if n not in barred]
            name = self.deal(kind, content, [n for n in catalogue.names(vehicle) if n not in barred])
            found = named(vehicle, name, size, excitation, self.rng, self.plan.train)
        return [found]

    def write(self, folder: Path, kind: str, number: int, severity: float) -> str:
        """Writes one case and returns it in words."""
        # By twos, as turns at the controllers go by ones.
        geared = turn(number // 2 + KINDS.index(kind), self.plan.geared)
        fit = [name for name, craft in self.fleet.items() if bool(craft.gear.columns) == geared]
        ship = self.deal("vehicle", list(self.fleet), fit)
        vehicle = self.fleet[ship]
        if turn(number + KINDS.index(kind), self.plan.feedback):
            # A craft that is steered by its way cannot keep a place.
            fit = [one for one in STEERINGS if one != "station" or not vehicle.gear.surfaces]
            excitation = self.deal("steering", STEERINGS, fit)
            kinds = disturbances.KINDS
            # Beside a wrong file something always pushes.
            disturbance = self.deal("disturbance", kinds, kinds[1:] if kind == "misfit" else kinds)
            floor = floor_under(vehicle, excitation, disturbance)
        else:
            excitation = str(self.rng.choice(["rich", "weak", "single"], p=[0.8, 0.1, 0.1]))
            disturbed = turn(number, DISTURBED.get(kind, 0.2))
            floor = float(self.rng.uniform(1.3, 2.5)) if disturbed else 1.0
            disturbance = disturbance_level(vehicle, floor, excitation)
        noise = float(self.rng.choice(self.plan.noises))
        while True:
            hidden = self.hidden(kind, vehicle, severity, floor, excitation)
            try:
                answer = make_case(
                    folder, ship, hidden, int(self.rng.integers(2**31)),
                    duration_train=self.plan.train, duration_test=self.plan.test,
                    disturbance=disturbance, misfit=kind == "misfit",
                    excitation=excitation, noise=noise,
                )  # fmt: skip
            except Unruly:
                continue
            if answer["options"].get("nearest", (None, None, 1.0))[2] < STRANGE:
                continue
            return line(folder.name, ship, hidden, answer)


def design(out: Path, plan: Plan, vehicles: Sequence[str], seed: int) -> None:
    """Writes a balanced set of cases and prints a line for each.

    Of those that sticks steer a third of the nulls, all misfits and a fifth of the rest are disturbed; a
    tenth is excited weakly, a tenth one axis at a time. To the others ways of steering and kinds of
    disturbances are dealt.
    """
    designer = Designer(plan, vehicles, seed)
    for kind in KINDS:
        count = getattr(plan, kind)
        low, high = plan.severity or SEVERITIES.get(kind, (1.0, 1.0))
        severities = spread_severities(count, low, high, designer.rng)
        for number, severity in enumerate(severities):
            folder = out / f"{kind.removesuffix('s')}_{number:02d}"
            print(designer.write(folder, kind, number, float(severity)), flush=True)


def line(name: str, vehicle: str, hidden: Sequence[Hidden], answer: dict[str, Any]) -> str:
    """One case in words."""
    o = answer["options"]
    what = "; ".join(
        f"{e.effect}:{e.target} {rounded(e.parameters)} since {e.since}"
        if isinstance(e, Effect)
        else f"{e.name} on {','.join(e.dofs)}, nearest {o['nearest']}"
        for e in hidden
    )
    also = [f"{n}:{t}" for f in answer.get("findings", []) for n, t in f["accept"][1:]]
    return (
        f"{name:12s} {vehicle:15s} {o['excitation']:8s} {o['disturbance']!s:7s} "
        f"severity {o['severity']:6.2f} floor {o['floor']:.2f}  "
        f"{what or 'nothing'}" + (f"  also {also}" if also else "")
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--train", type=float, default=300.0, help="length of the training log, s")
    parser.add_argument("--test", type=float, default=150.0, help="length of the test log, s")
    parser.add_argument("--feedback", type=float, default=0.0, help="share of logs that a controller steers")
    parser.add_argument("--geared", type=float, default=0.0, help="share of logs of craft with such gear")
    parser.add_argument(
        "--severity", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range for all kinds"
    )
    parser.add_argument("--vehicles", nargs="+", default=sorted(p.stem for p in FOLDER.glob("*.toml")))
    a = parser.parse_args()
    span = None if a.severity is None else (a.severity[0], a.severity[1])
    plan = Plan(
        a.nulls,
        a.singles,
        a.pairs,
        a.outside,
        a.misfit,
        a.train,
        a.test,
        span,
        feedback=a.feedback,
        geared=a.geared,
    )
    design(a.out, plan, a.vehicles, a.seed)


if __name__ == "__main__":
    main()
