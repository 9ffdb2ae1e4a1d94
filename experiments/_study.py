"""What the studies share: how they begin, what they write, and effects of their own."""

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
import scipy.stats
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint
from threadpoolctl import threadpool_limits

from jaxmarine._program import program as program
from jaxmarine.effects import Craft, Suspect, WrenchEffect, whole


class ScalarEffect(WrenchEffect):
    """A wrench of scalar numbers that are zero where it changes nothing; one suspect has them all."""

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        del craft
        return whole(cls, cls.units)


@contextlib.contextmanager
def study(out: Path, quick: bool) -> Iterator[None]:
    """Makes the folder, and calculates in double precision and with one thread per small matrix.

    A quick study would spend most of its time on making its programs fast, so theirs are left as they are.
    """
    out.mkdir(parents=True, exist_ok=True)
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_disable_most_optimizations", quick or before)
    try:
        # Threads that share a small matrix mostly wait for each other.
        with threadpool_limits(1, "blas"):
            yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


def write_results(out: Path, results: dict[str, Any], text: str) -> None:
    """The results as numbers and as tables; a list of numbers is written in one line."""
    lines = re.sub(r"\[[^][{}\"]*\]", lambda found: " ".join(found[0].split()), json.dumps(results, indent=1))
    (out / "results.json").write_text(lines + "\n", encoding="utf-8")
    (out / "results.md").write_text(text, encoding="utf-8")


def short(kept: Any) -> Any:
    """Numbers of what is kept, to four significant digits: claims are decided from these."""
    if isinstance(kept, Mapping):
        return {key: short(value) for key, value in kept.items()}
    if isinstance(kept, list | tuple):
        return [short(value) for value in kept]
    return float(f"{kept:.4g}") if isinstance(kept, float) else kept


def save_figure(plot: Any, path: Path) -> None:
    """As PNG and as SVG."""
    for kind in ("png", "svg"):
        plot.savefig(path.with_suffix(f".{kind}"), dpi=120)
    plt.close(plot)


def wilson(right: int, count: int) -> list[float]:
    """Wilson's interval of a share, 95 %; of none it says nothing."""
    if not count:
        return [0.0, 1.0]
    return np.asarray(proportion_confint(right, count, method="wilson"), float).tolist()


LEVEL = 0.05  # of a family of claims


def decided(
    pairs: Mapping[str, Sequence[tuple[float, float]]], shares: Mapping[str, float] | None = None
) -> list[dict[str, Any]]:
    """Claims that one error is below another's, by Wilcoxon's signed ranks of their ratios, pair by pair.

    Of a claim with a share the first is to be below that share of the second. A claim holds, or is refuted,
    where the two-sided p of its pairs is below `LEVEL` after Holm's correction for all claims; else these
    pairs do not decide it. What has diverged is worse than what has not.
    """
    out = list[dict[str, Any]]()
    for words, own in pairs.items():
        values = np.minimum(np.nan_to_num(np.array(own, float), nan=np.inf), 1e12)
        ratio = values[:, 0] / values[:, 1] / (shares or {}).get(words, 1.0)
        alike = (ratio == 1).all()  # nothing to rank
        tested: Any = None if alike else scipy.stats.wilcoxon(np.log(ratio))
        middle = np.median(values, axis=0)
        out.append(
            {
                "claim": words,
                "median": float(middle[0]),
                "against": float(middle[1]),
                "ratio": float(np.median(ratio)),
                "wins": int((ratio < 1).sum()),
                "dives": len(ratio),
                "p": 1.0 if alike else float(tested.pvalue),
            }
        )
    return _judged(out, [one["ratio"] < 1 for one in out])


def discordant(pairs: Mapping[str, tuple[Sequence[bool], Sequence[bool]]]) -> list[dict[str, Any]]:
    """Claims that one way is right more often than another on the same cases, by McNemar's exact test.

    Only cases count that one of them has right and the other one not. A claim holds, or is refuted, where the
    two-sided p is below `LEVEL` after Holm's correction for all claims; else these cases do not decide it.
    """
    out = list[dict[str, Any]]()
    for words, (one, other) in pairs.items():
        both = np.array([one, other], bool)
        won, lost = int((both[0] & ~both[1]).sum()), int((both[1] & ~both[0]).sum())
        p = float(scipy.stats.binomtest(won, won + lost).pvalue) if won + lost else 1.0
        out.append({"claim": words, "of": both.shape[1], "won": won, "lost": lost, "p": p})
    return _judged(out, [one["won"] > one["lost"] for one in out])


def _judged(claims: list[dict[str, Any]], likely: Sequence[bool]) -> list[dict[str, Any]]:
    """The claims with p after Holm's correction, and a verdict; `likely`: which way each of them goes."""
    held: Any = multipletests([one["p"] for one in claims], method="holm")[1] if claims else ()
    for one, p, holds in zip(claims, held, likely, strict=True):
        one["p_holm"] = float(p)
        one["verdict"] = ("holds" if holds else "refuted") if p < LEVEL else "undecided"
    return claims


def number(x: float) -> str:
    """Three digits; what has diverged as ∞."""
    if x >= 1e12:
        return "∞"
    return f"{x:.3g}" if x < 1000 else f"{x:.0f}"


def claim_table(found: list[dict[str, Any]]) -> str:
    """Each claim with medians, how many dives speak for it, and the verdict of the paired test."""
    lines = ["| claim | median | against | better in | p (Holm) | verdict |", "|---|---|---|---|---|---|"]
    for c in found:
        lines.append(
            f"| {c['claim']} | {number(c['median'])} | {number(c['against'])} | {c['wins']} of {c['dives']} "
            f"| {c['p_holm']:.2g} | {c['verdict']} |"
        )
    return "\n".join(lines) + "\n"


def in_a_line(claim: dict[str, Any]) -> str:
    """One claim of `discordant`, as an item of Markdown."""
    counts = f"only the first is right on {claim['won']}, only the second on {claim['lost']} of {claim['of']}"
    return f"- {claim['claim']}: {claim['verdict']} ({counts}; p = {claim['p_holm']:.2g}, by Holm)"


def spread(values: Sequence[float], digits: int) -> str:
    """Median and range over seeds."""
    return f"{np.median(values):.{digits}f} ({np.min(values):.{digits}f} to {np.max(values):.{digits}f})"
