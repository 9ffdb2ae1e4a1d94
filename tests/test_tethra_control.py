"""Tethra on a spiral dive: what was found, who is compared with whom, and a quick run."""

import json

import numpy as np
import pytest
import scipy.stats
import typer
from typer.testing import CliRunner

from experiments import tethra_control as study

from .conftest import ROOT

PAGE = (ROOT / "experiments" / "README.md").read_text()
FOUND = json.loads((study.HERE / "results.json").read_text())
RUNS = {(run["case"], run["model"]): run for run in FOUND["runs"]}


def lengths(case: str, model: str, error: str) -> np.ndarray:
    """By seed the size of an error, whose axes go together."""
    return np.array([np.linalg.norm(value) for value in RUNS[case, model][error]])


def test_the_page_shows_what_was_found():
    for (case, model), run in RUNS.items():
        assert {len(run[name]) for name in study.KEPT} == {1 if case == "I" else 12}, model
    assert study.markdown(FOUND["runs"]) in PAGE


def test_verdicts_follow_from_the_kept_errors():
    """Signed ranks of the ratios and Holm's correction, anew."""
    pairs = [
        (lengths(case, better, error), lengths(case, worse, error))
        for _, case, better, worse, error in study.CLAIMS
    ]
    p = np.array([scipy.stats.wilcoxon(np.log(a / b)).pvalue for a, b in pairs])
    order = np.argsort(p)
    held = np.empty(len(p))
    held[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    for claim, (a, b), one, corrected in zip(FOUND["claims"], pairs, p, held, strict=True):
        assert (claim["median"], claim["against"]) == pytest.approx((np.median(a), np.median(b)))
        assert (claim["wins"], claim["dives"]) == ((a < b).sum(), 12)
        assert (claim["p"], claim["p_holm"]) == pytest.approx((one, corrected))
        way = "holds" if np.median(a / b) < 1 else "refuted"
        assert claim["verdict"] == (way if corrected < 0.05 else "undecided")


def test_the_page_says_what_was_found():
    lines = " ".join(PAGE.split())
    models = ("exact model", study.ML, study.TRAJECTORY, study.NETWORK)
    held = np.array([RUNS["augmented", f"PD and {model}"]["rms_m"] for model in models])
    assert np.ptp(held, axis=0).max() < 1e-3
    worst = [np.max(RUNS["II", model]["rms_m"]) for model in (study.MEASURED, study.ML)]
    assert "{:.2g} m off in the worst of twelve seeds, that of slopes {:.2g} m".format(*worst) in lines
    late = np.array(RUNS["III, late", f"{study.TRAJECTORY}, learning"]["velocity_rms"])
    words = "worst {:.2g} m/s); of the seven others, which had not been looked at, the worst is {:.2g} m/s"
    assert words.format(late[:5].max(), late[5:].max()) in lines
    shares = [
        np.median(lengths(case, f"{name}, learning", error) / lengths(case, f"{name}, stale", error))
        for case, error in (("III, late", "velocity_rms"), ("III", "rms_m"))
        for name in (study.TRAJECTORY, study.NETWORK)
    ]
    words = (
        "falls to {:.1g} and {:.1g} times the stale model's (grey box, perceptron), the way off to {:.2g} "
        "and {:.2g}"
    )
    assert words.format(*shares) in lines
    early = 1000 * np.linalg.norm(RUNS["I", "exact model, read as a hold begins"]["rms_m"])
    assert f"the exact model is {early:.0f} mm off" in lines


def test_claims_compare_the_same_seed():
    """Dives that differ tenfold, each a fifth better with the first model: of medians nothing would show."""
    scale = 10 ** (np.arange(12) / 11)
    claims = [claim for claim in study.CLAIMS if claim[1].startswith("III") and "stale" in claim[3]]
    runs = [
        {
            "case": case,
            "model": model,
            "rms_m": [[share * size] * 3 for size in scale],
            "velocity_rms": [share * size for size in scale],
        }
        for _, case, better, worse, _ in claims
        for model, share in ((better, 0.8), (worse, 1.0))
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "CLAIMS", claims)
        found = study.claims(runs)
    assert [(one["verdict"], one["wins"]) for one in found] == [("holds", 12)] * 4


@pytest.mark.slow
def test_a_quick_study_learns_the_changed_damping(tmp_path):
    app = typer.Typer()
    app.command()(study.main)
    result = CliRunner().invoke(app, ["--out", str(tmp_path), "--quick"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    runs = json.loads((tmp_path / "results.json").read_text())["runs"]
    found = {(run["case"], run["model"]): {name: run[name][0] for name in study.KEPT} for run in runs}
    # From ideal data both are exact, and a tenth too much of everything is decimetres off.
    for name in study.TRAJECTORY, study.ML:
        assert max(found["I", name]["rms_m"]) < 1e-3
    assert max(found["I", "all parameters +10 %"]["rms_m"]) > 0.1
    # Beside a network of two units the classical terms learn the changed damping as well.
    for name in study.TRAJECTORY, study.NETWORK:
        late = {words: found["III, late", f"{name}, {words}"] for words in ("stale", "learning")}
        assert late["learning"]["velocity_rms"] < 0.05 * late["stale"]["velocity_rms"]
    # Feedback alone holds the craft within decimetres; the model takes most of the rest away.
    pd, both = (found["augmented", name]["rms_m"] for name in ("PD", "PD and exact model"))
    assert np.linalg.norm(both) < 0.5 * np.linalg.norm(pd)
    # Counts of updates are kept where there are any.
    assert {run["model"] for run in runs if "updates" in run} == {
        *(f"{name}, updated under way" for name in (study.ML, study.NETWORK)),
        *(f"{name}, learning" for name in (study.TRAJECTORY, study.NETWORK)),
    }
    numbers = [f"figure_5_{k}" for k in range(7, 14)]
    for name in (*numbers, "case_iii_velocity", "augmented"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (tmp_path / f"{name}.svg").stat().st_size > 10_000
