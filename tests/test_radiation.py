"""Radiation by two fluid memories: against convolution and quadrature; what the study found."""

import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import jaxmarine as jm
from experiments import radiation as study

from .conftest import ROOT

GAIN, FAST, SLOW = 30.0, 0.3, 1.5  # [N s/m], [s], [s]


def retardation(t):
    """The kernel of two first-order lags, on paper."""
    return GAIN * (np.exp(-t / FAST) / FAST - np.exp(-t / SLOW) / SLOW)


def with_memories() -> jm.Vehicle:
    return study.craft(study.MODELS[0]).place(*(jm.Placed(m) for m in study.memories(GAIN, FAST, SLOW)))


def test_two_memories_are_the_convolution_of_their_kernel(monkeypatch):
    vehicle, dt = with_memories(), 0.02
    t = np.arange(0.0, 6.0, dt)
    force = 40.0 * np.sin(1.3 * t)
    monkeypatch.setattr(study, "kernel", retardation)
    _, speed = study.true_run(vehicle, force, dt)
    wrench = np.zeros((len(t), 6))
    wrench[:, study.HEAVE] = force
    log = jm.Log(t, np.full((len(t), 18), np.nan), None, wrench, vehicle.command_names, "-")
    shown = np.asarray(jm.simulate(vehicle, log, jm.initial_state(vehicle)).channels)[:, 6 + study.HEAVE]
    # Heun and the trapezoids err by (0.02 / 0.3)² / 12 of the memory's force.
    assert np.abs(speed).max() > 0.3
    np.testing.assert_allclose(shown, speed, atol=2e-4)
    monkeypatch.setattr(study, "kernel", lambda t: 0 * t)
    _, without = study.true_run(vehicle, force, dt)
    assert np.abs(without - speed).max() > 0.04


def test_added_mass_and_damping_are_those_of_ogilvie():
    vehicle = with_memories()
    mass, damping = (float(a[2, 2]) for a in (vehicle.added_mass, vehicle.damping.linear))
    t = np.arange(0.0, 40.0, 1e-3)
    for omega in 0.3, 1.5, 4.0:
        more, brakes = study.ogilvie(t, retardation(t), omega)
        np.testing.assert_allclose(study.added(vehicle, omega), (mass + more, damping + brakes), rtol=1e-5)
        assert brakes > 0  # passive
        # The true kernel, from its transfer function on paper.
        s = 1j * omega
        shown = study.EXTRA * study.OMEGA**2 * s / (s**2 + 2 * study.ZETA * study.OMEGA * s + study.OMEGA**2)
        expected = shown.imag / omega, shown.real
        assert study.ogilvie(t, study.kernel(t), omega) == pytest.approx(expected, rel=1e-4)


def test_the_sea_has_the_peak_and_the_size_that_was_asked_for():
    vehicle = study.craft(study.MODELS[0])
    log = study.logged(vehicle, study.SEAS["short"], 60.0, [0])
    assert log.wrench is not None
    push = np.asarray(log.wrench)[:, study.HEAVE]
    power = np.abs(np.fft.rfft(push)) ** 2
    peak = np.fft.rfftfreq(len(push), study.DT)[np.argmax(power)]
    # Of one minute the strongest of 24 components lies within a fifth of the peak.
    assert peak * study.SEAS["short"] == pytest.approx(1.0, abs=0.2)
    assert push.std() == pytest.approx(study.FORCE, rel=0.15)


def test_the_page_says_what_was_found():
    found = json.loads((study.HERE / "results.json").read_text())
    assert len(found["rows"]) == 12 and study.claims(found["rows"]) == found["claims"]
    assert study.table(found) in (ROOT / "experiments" / "README.md").read_text()


@pytest.mark.slow  # four fits
def test_a_quick_run_finds_that_a_constant_mass_does_not_carry_over(tmp_path):
    app = typer.Typer()
    app.command()(study.main)
    assert CliRunner().invoke(app, ["--out", str(tmp_path), "--quick"], catch_exceptions=False).exit_code == 0
    (row,) = json.loads((tmp_path / "results.json").read_text())["rows"]
    constant, model = (
        row["errors"][f"{m}, found in the long sea, predicts the short one"] for m in study.MODELS
    )
    assert model < 0.5 * constant
    # By Ogilvie's relation, at the peaks; a sea has shorter waves than its peak's too, whose mass is less.
    t = np.arange(0.0, 40.0, 0.002)
    own = float(study.craft(study.MODELS[0]).added_mass[study.HEAVE, study.HEAVE])
    long, short = (
        own + study.ogilvie(t, study.kernel(t), 2 * np.pi / period)[0] for period in study.SEAS.values()
    )
    found = row["masses"]["constant added mass, found in the long sea, at the peak of the short one"]
    assert 1 + 0.5 * (long / short - 1) < found < long / short
