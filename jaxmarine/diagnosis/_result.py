"""What a diagnosis says, as plain values: `diagnosis.json` is made from this and nothing else."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from .._types import CHANNEL_UNITS
from ..disturbances import RandomWrench
from ..effects import AbstractEffect
from ..fitting import Check, wrapped
from ..logs import Rejected, together
from ..networks import LearnedWrench
from ..vehicle import Vehicle

FAR = 10.0  # in units of the sensor noise: what a disturbance leaves, and a wrong axis or sign exceeds

Verdict = Literal["nothing_found", "explained", "partly_explained", "unexplained"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A fitted number with its standard error, in `unit`."""

    value: float
    std: float
    unit: str


def _label(effect: str, target: str | None) -> str:
    return effect if target is None else f"{effect}:{target}"


@dataclasses.dataclass(frozen=True)
class Alternative:
    """Another cause that was weighed, with its own log evidence [nats] over the model without either."""

    effect: str
    target: str | None
    log_evidence: float
    indistinguishable: bool

    @property
    def label(self) -> str:
        return _label(self.effect, self.target)


@dataclasses.dataclass(frozen=True)
class Excess:
    """A missing force that is larger than a disturbance can be, and when it acts.

    - `begin`, `end`: by the clock of the log [s]; `log_begin`: where that log begins.
    - `rms`, `peak`: in `unit`, over half seconds and beyond the noise; `share`: that rms over the full thrust
      in `strongest`, the axis on which thrusters push hardest (of forces, or of moments).
    """

    log: str
    begin: float
    end: float
    log_begin: float
    rms: float
    peak: float
    unit: str
    share: float
    strongest: str


@dataclasses.dataclass(frozen=True)
class Finding:
    """One cause: what it is, where, since when, how large, how sure.

    - `effect`, `target`: names of the catalogue; `unknown` and an axis where no effect explains the force.
    - `since`: from when it acts [s, of the log `since_log`]; None: always.
    - `log_evidence` [nats]: logarithm of the Bayes factor of the model with it over the one without it; of an
      unknown force half the chi-square that it saves, over its dispersion.
    - `signals`: on which an unknown force depends; `learned`: whether the extended vehicle carries it.
    - `excess`: of an unknown force that depends on no signal, how much more it is than a disturbance can be.
    """

    effect: str
    target: str | None
    since: float | None
    since_log: str | None
    parameters: dict[str, Parameter]
    log_evidence: float
    alternatives: tuple[Alternative, ...] = ()
    signals: tuple[str, ...] = ()
    learned: bool = False
    excess: Excess | None = None

    @property
    def label(self) -> str:
        return _label(self.effect, self.target)

    @property
    def named(self) -> bool:
        """Whether it names a cause, and does not only say where one is unknown."""
        return self.effect != LearnedWrench.name


@dataclasses.dataclass(frozen=True)
class BeforeAfter:
    """A root-mean-square error before and after, with the 95 % interval of the ratio of the two.

    - `worse`: whether it has grown for certain, and by more than the noise of the sensor explains.
    """

    before: float
    after: float
    ratio_ci95: tuple[float, float] | None = None
    worse: bool = False

    @property
    def ratio(self) -> float | None:
        """After over before; None where nothing was wrong before."""
        return self.after / self.before if self.before > 0 else None


@dataclasses.dataclass(frozen=True)
class LogGain:
    """The ratio of errors on one of the test logs, as `Gain` has it of all; `starts`: scored predictions."""

    name: str
    ratio: float
    ratio_ci95: tuple[float, float] | None
    held_out: bool
    starts: int


@dataclasses.dataclass(frozen=True)
class Unscored:
    """Starts of a test log, `count` of `of`, that are not scored: neither model meets the log there.

    - `quantities`: in which the estimated state is off, the most frequent first.
    """

    log: str
    count: int
    of: int
    quantities: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Gain:
    """What the extension buys on the test logs: open-loop predictions over `horizon` seconds.

    `ratio` is that of the error over all measured channels, each in units of its noise; its interval is None
    where the logs are too short for one. `held_out` is False where a test log is also a training log; where
    it is true, test logs could at most take names back that buy nothing on them.

    - `position` to `rate`: lengths of the vectors of errors, None where nothing of it was measured;
      `channels`: each measured channel by its name, in its own unit.
    - `per_log`: each test log by itself. `unscored`: starts that are left out of all this.
    - `sound`: False where so many starts are wrong that what is measured here says little.
    """

    horizon: float
    position: BeforeAfter | None  # [m]
    velocity: BeforeAfter | None  # [m/s]
    ratio: float
    ratio_ci95: tuple[float, float] | None
    held_out: bool
    starts: int  # number of predictions
    attitude: BeforeAfter | None = None  # [rad]
    rate: BeforeAfter | None = None  # [rad/s]
    channels: dict[str, BeforeAfter] = dataclasses.field(default_factory=dict)
    per_log: tuple[LogGain, ...] = ()
    unscored: tuple[Unscored, ...] = ()
    sound: bool = True

    @property
    def quantities(self) -> dict[str, BeforeAfter | None]:
        """The errors of whole vectors by name."""
        return {name: getattr(self, name) for name in ("position", "attitude", "velocity", "rate")}

    @property
    def worse(self) -> dict[str, BeforeAfter]:
        """The quantities and channels that are predicted worse than before for certain."""
        every = self.quantities | self.channels
        return {name: one for name, one in every.items() if one is not None and one.worse}

    def to_json(self) -> dict:
        """What `diagnosis.json` holds under `gain`."""

        def pair(value: BeforeAfter | None):
            return value and {
                "before": value.before,
                "after": value.after,
                "ratio": value.ratio,
                "ratio_ci95": value.ratio_ci95 and list(value.ratio_ci95),
            }

        return {
            "horizon_s": self.horizon,
            "position_rmse_m": pair(self.position),
            "attitude_rmse_rad": pair(self.attitude),
            "velocity_rmse_m_s": pair(self.velocity),
            "rate_rmse_rad_s": pair(self.rate),
            "per_channel": {name: pair(one) for name, one in self.channels.items()},
            "worse": list(self.worse),
            "ratio": self.ratio,
            "ratio_ci95": self.ratio_ci95 and list(self.ratio_ci95),
            "held_out": self.held_out,
            "per_log": [dataclasses.asdict(one) for one in self.per_log],
            "starts": self.starts,
            "unscored": [dataclasses.asdict(one) for one in self.unscored],
            "sound": self.sound,
        }


# Share of what will be measured that a band of predictions is to hold.
BANDS = 0.9

_UNITS = {"position": "m", "attitude": "rad", "velocity": "m/s", "rate": "rad/s"} | {
    str(name): unit for name, unit in CHANNEL_UNITS.items()
}


def _grown(name: str, error: BeforeAfter) -> str:
    """`u 0.6 to 1.1 m/s (1.83 times, 95 %: 1.7 to 2)`."""
    low, high = error.ratio_ci95 or (np.nan, np.nan)
    return (
        f"{name} {error.before:.3g} to {error.after:.3g} {_UNITS[name]} ({error.ratio:.3g} times, 95 %: "
        f"{low:.3g} to {high:.3g})"
    )


@dataclasses.dataclass(frozen=True)
class Weighed:
    """One line of a round's ranking: a suspect and what it would save."""

    label: str
    log_evidence: float
    saved_chi2: float  # over all windows, after refitting everything else
    parameters: dict[str, float]
    since: float | None = None  # where it was weighed from a beginning on [s]
    since_log: str | None = None


@dataclasses.dataclass(frozen=True)
class Dropped:
    """What was found on the way and taken out again, and a sentence that says why."""

    label: str
    reason: str


@dataclasses.dataclass(frozen=True)
class Recalibrated:
    """A coefficient of the file that was refitted without being a finding."""

    label: str  # such as linear_damping:surge
    file_value: float
    value: float
    std: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Predictions:
    """Open-loop predictions on a test log.

    - `times` [starts, steps]: log time [s] of each step after a start; the prediction begins at `begin`
      (an index along steps): what lies before it is where the start state was estimated.
    - `measured`, `before`, `after` [starts, steps, channels]: in the order of `ALL_CHANNELS`; NaN where not
      measured. `noise` [channels]: standard deviation per channel, NaN where not measured.
    - `log`: the name of the test log. `band` [ahead, channels]: from the start on, how far `after` is off at
      most in a share `BANDS` of predictions (`_bands.py`); None where no training log is long enough to tell.
    """

    times: Float[np.ndarray, "starts steps"]
    begin: int
    measured: Float[np.ndarray, "starts steps channels"]
    before: Float[np.ndarray, "starts steps channels"]
    after: Float[np.ndarray, "starts steps channels"]
    noise: Float[np.ndarray, " channels"]
    log: str = ""
    band: Float[np.ndarray, "ahead channels"] | None = None

    @property
    def held(self) -> float | None:
        """Share of what was measured from the starts on that lies within the band."""
        if self.band is None:
            return None
        after, measured = self.after[:, self.begin :], self.measured[:, self.begin :]
        seen = np.isfinite(measured) & np.isfinite(self.band)
        inside = np.abs(np.asarray(wrapped(after - measured))) <= self.band
        return float(inside[seen].mean()) if seen.any() else None


@dataclasses.dataclass(frozen=True)
class MissingWrench:
    """The wrench that a model lacks over the training logs, estimated from the windows.

    - `log`, `t` [knots]: which log (index) and time [s]; `wrench`, `std` [knots, 6]: in SI units, NaN on
      locked axes; `velocity` [knots, 6]: body velocity there.
    """

    log: np.ndarray
    t: Float[np.ndarray, " knots"]
    wrench: Float[np.ndarray, "knots 6"]
    std: Float[np.ndarray, "knots 6"]
    velocity: Float[np.ndarray, "knots 6"]


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The whole answer.

    - `rounds`: the suspects in the order of their evidence, per round of the search and then in the place of
      each of the file's coefficients that was found wrong.
    - `groups`: sets of labels that these logs cannot tell apart.
    - `depends_on`: signals that the residual depends on after the named findings and before any learned
      term; `white`: nothing but sensor noise is left.
    - `catalogue`: the effects that were suspected.
    - `tests`: the names of the logs on which the gain is measured; `predictions`: those on the longest.
    - `check`: what the training logs tell of the file's coefficients, the named findings given; None
      where they lie on workers.
    - `misfit_before`, `misfit_after`: chi-square per sample over the training windows; noise gives 1, less
      what the windows' fitted starts take of it (5 % of a log of poses at 10 Hz).
    - `disturbance`: what disturbs the craft besides, None where no disturbance was estimated.
    - `doubted`: a sentence where the model leaves what no noise is: then no name is more than probable.
    - `contradicted`: a sentence where sensors contradict one another, whatever forces act.
    - `notes`: sentences for the reader (what was ignored, estimated, or could not be done).
    - `rejected`: stretches of the logs that were left out, with the reason.
    - `dropped`: what was found on the way and does not stand in the answer.
    - `missed`: whether sensors of unstated noise, missed by far more than that, count by what is missed.
    - `clocks`: what the clock of each log shows at its start [s] (`Log.clock`).
    """

    verdict: Verdict
    findings: tuple[Finding, ...]
    gain: Gain
    white: bool
    depends_on: tuple[str, ...]
    vehicle: Vehicle
    extended: Vehicle
    recalibrated: tuple[Recalibrated, ...]
    rounds: tuple[tuple[Weighed, ...], ...]
    groups: tuple[tuple[str, ...], ...]
    misfit_before: float
    misfit_after: float
    predictions: Predictions
    missing_before: MissingWrench
    missing_after: MissingWrench
    catalogue: tuple[type[AbstractEffect], ...]
    check: Check | None
    train: tuple[str, ...]
    tests: tuple[str, ...]
    disturbance: RandomWrench | None = None
    doubted: str | None = None
    contradicted: str | None = None
    notes: tuple[str, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    dropped: tuple[Dropped, ...] = ()
    missed: bool = False
    clocks: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def test(self) -> str:
        """The test log's name, or the names of all of them."""
        return together(self.tests)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What stands before any praise: doubts, what is predicted worse, and a gain that says little."""
        out = [] if self.doubted is None else [self.doubted]
        if self.gain.worse:
            told = ", ".join(_grown(name, one) for name, one in self.gain.worse.items())
            out.append(f"Predicted worse than by the vehicle file on {self.test}, for certain: {told}.")
        if not self.gain.sound:
            out.append(
                f"The gain could not be measured well on {self.test}: at too many starts of a prediction "
                "neither the vehicle file nor the extended vehicle meets the log; their errors say little."
            )
        return tuple(out)

    def clock_of(self, one: "Finding | Weighed") -> float:
        """What the clock of the log in which it begins shows at that log's start [s]."""
        return self.clocks.get(one.since_log or self.train[0], 0.0)

    @property
    def far(self) -> bool:
        """Whether so much is left that log or file are rather wrong as a whole than disturbed.

        Where a disturbance was estimated it is part of what is left, and as large as it is found plausible.
        """
        implausible = self.disturbance is None or any(not f.named for f in self.findings)
        return self.misfit_after > FAR**2 and implausible

    def causes_of(self, group: Sequence[str]) -> tuple[str, ...]:
        """The causes of a group in words, as `jaxmarine plan --cause` takes them.

        Each with the parameters at which it explains the training logs best.
        """
        found = {f.label: {name: p.value for name, p in f.parameters.items()} for f in self.findings}
        # The ranking in which the finding won: what is said of the others holds in its place.
        own = [ranking for ranking in self.rounds if ranking and ranking[0].label == group[0]]
        rankings = own or self.rounds
        weighed = sorted((one for ranking in rankings for one in ranking), key=lambda one: one.log_evidence)
        values = {one.label: one.parameters for one in weighed} | found
        return tuple(
            " ".join([label, *(f"{name}={value:.4g}" for name, value in values.get(label, {}).items())])
            for label in group
        )

    def to_json(self) -> dict:
        """The content of `diagnosis.json` (schema 1)."""

        def finding(f: Finding) -> dict:
            out: dict[str, Any] = dataclasses.asdict(f)
            out["alternatives"] = list(out["alternatives"])
            if f.since_log is None:
                del out["since_log"]
            if f.named:
                del out["signals"], out["learned"]
            if f.excess is None:
                del out["excess"]
            return out

        return {
            "schema": 1,
            "verdict": self.verdict,
            "findings": [finding(f) for f in self.findings],
            "gain": self.gain.to_json(),
            "bands": {"share": BANDS, "held": self.predictions.held},
            "residual_after": {"white": self.white, "depends_on": list(self.depends_on)},
            "disturbance": self.disturbance and self.disturbance.to_json(),
            "recalibrated": [dataclasses.asdict(one) for one in self.recalibrated],
            "rejected": [dataclasses.asdict(one) for one in self.rejected],
            "dropped": [dataclasses.asdict(one) for one in self.dropped],
            "notes": list(self.notes),
            "excitation": [
                {
                    "dof": axis.dof,
                    "excited": axis.excited,
                    "velocity_rms": axis.coverage.velocity_rms,
                    "velocity_range": list(axis.coverage.velocity_range),
                    "relative_std": {
                        "inertia": axis.inertia,
                        "damping": axis.damping,
                        "linear": axis.linear,
                        "quadratic": axis.quadratic,
                    },
                }
                for axis in (self.check.axes if self.check else ())
            ],
        }
