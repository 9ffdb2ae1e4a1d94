"""Five states of a small AUV told apart by the heave of its measured dives, with a confidence that is earned.

usage: python -m experiments.measured_auv_faults --out DIR [--data DIR] [--quick]

A heave model per unit mass is fitted to the runs of `train_*`, all states together: the hull and the thrust
are common, each state adds one effect (a payload, a weaker thruster, a biased depth sensor). A run's evidence
for a state is its likelihood given its command, with everything integrated out that differs from run to run
(start, trim, drifting force, session) and with the uncertainty of the fit. No state's usual command is in it.
It is set against guessing from the command level, from the start depth, and by chance. Writes results.json,
results.md and the figures heave and confidence.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Annotated, Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Float, Int

import jaxmarine as jm
from experiments._study import save_figure, study, wilson, write_results
from experiments.haizhe.heave import (
    NAMES,
    SCATTER,
    Fitted,
    fitted,
    linear,
    log_evidence,
    probabilities,
    simulated,
    trust_in,
)
from experiments.haizhe.runs import STATES, TIMES, Runs, joined, read, sessions

HERE = Path(__file__).parent / "haizhe"
DATA = Path(__file__).parents[2] / "shared" / "data" / "haizhe-auv"
SHORT = ("normal", "weight", "pressure", "slight", "bad")
CONFIDENT = 0.9
SHARED_LEVELS = (1198.0, 1202.0)  # [µs] commands that all states but AddWeight have in common
# What is alike to heave under a nearly constant command: normal and damaged propellers.
GROUPS = np.array([0, 1, 2, 0, 0])

# Rows of the table that are looked up again.
MODEL, LEVEL = "model, test", "command level alone, test"
LEFT_OUT = "model, training runs, each session left out"


# --- baselines -----------------------------------------------------------------------------------


def by_level(train: Runs, runs: Runs) -> Float[np.ndarray, "runs states"]:
    """Log density of the command level in each state's training runs.

    Kernels of 1 µs, the step of the commands, and a hundredth spread evenly for levels that were not seen.
    """
    off = runs.level[:, None] - train.level
    kernel = np.exp(-0.5 * off**2) / np.sqrt(2.0 * np.pi)
    density = np.stack([kernel[:, train.state == k].mean(axis=1) for k in range(len(STATES))], axis=1)
    return np.log(0.99 * density + 0.01 / np.ptp(train.level))


def by_start(train: Runs, runs: Runs) -> Float[np.ndarray, "runs states"]:
    """Log density of the depth before the start: normal, with a mean per state and one spread."""
    first = train.depth[:, 0]
    mean = np.array([first[train.state == k].mean() for k in range(len(STATES))])
    return -0.5 * ((runs.depth[:, :1] - mean) / (first - mean[train.state]).std()) ** 2


# --- how good it is ------------------------------------------------------------------------------


def confusion(p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"]) -> list[list[int]]:
    """Runs by true state (rows) and likeliest state (columns)."""
    out = np.zeros(2 * p.shape[1:], int)
    np.add.at(out, (state, p.argmax(axis=1)), 1)
    return out.tolist()


def judged(p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"], session) -> dict[str, Any]:
    """Accuracy, log loss [nats], Brier score (0 to 2) and calibration, with 95 % intervals.

    Whole sessions are drawn again for the intervals: runs of one session are alike. `surprise`: log loss
    minus what the answers themselves expect, 0 where they are as sure as they may be.
    """
    told = np.log(np.maximum(p[np.arange(len(p)), state], 1e-12))
    per_run = {
        "accuracy": (p.argmax(axis=1) == state).astype(float),
        "log_loss": -told,
        "brier": ((p - np.eye(p.shape[1])[state]) ** 2).sum(axis=1),
        "surprise": -told + (p * np.log(np.maximum(p, 1e-12))).sum(axis=1),
    }
    _, member = np.unique(session, return_inverse=True)
    sizes = np.bincount(member)
    times = np.random.default_rng(0).multinomial(len(sizes), np.full(len(sizes), 1.0 / len(sizes)), 2000)
    out: dict[str, Any] = {"runs": len(p)}
    for name, values in per_run.items():
        means = (times @ np.bincount(member, values)) / (times @ sizes)
        out[name] = [float(values.mean()), *np.quantile(means, [0.025, 0.975]).tolist()]
    sure = p.max(axis=1) > CONFIDENT
    right = int(per_run["accuracy"][sure].sum())
    bounds = wilson(right, int(sure.sum()))
    out |= {"inconclusive": float(1.0 - sure.mean()), "confident": int(sure.sum()), "confident_right": right}
    return out | {"confident_right_share_95": bounds, "confusion": confusion(p, state)}


def merged(p: Float[np.ndarray, "runs states"]) -> Float[np.ndarray, "runs groups"]:
    """Probabilities of the groups, between which heave may tell."""
    return np.stack([p[:, g == GROUPS].sum(axis=1) for g in range(GROUPS.max() + 1)], axis=1)


def reliability(
    p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"]
) -> list[dict[str, float]]:
    """Share of true among the states that were given a probability in a range, with Wilson's 95 %."""
    told, true = p.ravel(), (np.arange(p.shape[1]) == state[:, None]).ravel()
    edges = np.array([0.0, 0.02, 0.1, 0.25, 0.4, 0.6, 0.8, 0.95, 1.0])
    out = []
    for low, high in itertools.pairwise(edges):
        inside = (told >= low) & ((told < high) | (high == 1.0))
        if inside.any():
            hits, count = int(true[inside].sum()), int(inside.sum())
            low_true, high_true = wilson(hits, count)
            out.append({"told": float(told[inside].mean()), "true": hits / count, "count": count})
            out[-1] |= {"low": low_true, "high": high_true}
    return out


# --- what is written -----------------------------------------------------------------------------


def scores_table(scores: dict[str, Any]) -> str:
    """One line per answer, as Markdown."""
    lines = [
        "| answer | runs | accuracy | log loss | Brier | surprise | inconclusive | confident, right |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, row in scores.items():
        cells = [
            "{:.2f} ({:.2f} to {:.2f})".format(*(round(x, 2) + 0.0 for x in row[k]))  # no -0.00
            for k in ("accuracy", "log_loss", "brier", "surprise")
        ]
        sure = f"{row['confident_right']} of {row['confident']}" if row["confident"] else "none"
        lines.append(
            f"| {name} | {row['runs']} | " + " | ".join(cells) + f" | {row['inconclusive']:.2f} | {sure} |"
        )
    return "\n".join(lines) + "\n"


def confusion_table(scores: dict[str, Any], name: str) -> str:
    """Runs by true state (rows) and likeliest state, as Markdown."""
    lines = [f"| {name}: true \\ likeliest | " + " | ".join(SHORT) + " |", "|---" * 6 + "|"]
    rows = zip(SHORT, scores[name]["confusion"], strict=True)
    lines += [f"| {label} | " + " | ".join(map(str, row)) + " |" for label, row in rows]
    return "\n".join(lines) + "\n"


def markdown(results: dict[str, Any]) -> str:
    """The tables of scores, the confusion matrices, parameters and scatters."""
    scores = results["scores"]
    tables = [scores_table(scores), *(confusion_table(scores, name) for name in (MODEL, LEFT_OUT, LEVEL))]
    lines = [f"Power of the evidence, from training runs left out: {results['trust']:.2f}"]
    lines += ["", "| parameter | value | standard deviation |", "|---|---|---|"]
    lines += [f"| {name} | {value:.3f} | {std:.3f} |" for name, (value, std) in results["parameters"].items()]
    lines += ["", "| scatter | value |", "|---|---|"]
    lines += [f"| {name} | {value:.4f} |" for name, value in results["scatter"].items()]
    return "\n".join([*tables, *lines]) + "\n"


def heave_figure(fit: Fitted, runs: Runs, path: Path) -> None:
    """Measured depths per state, and what the model expects in that state and in the normal one."""
    plot, axes = plt.subplots(1, 5, figsize=(14, 3.4), sharex=True, sharey=True, layout="constrained")
    for k, ax in enumerate(axes):
        these = runs[runs.state == k]
        ax.plot(TIMES, these.depth.T, color="0.75", lw=0.5)
        for state, color, label in ((0, "#c2620a", "as if normal"), (k, "#1f6fb5", "in its state")):
            model = linear(fit.start, fit.theta, these, np.full(len(these.state), state))
            mean = (these.depth - np.asarray(model.residual)).mean(axis=0)
            ax.plot(TIMES, mean, color=color, lw=1.8, label=label)
        ax.set(title=STATES[k].replace("_", "\n"), xlabel="t [s]")
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set(ylabel="depth [m]", ylim=(1.0, -0.1))
    axes[1].legend(frameon=False, fontsize=8)
    save_figure(plot, path)


def confidence_figure(told: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Mean probability that each true state was given (first of `told`), and the reliability of all."""
    plot, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    p, state = next(iter(told.values()))
    mean = np.stack([p[state == k].mean(axis=0) for k in range(len(STATES))])
    axes[0].imshow(mean, cmap="Blues", vmin=0, vmax=1)
    for i, row in enumerate(mean):
        for j, value in enumerate(row):
            axes[0].text(
                j, i, f"{value:.2f}", ha="center", va="center", color="white" if value > 0.6 else "0.2"
            )
    axes[0].set_xticks(range(5), SHORT)
    axes[0].set_yticks(range(5), SHORT)
    axes[0].set(xlabel="state", ylabel="true state", title=f"mean probability: {next(iter(told))}")
    axes[1].plot([0, 1], [0, 1], color="0.7", lw=1)
    for k, (name, (p, state)) in enumerate(told.items()):
        rows = reliability(p, state)
        x, y, low, high = (np.array([row[key] for row in rows]) for key in ("told", "true", "low", "high"))
        bars = np.abs(np.stack([y - low, high - y]))
        shift = 0.006 * (k - 1)
        color = ("#1f6fb5", "#2a9d5c", "#c2620a")[k]
        axes[1].errorbar(x + shift, y, bars, fmt="o-", ms=4, lw=1, color=color, label=name)
    axes[1].set(
        xlabel="probability told", ylabel="share true", title="reliability, all states", aspect="equal"
    )
    axes[1].legend(frameon=False, fontsize=8)
    axes[1].spines[["top", "right"]].set_visible(False)
    save_figure(plot, path)


def studied(data: Path, out: Path, quick: bool) -> dict[str, Any]:
    """Fits, scores, and writes what was found."""
    train, test = read(data, "train"), read(data, "test")
    if quick:
        train, test = train[::10], test[::5]
    # Sessions of the training runs get the first numbers; a test run may lie in one that no training run has.
    together = sessions(joined([train, test]))
    known, of_train = np.unique(together[: len(train.state)], return_inverse=True)
    of_test = together[len(train.state) :]
    seen = np.where(np.isin(of_test, known), np.searchsorted(known, of_test), -1)
    rounds, steps = (4, 6) if quick else (14, 60)
    start = jm.load_vehicle(HERE / "haizhe.toml")
    fit = fitted(start, train, of_train, rounds, steps)

    raw_test, raw_train = log_evidence(fit, test), log_evidence(fit, train, of_train)
    trust = trust_in(raw_train, train.state)
    p_test, p_train = probabilities(raw_test, trust), probabilities(raw_train, trust)
    level = by_level(train, test)
    shared = (test.level >= SHARED_LEVELS[0]) & (test.level <= SHARED_LEVELS[1])
    told = {
        "test": (p_test, test.state),
        "training runs, each session left out": (p_train, train.state),
        "test, command level alone": (probabilities(level), test.state),
    }
    answers = {
        MODEL: (p_test, test.state, of_test),
        "model, test, its session left out": (
            probabilities(log_evidence(fit, test, seen), trust),
            test.state,
            of_test,
        ),
        LEFT_OUT: (p_train, train.state, of_train),
        "model, test, evidence taken in full": (probabilities(raw_test), test.state, of_test),
        "chance": (np.full_like(p_test, 0.2), test.state, of_test),
        "start depth alone, test": (probabilities(by_start(train, test)), test.state, of_test),
        LEVEL: (probabilities(level), test.state, of_test),
        "model and command level, test": (probabilities(np.log(p_test) + level), test.state, of_test),
        "model, test at shared levels": (p_test[shared], test.state[shared], of_test[shared]),
        "command level alone, test at shared levels": (
            probabilities(level[shared]),
            test.state[shared],
            of_test[shared],
        ),
        "model, test, three groups": (merged(p_test), GROUPS[test.state], of_test),
        "command level alone, test, three groups": (
            merged(probabilities(level)),
            GROUPS[test.state],
            of_test,
        ),
        "model, training runs left out, three groups": (merged(p_train), GROUPS[train.state], of_train),
    }

    # Given that the propellers are all that is in question, is anything known of them?
    alike = GROUPS[test.state] == 0
    among = p_test[alike][:, np.flatnonzero(GROUPS == 0)]
    answers["model, test, normal and damaged among themselves"] = (
        among / among.sum(axis=1, keepdims=True),
        np.searchsorted(np.flatnonzero(GROUPS == 0), test.state[alike]),
        of_test[alike],
    )

    if not quick:
        # Does the level of the command leak? Simulated, with levels dealt out to the states at random; and as
        # measured, with every run fitted and scored as if it had had the same command.
        rng = np.random.default_rng(0)
        dealt = dataclasses.replace(train, command=rng.permutation(train.command))
        for name, runs in (
            ("", simulated(fit, train, rng)),
            (", levels dealt out", simulated(fit, dealt, rng)),
        ):
            singles = np.arange(len(runs.state))
            answers["model, simulated" + name] = (probabilities(log_evidence(fit, runs)), runs.state, singles)
            answers["command level alone, simulated" + name] = (
                probabilities(by_level(train, runs)),
                runs.state,
                singles,
            )
        one = float(np.median(train.level))
        blind = fitted(start, train.at_one_level(one), of_train, rounds, steps)
        answers["model without the command, test"] = (
            probabilities(log_evidence(blind, test.at_one_level(one)), trust),
            test.state,
            of_test,
        )

    move, cov = fit.posterior()
    results = {
        "scores": {name: judged(*answer) for name, answer in answers.items()},
        "reliability": {name: reliability(*answer) for name, answer in told.items()},
        "parameters": dict(
            zip(NAMES, np.column_stack([fit.theta + move, np.diag(cov) ** 0.5]).tolist(), strict=True)
        ),
        "scatter": dict(zip(SCATTER, np.exp(fit.log_scatter).tolist(), strict=True)),
        "trust": trust,
        "sessions": {label: len(np.unique(of_train[train.state == k])) for k, label in enumerate(STATES)},
        "test_probabilities": p_test.tolist(),
        "test_states": test.state.tolist(),
    }
    write_results(out, results, markdown(results))
    heave_figure(fit, train, out / "heave.png")
    confidence_figure(told, out / "confidence.png")
    return results


def main(
    out: Annotated[Path, typer.Option(help="Folder for results, tables and figures.")],
    data: Annotated[Path, typer.Option(help="Folder with the measured runs.")] = DATA,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="A tenth of the training runs, a fifth of the others, no controls."),
    ] = False,
) -> None:
    """Tells the states of measured dives apart, and measures with what right."""
    if not data.is_dir():
        print(f"Skipped: the measured runs are not at {data}; say with --data where they are.")
        return
    with study(out, quick):
        results = studied(data, out, quick)
    print(markdown(results))


if __name__ == "__main__":
    typer.run(main)
