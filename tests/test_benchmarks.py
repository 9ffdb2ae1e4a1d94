"""The benchmarks in their tiny size: that contenders come to the same, never how long they take."""

import importlib
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from experiments.benchmarks import _forms, fleet, levenberg_marquardt, precision, shared
from experiments.benchmarks._rounds import (
    Missing,
    Table,
    Target,
    Timing,
    Uncompared,
    compared,
    difference,
)
from jaxmarine.diagnosis import _workbench
from jaxmarine.fitting import AbstractShares

from .conftest import ROOT

OWN_PAGE = "experiments/benchmarks/README.md"
# Sums of products in another order: a thousand roundings, with room.
ROUNDED = 1e-10
# One Runge-Kutta step per hold of 0.1 s, in which the fastest mode (roll) turns by 0.3 rad: 0.3^5 / 120 each.
METHOD = 1e-3
# The midpoint exponential's share of a hold's change, see `jaxmarine.fitting._linearise`.
MIDPOINT = 2e-2


def ran(name: str, out: Path) -> dict[str, Any]:
    """What a script writes in its tiny size."""
    app = typer.Typer()
    app.command()(importlib.import_module(f"experiments.benchmarks.{name}").main)
    done = CliRunner().invoke(app, ["--out", str(out), "--quick"], catch_exceptions=False)
    assert done.exit_code == 0
    found = json.loads((out / "results.json").read_text())
    assert found["machine"]["threads"] >= 1
    for table in found.get("tables", []):
        for contender, why in table["skipped"].items():
            assert contender and why
            assert f"| {contender} | skipped: {why} |" in (out / "results.md").read_text()
    return found


def differences(table: dict[str, Any]) -> dict[str, float]:
    """By contender, without those that are only timed."""
    timings = table["timings"].items()
    return {name: timing["difference"] for name, timing in timings if timing["difference"] is not None}


# --- the rounds -------------------------------------------------------------------------------------


def test_contenders_take_turns_and_are_compared_with_the_reference():
    order = []

    def maker(name, value):
        def run():
            order.append(name)
            return value

        return lambda: run

    def absent():
        raise Missing("no compiler")

    makers = {"a": maker("a", np.ones(3)), "b": maker("b", np.array([1.0, 1.0, 1.5])), "c": absent}
    table = compared("Which?", makers, np.ones(3), "a", 2)
    assert order == ["a", "b", "a", "b", "a", "b"]
    assert table.timings["a"].difference == 0.0
    assert table.timings["b"].difference == 0.5
    assert table.skipped == {"c": "no compiler"}
    assert "| c | skipped: no compiler |" in table.markdown()


def test_ratios_are_those_of_rounds_and_targets_know_who_was_skipped():
    timings = {"slow": Timing((2.0, 20.0, 3.0), 0.0), "unit": Timing((1.0, 10.0, 1.0), None)}
    table = Table("Which?", timings, "unit", "step", 10)
    assert table.ratio("slow", "unit") == 2.0
    assert "| slow | 300 ms (200 ms to 2 s) | 2 | 0.0e+00 |" in table.markdown()
    assert Target("slow", table, "slow", "unit", 1.0, 4.0).ratio == 0.5
    assert Target("slow", table, "slow", None, 1.0).ratio == 3.0
    assert Target("slow", table, "slow", "absent", 1.0).ratio is None


def test_a_difference_is_relative_to_the_largest_number_of_each_array():
    assert difference((np.array([1.0, 101.0]), 2.0), (np.array([1.0, 100.0]), 2.0)) == 0.01
    with pytest.raises(ValueError):
        difference((1.0,), (1.0, 2.0))


def test_a_contender_whose_library_is_missing_is_skipped_with_a_word():
    table = compared("Which?", {"x": lambda: importlib.import_module("no_such_library")}, 0.0, "x", 1)
    assert table.skipped == {"x": "No module named 'no_such_library'"}


def test_a_result_of_another_kind_is_only_timed():
    table = compared("Which?", {"x": lambda: lambda: Uncompared(jnp.zeros(3))}, 1.0, "x", 1)
    assert table.timings["x"].difference is None


# --- the scripts ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_roll_outs_come_to_the_same(tmp_path):
    found = ran("rollout", tmp_path)
    for table in found["tables"]:
        off = differences(table)
        # Its steps are as fine as it finds them to need.
        assert off.pop("diffeqsolve, Tsit5", 0.0) < 1e-4
        # The wrench is looked up by time, and its last stage sees the next one.
        looked_up = off.pop("diffeqsolve, constant step", METHOD)
        assert looked_up < 10.0 * METHOD
        # All others make the same steps, with the same error of the method.
        assert np.ptp(list(off.values())) < ROUNDED
        assert max(off.values()) < METHOD


def test_least_squares_come_to_the_same(tmp_path):
    single, bootstrap = ran("least_squares", tmp_path)["tables"]
    assert max(differences(single).values()) < ROUNDED
    off = differences(bootstrap)
    # Plain Gram matrices square a condition number of 1e3.
    assert off.pop("Gram matrices of windows") < 1e-8
    assert max(off.values()) < ROUNDED


@pytest.mark.slow
def test_quick_levenberg_marquardt_reaches_what_it_is_asked_for(tmp_path):
    _, equal = ran("levenberg_marquardt", tmp_path)["tables"]
    assert set(differences(equal).values()) == {0.0}


@pytest.mark.slow
def test_solvers_agree_where_they_start_near_one_minimum():
    starts = levenberg_marquardt.networks_of(1)
    samples = levenberg_marquardt.samples_of(60)
    shown = jax.vmap(lambda net: jax.vmap(net)(samples.x)[:, 0], out_axes=1)(starts)
    samples = samples._replace(y=shown + 0.02 * samples.y)
    scipy = levenberg_marquardt.by_scipy(starts, samples, 200)
    ours = levenberg_marquardt.by_normal_equations(starts, samples, 30)
    qr = levenberg_marquardt.by_optimistix(starts, samples, 30)
    # A minimum is flat: costs agree far better than weights.
    assert np.allclose(ours, scipy, rtol=1e-6)
    assert np.allclose(qr, scipy, rtol=1e-6)


@pytest.mark.slow
def test_derivatives_come_to_the_same(tmp_path):
    tables = ran("gradient", tmp_path)["tables"]
    for table in tables[:2]:
        assert max(differences(table).values()) < ROUNDED
    for table in tables[2:]:
        off = differences(table)
        assert off.pop("jaxmarine, sensitivity recursion") < MIDPOINT
        # Forward differences of 1e-6 in parameters of size 1 to 20.
        assert off.pop("scipy, finite differences") < 1e-4
        assert max(off.values()) < ROUNDED


@pytest.mark.slow
def test_a_quick_diagnosis_finds_the_thruster(tmp_path):
    screening, whole = ran("diagnosis", tmp_path)["tables"]
    assert max(differences(screening).values()) < MIDPOINT
    assert max(differences(whole).values()) < 0.05


@pytest.mark.slow
def test_a_long_log_is_diagnosed_in_a_process_of_its_own(tmp_path):
    (run,) = ran("long_logs", tmp_path)["runs"]
    assert run["found"] == ["thruster_gain:port_h"] and run["factor"] == pytest.approx(0.72, abs=0.02)
    # Of jax alone a process has some 0.2 GB.
    assert run["peak"] > 2e8


@pytest.mark.slow
def test_a_program_from_the_cache_comes_to_the_same(tmp_path):
    found = ran("startup", tmp_path)
    assert max(differences(found["tables"][1]).values()) == 0.0
    assert all(len(parts) == 3 for parts in found["tracing, compiling, running [s]"].values())


def test_a_stage_is_safe_by_its_difference_and_worth_it_by_its_time():
    def verdict(off, seconds):
        timings = {"double": Timing((1.3,), 0.0), "single": Timing((seconds,), off)}
        return precision.Stage(Table("What?", timings, "double"), "the noise").verdict

    assert verdict(0.009, 1.0) == "safe, worth it"
    assert verdict(0.009, 1.1) == "safe, saves little"
    assert verdict(0.011, 1.0) == verdict(np.nan, 1.0) == "not safe"


def test_a_stage_that_stays_double_says_so():
    def off_by(result, reference):
        return float(np.abs(result - reference))

    third = np.array(1 / 3)
    rounded = precision.stage("x", lambda: lambda: jnp.asarray(third), off_by, "one", 1)
    assert rounded.table.timings["double"].difference == 0.0
    # Between a quarter and a half, single precision has steps of 2^-25.
    assert rounded.off is not None and 0.0 < rounded.off <= 2.0**-26
    held = precision.stage("x", lambda: lambda: third, off_by, "one", 1)
    assert held.off is None and held.verdict == "falls back to double"


@pytest.mark.slow
def test_single_precision_is_close_and_not_the_same(tmp_path):
    found = ran("precision", tmp_path)
    off = {stage["stage"]: stage["off"] for stage in found["stages"]}
    assert len(off) == len(found["tables"]) == 14
    for table in found["tables"]:
        # Each precision draws its own bootstrap, which is compared with a loop in double over the same draws.
        most = ROUNDED if table["title"].startswith("Bootstrap") else 0.0
        assert table["timings"]["double"]["difference"] <= most
    assert min(off.values()) > 0.0
    # 320 roundings of less than 32 m to 2^-24 of it, all one way, in units of 1 cm.
    assert off["Roll-out, 32 s"] < 320 * 32 * 2.0**-24 / 0.01
    # A condition of some thousand, which ten times as many rows as columns see; numbers of size one in noise.
    assert max(value for name, value in off.items() if "squares" in name or "Bootstrap" in name) < 1e-2
    assert max(off.values()) < 1.0


@pytest.mark.slow
def test_what_grows_is_drawn_and_right(tmp_path):
    curves = ran("growth", tmp_path)["curves"]
    assert len(curves) == 5
    for curve in curves:
        assert all(point["bytes"] > 0 for point in curve["points"])
        limit = METHOD if curve["what"] == "reverse gradient" else MIDPOINT
        assert max(point["difference"] for point in curve["points"]) < limit
        assert set(curve["exponents"]) == {"time", "memory"}
    assert (tmp_path / "growth.svg").exists()


def test_on_paper_a_fleet_is_as_fast_as_what_holds_it_up():
    one, hundred, many = fleet.on_paper(cpu=10.0, task=0.01, size=1e6)
    assert (one["held_by"], one["logs_per_second"]) == ("cores", pytest.approx(0.1))
    assert (hundred["held_by"], hundred["logs_per_second"]) == ("cores", pytest.approx(10.0))
    # A hundred tasks a second, where the network would give 125 logs and the cores a thousand.
    assert (many["held_by"], many["logs_per_second"]) == ("scheduler", pytest.approx(100.0))


# --- logs on workers ----------------------------------------------------------------------------------


class Echoes(AbstractShares):
    """Two places that answer with what they were given."""

    def ask(self, question, *given, each=None):
        del question
        return [(*given, *own) for own in each or [(), ()]]


def test_what_travels_is_counted_at_every_place():
    counted, long, short = shared.Counted(Echoes()), b"x" * 10_000, b"y" * 1000
    assert counted.ask("cost", long) == [(long,), (long,)]
    assert counted.ask("cost", each=[(long,), (short,)]) == [(long,), (short,)]
    assert counted.ask("look") == [(), ()]
    assert counted.asked == {"cost": 2, "look": 1}
    # A pickle has some tens of bytes of its own.
    for way in (counted.questions, counted.answers):
        assert 31_000 < way["cost"] < 31_400 and 0 < way["look"] < 100
    assert shared.by_step(counted.answers) == (counted.answers["cost"], counted.answers["look"])


def test_a_question_of_a_diagnosis_is_called_after_the_innermost_function():
    assert shared.kind_of("answer", (shared.off, [1], shared.line, 7, shared.bytes_of, 0.5)) == "bytes_of"
    assert shared.kind_of("sums", (True, 0.1)) == "sums"


def test_arrays_are_counted_once_and_as_large_as_they_lie_in_memory():
    one, other = np.zeros(1000), jnp.zeros((10, 100))
    point = fleet.Job("", "", "", (), (), (), "")
    assert shared.bytes_of({"a": [one, one[:10], other, other], "b": ("text", 1.0, point)}) == 16_000
    assert shared.bytes_of(np.broadcast_to(np.zeros(3), (1000, 3))) == 24


def run_of(logs: int, memory: float, arrays: float) -> dict[str, Any]:
    held = {"memory": {"read": 1.0, "judged": memory}, "arrays": {"screening": arrays, "places": arrays}}
    return {"logs": logs, "windows": 75 * logs, **held}


def test_on_paper_many_logs_take_what_each_takes():
    runs = [run_of(2, 1.02e9, 1e6), run_of(10, 1.1e9, 38e6), run_of(4, 0.98e9, 2e6)]
    assert shared.line(runs) == pytest.approx((1e9, 1e7))
    # Of two places and four logs: steps as before, all else by 125 logs of each worker and a group for each.
    answers = {"sums": 3_000_000, "cost": 1_000_000, "_looked": 800_000, "of_groups": 300_000}
    paper = shared.on_paper({"placed": runs, "travelled": {"answers": answers, "places": 2, "logs": 4}})
    # As from 4 logs to 10.
    assert paper["memory"] == pytest.approx(1.1e9 + (125 - 10) * 2e7)
    assert paper["answers"] == pytest.approx(2e6 + 125 * (2e5 + 1e3))
    # Ten logs are screened by two windows in a row, in 38 groups each.
    assert paper["asking"] == pytest.approx(1000 * (3.8e6 + 1e5))


@pytest.mark.parametrize(("logs", "windows"), [(4, 75), (8, 75), (16, 75), (1000, 75), (1, 601), (2, 15)])
def test_groups_on_paper_are_those_of_a_diagnosis(logs, windows):
    groups = _workbench._grouped(np.repeat(np.arange(logs), windows), logs * windows)
    assert shared.groups_of(logs, windows) == groups[-1] + 1


@pytest.mark.slow
def test_a_quick_diagnosis_over_places_is_counted(tmp_path):
    found = ran("shared", tmp_path)
    travel, runs = found["travelled"], found["placed"]
    apart = travel["apart"]
    assert apart["found"] == apart["in_one_process"] == ["thruster_gain:port"]
    assert max(apart[name] for name in ("evidence", "size", "gain")) < 1e-6
    assert travel["asked"]["cost"] == travel["asked"]["sums"] == travel["asked"]["step"] == travel["steps"]
    # Gradient and information of a step in double precision, from both places.
    assert travel["answers"]["sums"] > 2 * travel["steps"] * 8 * (44 + 44**2)
    assert [run["logs"] for run in runs] == [1, 2]
    # Of jax alone a process has some 0.2 GB.
    assert all(run["memory"]["judged"] > 2e8 and min(run["arrays"].values()) > 0 for run in runs)


def test_the_page_has_the_tables_of_the_fleet():
    results = json.loads((ROOT / "experiments" / "benchmarks" / "fleet" / "results.json").read_text())
    page = (ROOT / "experiments" / "benchmarks" / "README.md").read_text()
    assert fleet.text_of(results) in page
    one = results["workers"][0]["cpu_per_log"]
    moved = results["workers"][0]["bytes_per_log"] + results["read_per_log"]
    assert results["on_paper"] == fleet.on_paper(one, results["overhead"], moved)


def test_the_pages_have_the_numbers_of_logs_on_workers():
    results = json.loads((shared.HERE / "results.json").read_text())
    own, fleets = ((ROOT / page).read_text() for page in (OWN_PAGE, "docs/fleets.md"))
    assert shared.memory_table(results) in own and shared.travel_table(results) in own
    for page in (own, fleets):
        assert "python -m experiments.benchmarks.shared" in page
        for fact in shared.facts(results):
            assert fact in " ".join(page.split()), fact
    assert results["on_paper"] == shared.on_paper(results)
    apart = results["travelled"]["apart"]
    assert apart["found"] == apart["in_one_process"] == ["thruster_gain:port"]


def test_without_a_compiler_c_is_skipped(monkeypatch):
    monkeypatch.setattr(_forms.shutil, "which", lambda name: None)
    with pytest.raises(Missing, match="compiler"):
        _forms.library()
