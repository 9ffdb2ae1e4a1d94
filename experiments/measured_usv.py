"""A boat's measured runs: from published coefficients to a fitted model and to what is wrong with a log.

usage: python -m experiments.measured_usv --data DIR --out DIR [--quick]

Fits the VTec S-III of `usv/` to the runs of `train/`, chooses among candidates by leaving runs out,
measures open-loop errors on `test/` once, and diagnoses each run of `defects/` and `test/` by itself.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float

import jaxmarine as jm
from experiments._study import save_figure, write_results
from jaxmarine._types import CHANNELS as NAMES
from jaxmarine.actuators import SurgeDrag
from jaxmarine.effects import place
from jaxmarine.physics import from_euler, step_lengths
from jaxmarine.simulation import hold, inputs, substeps
from jaxmarine.vehicle_io import suspect_named

HERE = Path(__file__).parent / "usv"
CHANNELS = ("u", "v", "r")
UNITS = ("m/s", "m/s", "rad/s")
PLACES = np.array([NAMES.index(name) for name in CHANNELS])
PSI = NAMES.index("psi")
AXES = np.array([0, 1, 5])  # surge, sway, yaw
# What a model of this kind misses, times 4.5: errors of twenty neighbouring samples are alike, so that
# they count as one against the priors.
NOISE = {"u": 0.22, "v": 0.19, "r": 0.38}
# Where a log says something of the boat under its commands [s]. At the end of some runs the boat is slowed or
# turned within tenths of a second while its commands ask for the opposite; once the sensor is starting up.
WHOLE = (-np.inf, np.inf)
USABLE = {
    "20210608_151520_guidance_exp0.csv": (-np.inf, 34.05),
    "20210611_122916_guidance_exp0.csv": (-np.inf, 33.0),
    "20210611_123052_guidance_exp0.csv": (1.0, np.inf),
    "20210611_123435_guidance_exp0.csv": (-np.inf, 34.5),
    "20210611_181835_guidance_exp2.csv": (-np.inf, 34.5),
}
HORIZON = 5.0  # [s]
WINDOW = 5.0  # [s]
PADDED = 1000  # samples: one length, one compilation
# What makes errors of the three channels comparable: those of an earlier, smaller model on `test/`.
SCALE = np.array([0.048, 0.043, 0.084])
# What is known of the runs of `defects/`.
KNOWN = {
    "20210608_145654_guidance_exp0.csv": "u and v are north and east velocity",
    "20210708_135407_guidance_exp2.csv": "does not follow its commands from about 14 s",
    "20210708_140256_pf_ca_exp4.csv": "the same from about 11 s",
}
# Where the fit starts: the published damping is off by more than a search should have to mend.
START_LINEAR = np.diag([5.0, 0.0, 1.5])
START_QUADRATIC = np.diag([6.0, 150.0, 1.5])
START_ADDED = np.diag([2.25, 20.0, 0.5])
START_THRUST = 24.0  # [N]
KNOTS = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])  # [m/s] for left-out runs denser is no better
START_DRAG = 8.0  # [N s/m] that of START_LINEAR and START_QUADRATIC at 0.5 m/s

Errors = Float[np.ndarray, "times 3"]


# --- model ---------------------------------------------------------------------------------------


def _six(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "6 6"]:
    """A matrix over surge, sway and yaw as one over all axes."""
    out = np.zeros((6, 6))
    out[np.ix_(AXES, AXES)] = matrix
    return out


def start_of(published: jm.Vehicle) -> jm.Vehicle:
    """The published rigid body with mild damping, and the terms that its file does not have."""
    placed = []
    for name, target, values in (
        ("thruster_lag", None, {"time_constant": 0.1}),
        ("thrust_curve", None, {}),
        ("hull_lift", None, {}),
        ("turning_lift", None, {}),
        ("wind_push", None, {}),
    ):
        effect = place(suspect_named(published, name, target), published, values)
        placed.append(jm.Placed(effect, target))
    drag = SurgeDrag(speed=jnp.asarray(KNOTS), drag=jnp.zeros(len(KNOTS)), names=("surge_drag",))
    vehicle = eqx.tree_at(
        lambda v: (v.added_mass, v.damping.linear, v.damping.quadratic, v.thrusters.max_thrust),
        published,
        (
            jnp.asarray(_six(START_ADDED)),
            jnp.asarray(_six(START_LINEAR)),
            jnp.asarray(_six(START_QUADRATIC)),
            jnp.full(2, START_THRUST),
        ),
    )
    return dataclasses.replace(vehicle, actuators=(drag,)).place(*placed)


def selected(vehicle: jm.Vehicle) -> dict[str, Any]:
    """What is fitted. The mass and the surge added mass are held: they set the scale of all forces."""
    effects: list[Any] = [placed.effect for placed in vehicle.placed]
    lag, curve, lift, turn, wind = effects
    drag: Any = vehicle.actuators[0]
    return {
        "added mass": vehicle.added_mass,
        "linear damping": vehicle.damping.linear,
        "quadratic damping": vehicle.damping.quadratic,
        "thrust": vehicle.thrusters.max_thrust,
        "arms": vehicle.thrusters.position,
        "toe": vehicle.thrusters.direction,
        "lag": lag.time_constant,
        "curve": curve.quadratic,
        "hull lift": (lift.Y_uv, lift.N_uv, lift.Z_uw, lift.M_uw),
        "advance loss": vehicle.thrusters.advance_loss,
        "turn lift": (turn.Y_ur, turn.N_ur),
        "wind": (wind.north, wind.east),
        "surge drag": drag.drag,
    }


# Standard deviations of the priors, in the structure of `selected`; 0 holds an entry.
PRIOR: dict[str, Any] = {
    "added mass": _six(np.diag([0.0, 10.0, 0.5])),
    "linear damping": _six(np.diag([15.0, 0.0, 1.0])),
    "quadratic damping": _six(np.diag([15.0, 80.0, 0.8])),
    "thrust": np.full(2, 8.0),
    "arms": np.array([0.0, 0.1, 0.0]),
    "toe": np.array([0.0, 0.15, 0.0]),
    "lag": np.array(0.2),
    "curve": np.array(0.5),
    "hull lift": tuple(map(np.array, (0.0, 10.0, 0.0, 0.0))),
    "advance loss": np.full(2, 10.0),
    "turn lift": tuple(map(np.array, (40.0, 3.0))),
    "wind": tuple(map(np.array, (1.0, 0.0))),
    "surge drag": np.full(len(KNOTS), 8.0),
}
SURGE = np.arange(6)[:, None] + np.arange(6) == 0  # the entry of a matrix that is the file's surge damping


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Which terms stay out, held within a thousandth of their width, and how wide the priors are.

    `shaped`: surge drag is that over the speed alone, otherwise the linear and quadratic damping alone.
    """

    name: str
    out: tuple[str, ...] = ()
    width: float = 1.0
    shaped: bool = True

    def begin(self, start: jm.Vehicle) -> jm.Vehicle:
        """The start with the one surge drag or the other."""
        if not self.shaped:
            return start

        def of(vehicle: jm.Vehicle) -> list[Any]:
            parts = selected(vehicle)
            return [parts["linear damping"], parts["quadratic damping"], parts["surge drag"]]

        linear, quadratic, shape = of(start)
        held = [jnp.where(SURGE, 0.0, linear), jnp.where(SURGE, 0.0, quadratic)]
        return eqx.tree_at(of, start, [*held, jnp.full_like(shape, START_DRAG)])

    def prior(self) -> dict[str, Any]:
        """Standard deviations in the structure of `selected`."""

        def of(name: str) -> Any:
            width = self.width * (1e-3 if name in self.out else 1.0)
            return jax.tree.map(lambda std: width * std, PRIOR[name])

        prior = {name: of(name) for name in PRIOR}
        # Of the two surge drags the other one is held where it is nothing.
        for name in ("linear damping", "quadratic damping") if self.shaped else ():
            prior[name] = np.where(SURGE, 0.0, prior[name])
        if not self.shaped:
            prior["surge drag"] = 0.0 * prior["surge drag"]
        return prior


ADDED = ("advance loss", "turn lift", "hull lift", "wind", "curve")
CANDIDATES = (
    Candidate("all terms"),
    Candidate("all terms, near the start", width=0.5),
    Candidate("no advance loss", ("advance loss",)),
    Candidate("no turn lift", ("turn lift",)),
    Candidate("no wind", ("wind",)),
    Candidate("linear thrust", ("curve",)),
    Candidate("arms and directions as published", ("arms", "toe")),
    Candidate("linear and quadratic surge drag", shaped=False),
    Candidate("no added term, linear and quadratic surge drag", ADDED, shaped=False),
)


def noise() -> Float[np.ndarray, "18"]:
    """Weights of the fit per channel; NaN: not used."""
    out = np.full(len(NAMES), np.nan)
    for name, std in NOISE.items():
        out[NAMES.index(name)] = std
    return out


def fitted(start: jm.Vehicle, runs: Sequence[jm.Log], candidate: Candidate, steps: int) -> jm.Fit:
    """The start fitted to runs by trajectories that start as measured.

    With starts that are estimated the loss prefers a boat that is unstable in yaw, whose every window is
    saved by its own start. Each run is cut twice, half a window apart, so that no cut matters much.
    """
    shifted = [run.between(run.t[0] + WINDOW / 2, np.inf) for run in runs]
    fit = jm.fit(
        candidate.begin(start),
        [*runs, *shifted],
        selected,
        starts="measured",
        prior=candidate.prior(),
        window=WINDOW,
        max_steps=steps,
        noise=noise(),
        throw=False,
    )
    return dataclasses.replace(fit, vehicle=_unit(fit.vehicle))


def _unit(vehicle: jm.Vehicle) -> jm.Vehicle:
    """The same thrust with directions of length one, as a file has them.

    What the flow takes of it goes by the direction twice: by the flow along it, and by where it pushes.
    """

    def of(vehicle: jm.Vehicle) -> list[Array]:
        return [getattr(vehicle.thrusters, name) for name in ("direction", "max_thrust", "advance_loss")]

    length = jnp.linalg.norm(vehicle.thrusters.direction, axis=1)
    direction, thrust, loss = of(vehicle)
    return eqx.tree_at(of, vehicle, [direction / length[:, None], thrust * length, loss * length**2])


# --- errors --------------------------------------------------------------------------------------


@eqx.filter_jit
def _velocities(vehicle: jm.Vehicle, t, commands, nu, psi, restart, split: int):
    plant = vehicle.plant()
    over, _ = inputs(plant, t, commands, jnp.zeros((len(t), 6)))

    def measured(nu, psi) -> jm.State:
        return jm.State(jnp.zeros(3), from_euler(jnp.array([0.0, 0.0, 1.0]) * psi), nu, jnp.zeros(0))

    def step(state, now):
        over, dt, nu, psi, restart = now
        state = jax.tree.map(lambda a, b: jnp.where(restart, a, b), measured(nu, psi), state)

        return hold(plant, state, over, dt, split), state.velocity

    now = (over, step_lengths(t), nu, psi, restart)
    return jax.lax.scan(step, measured(nu[0], psi[0]), now)[1]


def predicted(vehicle: jm.Vehicle, log: jm.Log, horizon: float) -> Errors:
    """u, v, r of a simulation that restarts from the measured state every `horizon` seconds."""
    short = PADDED - len(log.t)

    def padded(values) -> Array:
        return jnp.asarray(np.pad(values, [(0, short)] + [(0, 0)] * (values.ndim - 1), mode="edge"))

    every = PADDED if np.isinf(horizon) else round(horizon / log.dt)
    assert log.commands is not None
    out = _velocities(
        vehicle,
        jnp.asarray(np.append(log.t, log.t[-1] + log.dt * np.arange(1, short + 1))),
        padded(log.commands),
        padded(np.nan_to_num(log.channels[:, 6:12])),
        padded(log.channels[:, PSI]),
        jnp.asarray(np.arange(PADDED) % every == 0),
        max(2, substeps(vehicle, log.dt)),
    )
    return np.asarray(out)[: len(log.t), AXES]


def errors(vehicle: jm.Vehicle, runs: Sequence[jm.Log], horizon: float = HORIZON) -> Errors:
    """Errors of all samples of all runs."""
    return np.concatenate([predicted(vehicle, run, horizon) - run.channels[:, PLACES] for run in runs])


def rms(values: Errors) -> list[float]:
    """Root mean square per channel."""
    return np.sqrt((values**2).mean(axis=0)).tolist()


def cross_validated(start: jm.Vehicle, runs: Sequence[jm.Log], candidate: Candidate, steps: int):
    """Errors rms on runs that were left out of the fit, one at a time."""
    out = []
    for left, run in enumerate(runs):
        # A blank run keeps the shapes, and with them what is compiled.
        rest = [_blank(other) if k == left else other for k, other in enumerate(runs)]
        out.append(errors(fitted(start, rest, candidate, steps).vehicle, [run]))
    return rms(np.concatenate(out))


def _blank(run: jm.Log) -> jm.Log:
    return dataclasses.replace(run, channels=np.full_like(run.channels, np.nan))


def merit(values: Sequence[float]) -> float:
    """Errors over their scale, squared and averaged: what candidates are ranked by."""
    return float(np.mean((np.array(values) / SCALE) ** 2))


def densest(vehicle: jm.Vehicle, runs: Sequence[jm.Log]) -> dict[str, Any]:
    """Where of all the squared errors in surge most lie within one `HORIZON`, and what share of them."""
    found = []
    for run in runs:
        total = np.concatenate([[0.0], np.cumsum(errors(vehicle, [run])[:, 0] ** 2)])
        length = min(round(HORIZON / run.dt), len(run.t))
        within = total[length:] - total[:-length]
        first = int(within.argmax())
        found.append((within[first], run.name, float(run.t[first]), total[-1]))
    most, name, begin, _ = max(found)
    return {"run": name, "begin": begin, "share": float(most / sum(one[-1] for one in found))}


# --- runs ----------------------------------------------------------------------------------------


def read(data: Path, folder: str, vehicle: jm.Vehicle) -> list[jm.Log]:
    """The runs of a folder, cut where the log says nothing of the boat any more."""
    runs = []
    for path in sorted((data / folder).glob("*.csv")):
        run = jm.read_log(path, vehicle, HERE / "columns.toml")
        begin, end = USABLE.get(run.name, WHOLE)
        runs.append(run.between(begin - 1e-9, end + 1e-9))
    return runs


def diagnosed(vehicle: jm.Vehicle, run: jm.Log) -> dict:
    """What the diagnosis says of one run, trained and tested on it."""
    answer = jm.diagnose(vehicle, run, run).to_json()
    return {"run": run.name} | {key: answer[key] for key in ("verdict", "findings", "notes")}


# --- what is written -----------------------------------------------------------------------------


def named(answer: dict) -> str:
    """The findings of a diagnosis in one line."""
    words = []
    for finding in answer["findings"]:
        word = finding["effect"] + (f":{finding['target']}" if finding["target"] else "")
        word += "".join(f" {k}={p['value']:.3g}" for k, p in finding["parameters"].items())
        if finding["since"] is not None:
            word += f" since {finding['since']:.1f} s"
        words.append(word)
    return "; ".join(words) or "nothing"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """As Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)) + "\n"


def _digits(values: Sequence[float]) -> list[str]:
    return [f"{value:.3f}" for value in values]


def error_table(results: dict[str, Any]) -> str:
    """Of the fitted and of the team's model, on runs that the fit has not seen and on those that it has."""
    scored = f"`{results['scored_on']}/`"
    models = {
        "fitted": "fitted",
        "fitted, whole runs": "fitted",
        "vtec_s3.toml": "the team's, `vtec_s3.toml`",
    }
    runs = {"fitted, whole runs": f"{scored}, uncut"}
    rows = [[models[n], runs.get(n, scored), *_digits(v)] for n, v in results["scored_rms"].items()]
    rows += [[models[n], "`train/`", *_digits(v)] for n, v in results["train_rms"].items()]
    return table(("model", "runs", "u [m/s]", "v [m/s]", "r [rad/s]"), rows)


def candidate_table(results: dict[str, Any]) -> str:
    """Of all candidates on the runs of `train/`, each left out of the fit."""
    rows = [[name, *_digits(values)] for name, values in results["cross_validation_rms"].items()]
    return table(("candidate", "u [m/s]", "v [m/s]", "r [rad/s]"), rows)


def diagnosis_table(results: dict[str, Any]) -> str:
    """What is known of each run, and what its diagnosis says."""
    rows = [
        [answer["run"].removesuffix(".csv"), KNOWN.get(answer["run"], "-"), answer["verdict"], named(answer)]
        for answer in results["diagnoses"]
    ]
    return table(("run", "what is known", "verdict", "named"), rows)


def markdown(results: dict[str, Any]) -> str:
    """The tables of errors, candidates and diagnoses."""
    return "\n".join(make(results) for make in (error_table, candidate_table, diagnosis_table))


def figure(vehicle: jm.Vehicle, runs: Sequence[jm.Log], path: Path) -> None:
    """Measured and predicted velocities of each run."""
    plot, axes = plt.subplots(3, len(runs), figsize=(4.2 * len(runs), 6.5), sharex="col", squeeze=False)
    for column, run in enumerate(runs):
        model = predicted(vehicle, run, HORIZON)
        for row, (name, unit) in enumerate(zip(CHANNELS, UNITS, strict=True)):
            ax = axes[row, column]
            ax.plot(run.t, run.channels[:, PLACES[row]], color="0.5", lw=1.5, label="measured")
            ax.plot(run.t, model[:, row], color="C0", lw=1.0, label=f"model, {HORIZON:g} s")
            ax.set_ylabel(f"{name} ({unit})")
        axes[0, column].set_title(run.name.removesuffix(".csv"), fontsize=9)
        axes[-1, column].set_xlabel("t (s)")
    axes[0, 0].legend(fontsize=8)
    plot.tight_layout()
    save_figure(plot, path)


def chosen(start: jm.Vehicle, runs: Sequence[jm.Log], steps: int) -> tuple[Candidate, dict]:
    """The candidate that predicts left-out runs best, and the errors of all."""
    scores = {}
    for candidate in CANDIDATES:
        scores[candidate.name] = cross_validated(start, runs, candidate, steps)
        print(f"left-out runs, {candidate.name}: {np.round(scores[candidate.name], 4)}", flush=True)
    best = min(CANDIDATES, key=lambda c: np.nan_to_num(merit(scores[c.name]), nan=np.inf))
    return best, scores


def identified(data: Path, out: Path, quick: bool) -> tuple[jm.Fit, dict]:
    """Chooses, fits and scores; the results so far lie in `out` as well."""
    published = jm.load_vehicle(HERE / "vtec_s3.toml")
    start = start_of(published)
    train = read(data, "train", published)
    train, steps = (train[-2:], 10) if quick else (train, 25)
    candidate, scores = (CANDIDATES[0], {}) if quick else chosen(start, train, steps)
    fit = fitted(start, train, candidate, steps)
    print(fit, flush=True)
    jm.save_vehicle(fit.vehicle, out / "fitted.toml")

    # The test runs are for the one model that was chosen; a quick run measures what it has fitted.
    test = train if quick else read(data, "test", published)
    results = {
        "candidate": candidate.name,
        "scored_on": "train" if quick else "test",
        "cross_validation_rms": scores,
        "train_rms": {
            "fitted": rms(errors(fit.vehicle, train)),
            "vtec_s3.toml": rms(errors(published, train)),
        },
        "scored_rms": {
            "fitted": rms(errors(fit.vehicle, test)),
            "fitted, whole runs": rms(errors(fit.vehicle, test, np.inf)),
            "vtec_s3.toml": rms(errors(published, test)),
        },
        "densest": densest(fit.vehicle, train),
        "parameters": {p.name: [p.start, p.value, p.std_sandwich] for p in fit.parameters},
        "diagnoses": [],
    }
    print(results["train_rms"], results["scored_rms"], flush=True)
    figure(fit.vehicle, test, out / "test.png")
    write_results(out, results, markdown(results))
    return fit, results


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--quick", action="store_true", help="two runs, few steps, no choice, no test, no diagnosis"
    )
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    fit, results = identified(args.data, args.out, args.quick)
    if args.quick:
        return
    for run in [run for folder in ("defects", "test") for run in read(args.data, folder, fit.vehicle)]:
        results["diagnoses"].append(diagnosed(fit.vehicle, run))
        print(run.name, named(results["diagnoses"][-1]), flush=True)
        write_results(args.out, results, markdown(results))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
