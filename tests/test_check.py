"""What a log can tell: the information matrix against finite differences, verdicts on logs that are known."""

import dataclasses
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from jaxmarine._types import CHANNELS
from jaxmarine.cli import main
from jaxmarine.examples import hidden, operator, recorded
from tests.crafts import brick, packaged

STEP, SAMPLES, WINDOW = 0.1, 1600, 40  # [s], samples, samples of a window
NOISE = 0.01  # [m/s, rad, rad/s]
MASS, LINEAR, QUADRATIC = (10.0, 3.0), (2.0, 1.5), (4.0, 0.0)  # surge, pitch
ARM = 0.05  # [m] from the centre of gravity up to the centre of buoyancy
RIGHTING = (0.0, 98.1 * ARM)
START = (0.3, 0.4)  # [m/s, rad/s]
T = STEP * np.arange(SAMPLES)


def craft() -> jm.Vehicle:
    """Neutral, righted in pitch; surge and pitch know nothing of one another."""
    linear, quadratic = np.zeros(6), np.zeros(6)
    linear[[0, 4]], quadratic[[0, 4]] = LINEAR, QUADRATIC
    cog = np.array([0.0, 0.0, ARM])
    body = brick(dof=("surge", "pitch"), linear=linear, quadratic=quadratic, cog=cog)
    # Arrays as a file gives them, so that both are compiled once.
    body = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), body)
    return dataclasses.replace(body, sensors=(("attitude", NOISE), ("velocity", NOISE), ("rate", NOISE)))


def pushed(seed: int, pitch: float, one_way: bool = False) -> np.ndarray:
    """Wrench [times, 6] with a new level in surge and pitch every second."""
    rng = np.random.default_rng(seed)
    levels = np.repeat(rng.uniform(-1, 1, (SAMPLES // 10, 2)), 10, axis=0)
    wrench = np.zeros((SAMPLES, 6))
    wrench[:, 0] = 6 * (np.abs(levels[:, 0]) if one_way else levels[:, 0])
    wrench[:, 4] = pitch * levels[:, 1]
    return wrench


def rolled(i: int, wrench: np.ndarray, start: np.ndarray, change=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Angle (or way) and velocity of one axis [times, 2]: Runge-Kutta steps of 25 ms from hold to hold."""
    m, d, q = np.array([MASS[i], LINEAR[i], QUADRATIC[i]]) + change
    x, h, out = np.array(start), STEP / 4, []
    for level in wrench:
        out.append(x)

        def rate(x, level=level):
            v = x[1]
            return np.array([v, (level - d * v - q * abs(v) * v - RIGHTING[i] * math.sin(x[0])) / m])

        for _ in range(4):
            a = rate(x)
            b = rate(x + h / 2 * a)
            c = rate(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
    return np.array(out)


def logged(wrench: np.ndarray, start=START) -> jm.Log:
    """Surge velocity, pitch and its rate, with noise."""
    channels = np.full((SAMPLES, len(CHANNELS)), np.nan)
    channels[:, CHANNELS.index("u")] = rolled(0, wrench[:, 0], (0.0, start[0]))[:, 1]
    pitch = rolled(1, wrench[:, 4], (0.0, start[1]))
    channels[:, [CHANNELS.index("theta"), CHANNELS.index("q")]] = pitch
    channels += NOISE * np.random.default_rng(0).normal(size=channels.shape)
    return jm.Log(T, channels, None, wrench, (), "tow.csv")


def expected(i: int, wrench: np.ndarray) -> np.ndarray:
    """Covariance of inertia, linear and quadratic damping of an axis, by finite differences.

    The start of each window is fitted with them.
    """
    truth = rolled(i, wrench, (0.0, START[i]))
    seen = slice(1 - i, 2)  # of surge the velocity alone is measured
    information = np.zeros((3, 3))
    for w in range(SAMPLES // WINDOW):
        here, start = wrench[w * WINDOW : (w + 1) * WINDOW], truth[w * WINDOW]
        columns = []
        for step in 1e-4 * np.eye(5):
            both = [rolled(i, here, start + s * step[3:], s * step[:3])[:, seen] for s in (1, -1)]
            columns.append(((both[0] - both[1]) / 2e-4 / NOISE).ravel())
        of, begin = np.array(columns[:3]).T, np.array(columns[3 + (1 - i) :]).T
        rest = of - begin @ np.linalg.lstsq(begin, of, rcond=None)[0]
        information += rest.T @ rest
    return np.linalg.inv(information)


@pytest.fixture(scope="module")
def rich() -> jm.Check:
    return jm.check(craft(), logged(pushed(1, pitch=2.0)))


def test_standard_errors_are_those_of_finite_differences(rich):
    wrench = pushed(1, pitch=2.0)
    for i, (dof, axis) in enumerate((("surge", 0), ("pitch", 4))):
        covariance = expected(i, wrench[:, axis])
        own = [c for c in rich.coefficients if c.dof == dof]
        assert [c.kind for c in own] == ["added_mass", "damping.linear", "damping.quadratic"]
        # Noise in the windows' starts and 0.1 s steps; the oracle has neither.
        np.testing.assert_allclose([c.std for c in own], np.sqrt(np.diag(covariance)), rtol=0.05)
        v = rich[dof].coverage.velocity_rms
        at = np.array([0.0, 1.0, v])
        force = np.sqrt(at @ covariance @ at) / (own[1].size + own[2].size * v)
        assert rich[dof].damping == pytest.approx(force, rel=0.05)


def test_errors_are_relative_to_the_value_or_to_a_typical_one(rich):
    own = {c.name: c for c in rich.coefficients}
    assert own["added_mass[surge]"].size == 10.0  # the whole inertia, where added mass is zero
    assert own["damping.linear[pitch]"].size == 1.5
    assert own["damping.quadratic[pitch]"].value == 0.0 < own["damping.quadratic[pitch]"].size
    assert rich["surge"].linear == pytest.approx(own["damping.linear[surge]"].std / 2.0)


def test_a_rich_log_excites_every_axis(rich):
    assert [a.excited for a in rich.axes] == ["yes", "yes"]
    assert rich.advice == ("Every axis is excited, and all its coefficients are determined.",)
    assert not rich.undetermined
    assert rich.misfit == pytest.approx(1.0, abs=0.2)  # of 4800 samples
    text = str(rich)
    assert "6 of 6 coefficients" in text and "surge" in text and "pitch" in text
    low, high = rich["surge"].coverage.velocity_range
    track = rolled(0, pushed(1, 2.0)[:, 0], (0.0, START[0]))[:, 1]
    assert low == pytest.approx(track.min(), abs=4 * NOISE)
    assert high == pytest.approx(track.max(), abs=4 * NOISE)
    assert sum(rich["surge"].coverage.velocity_shares) == pytest.approx(1.0)


def test_the_printed_table_has_a_number_below_each_heading(rich):
    lines = str(rich).splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("axis"))
    end = lines[head].index("scatter") + len("scatter")
    for axis, row in zip(rich.axes, lines[head + 2 :], strict=False):
        assert row.startswith(axis.dof)
        assert float(row[:end].split()[-1]) == pytest.approx(axis.scatter, rel=0.06)  # two digits
        assert row[end:].split() == [axis.excited]


def test_an_axis_at_rest_is_not_excited_whatever_its_noise_pretends():
    checked = jm.check(craft(), logged(pushed(1, pitch=0.0), start=(0.3, 0.0)))
    assert checked["surge"].excited == "yes" and checked["pitch"].excited == "no"
    assert min(checked["pitch"].inertia, checked["pitch"].damping) > 1.0
    assert checked.advice == ("Pitch is not excited: pitch up and down, in steps from low to full thrust.",)
    names = {name for one in checked.undetermined for name, _ in one.weights}
    assert names == {f"{kind}[pitch]" for kind in ("added_mass", "damping.linear", "damping.quadratic")}


def test_an_axis_that_went_to_one_side_is_told_so():
    checked = jm.check(craft(), logged(pushed(1, pitch=2.0, one_way=True), start=(0.6, 0.4)))
    assert "Surge went only ahead: go astern too, where the model extrapolates." in checked.advice
    assert checked["pitch"].excited == "yes"


def test_a_force_that_the_file_lacks_shows_in_the_scatter():
    wrench = pushed(1, pitch=2.0)
    log = logged(wrench)
    lying = dataclasses.replace(log, wrench=wrench * [0.7, 1, 1, 1, 1, 1])
    checked = jm.check(craft(), lying)
    assert checked["surge"].scatter > 5 and checked["pitch"].scatter < 2
    assert checked.misfit > 5
    assert checked.advice[-1].startswith("The vehicle file misses something in surge:")
    assert checked.advice[-1].endswith("diagnose the log first.")
    # Beside guesses a diagnosis would name what these miss.
    guessed = dataclasses.replace(craft(), prior=(("added_mass", 1.6),))
    assert "before a diagnosis" in jm.check(guessed, lying).advice[-1]


def test_a_check_needs_logs_and_windows():
    with pytest.raises(jm.InputError, match="at least one log"):
        jm.check(craft(), ())
    with pytest.raises(jm.InputError, match="shorter than two windows"):
        jm.check(craft(), logged(pushed(1, 2.0)).between(0.0, 5.0))


def test_the_command_line_says_the_same(tmp_path, capsys, monkeypatch, rich):
    log = logged(pushed(1, pitch=2.0))
    jm.save_vehicle(craft(), tmp_path / "brick.toml")
    jm.write_log(log, tmp_path / "tow.csv")
    argv = ["jaxmarine", "check", "--vehicle", str(tmp_path / "brick.toml"), str(tmp_path / "tow.csv")]
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0
    assert capsys.readouterr().out.split() == str(rich).split()


@pytest.mark.slow
def test_a_sensor_of_unknown_noise_is_no_better_than_the_file_predicts_it():
    """Without noise, and a thrust that is wrong by a third: by its own noise all would be known to 1e-5."""
    log = logged(pushed(1, pitch=2.0))
    clean = np.full_like(log.channels, np.nan)
    clean[:, CHANNELS.index("u")] = rolled(0, pushed(1, 2.0)[:, 0], (0.0, START[0]))[:, 1]
    log = dataclasses.replace(log, channels=clean, wrench=pushed(1, pitch=2.0) * [0.7, 1, 1, 1, 0, 1])
    alone = dataclasses.replace(craft(), sensors=(), dof=("surge",))
    checked = jm.check(alone, log)
    # The noise is raised until what is left is of its size, and as that lasts longer than a window, until its
    # 40 samples weigh as one, or as two: the errors are no longer those of rounding.
    assert 1 / 40 < checked.misfit < 1 / 20
    surge = expected(0, pushed(1, pitch=2.0)[:, 0])
    assert checked["surge"].inertia > np.sqrt(surge[0, 0]) / MASS[0]


@pytest.mark.slow
def test_a_diagnosis_tells_what_a_check_of_its_extended_vehicle_tells():
    """By other programs: those of the search, with the whole catalogue in the model."""
    train, test = hidden(packaged("tethra"), "thruster_gain", "port_h", {"factor": 0.72}, (90.0, 30.0))
    diagnosis = jm.diagnose(packaged("tethra"), train, test)
    alone = jm.check(diagnosis.extended, train)
    for ours, other in zip(diagnosis.check.axes, alone.axes, strict=True):
        assert ours.coverage == other.coverage
        for name in ("inertia", "damping", "linear", "quadratic"):
            # Other starts of the windows, from which information by noise is drawn.
            assert getattr(ours, name) == pytest.approx(getattr(other, name), rel=0.1), (ours.dof, name)


@pytest.mark.slow
def test_predicted_errors_are_the_scatter_of_fits_over_seeds():
    """Twelve dives with other noise: each fit's distance from the truth, in predicted standard errors."""
    vehicle = packaged("tethra")
    t = np.arange(0.0, 60.0, 0.1)
    commands = operator(4, t, seed=1)
    predicted = jm.check(vehicle, recorded(vehicle, commands, t, seed=0, name="dive.csv"))
    chosen = ("surge", "heave", "pitch", "yaw")
    scaled = []
    for seed in range(1, 13):
        log = recorded(vehicle, commands, t, seed=seed, name="dive.csv")
        fit = jm.fit(
            vehicle,
            log,
            lambda v: (v.added_mass, v.damping.linear, v.damping.quadratic),
            entries="diagonal",
        )
        scaled.append(
            [(fit[c.name].value - c.value) / c.std for c in predicted.coefficients if c.dof in chosen]
        )
    rms = np.sqrt(np.mean(np.square(scaled)))
    # 144 numbers that are hardly correlated: the root mean square is known to some 6 %.
    assert rms == pytest.approx(1.0, abs=0.15)
