"""The blind plant's controllers and disturbances, against closed forms and against the logs themselves."""

import json
from typing import Any

import numpy as np
import pytest

from experiments.blind import cases, disturbances, grading
from experiments.blind.disturbances import Weather, full_push, gauss_markov, jonswap, over
from experiments.blind.feedback import STEERINGS, STRAY, Controller, wrapped
from experiments.blind.outside import draw as draw_outside
from experiments.blind.plant import Disturbance, Effect, Outside
from experiments.blind.vehicle import FOLDER, Vehicle, from_tables, load

DT = cases.DT
BOAT, ROV = "cybership2", "tethra"


def torpedo() -> Vehicle:
    """A slimmer Minesniper with less weight below its centre, and more thrust for it."""
    raw = load("minesniper").raw
    thrusters = [one | {"max_thrust": 20.0 if i < 2 else 12.0} for i, one in enumerate(raw["thruster"])]
    body = raw["body"] | {"cog": [0.0, 0.0, 0.01], "cob": [0.0, 0.0, -0.01]}
    return from_tables(raw | {"name": "torpedo", "body": body, "thruster": thrusters})


CRAFT = {path.stem: load(path) for path in sorted(FOLDER.glob("*.toml"))} | {"torpedo": torpedo()}


def fed_back(
    ship: str,
    steering: str,
    *,
    hidden: list | None = None,
    samples: int = 300,
    noise: np.ndarray | None = None,
    push: Disturbance | None = None,
) -> tuple[cases.Log, Controller]:
    """A log from heading 0.7 rad with set-points of seed 3, and a controller that knows the same."""
    vehicle = CRAFT[ship]
    steer, again = (Controller(vehicle, steering, samples, np.random.default_rng(3)) for _ in range(2))
    drawn = noise if noise is not None else white(vehicle, samples)
    return cases.close_loop(vehicle, hidden or [], steer, drawn, 0.7, push), again


def white(vehicle: Vehicle, samples: int, seed: int = 4) -> np.ndarray:
    return vehicle.noise * np.random.default_rng(seed).standard_normal((samples, 18))


# --- controllers ----------------------------------------------------------------------------------


@pytest.mark.parametrize("steering", STEERINGS)
@pytest.mark.parametrize("ship", CRAFT)
def test_every_craft_settles_on_its_set_points(ship, steering):
    vehicle, samples = CRAFT[ship], 700
    controller = Controller(vehicle, steering, samples, np.random.default_rng(3))
    wanted = {i: 0.5 * controller.reach(i) for i in np.flatnonzero(controller.steered).tolist()}
    if controller.keeps_place:
        wanted |= {0: 2.0 * STRAY, 1: 0.5 * STRAY}
    controller.goals[:] = controller.rates[:] = controller.bends[:] = 0.0
    for i, value in wanted.items():
        (controller.rates if controller.by_speed[i] else controller.goals)[:, i] = value
    run = cases.close_loop(vehicle, [], controller, np.zeros((samples, 18)), 0.7).run
    pose, velocity = run.states[-100:, :6, 0], run.states[-100:, 6:12, 0]
    assert np.abs(run.states[:, 3:5]).max() < 0.8
    for i, value in wanted.items():
        if controller.by_speed[i]:
            assert np.abs(velocity[:, i] - value).max() < 0.1 * controller.reach(i) + 0.01
        elif i < 2 and not controller.steered[1]:
            assert np.hypot(*(pose[:, :2] - [wanted[0], wanted[1]]).T).max() < STRAY + 0.2
        elif i != 5 or not controller.keeps_place or controller.steered[1]:
            turned = pose[:, i] - (0.7 if i == 5 else 0.0)
            assert np.abs(wrapped(turned - value)).max() < 0.3 * abs(value) + 0.02


@pytest.mark.parametrize("steering", STEERINGS)
def test_a_controller_acts_on_the_noisy_samples_of_its_log(steering):
    """Nothing but the written samples is needed to tell what it commands."""
    vehicle = CRAFT[BOAT]
    log, again = fed_back(BOAT, steering)
    lines = cases.table(vehicle, log, vehicle.noise, np.random.default_rng(0)).splitlines()
    logged = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    samples, commands = np.zeros((len(logged), 18)), logged[:, -len(vehicle.names) :]
    samples[:, [row for _, row in vehicle.signals()]] = logged[:, 1 : -len(vehicle.names)]
    said = np.array([again(k, one[:12]) for k, one in enumerate(samples)])
    assert np.abs(said - commands).max() < 1e-3
    assert np.abs(commands).max() <= 1.0
    states = log.run.states[:, :, 0]
    assert np.std(samples[:, 6] - states[:, 6]) == pytest.approx(vehicle.noise[6], rel=0.15)


@pytest.mark.parametrize("ship", [BOAT, "azimuth"])
def test_a_slow_computer_commands_every_tenth_sample_and_holds(ship):
    """What it asks for is what it would of these samples alone, with its own time from one to the next."""
    vehicle, held = load(ship), 10
    noise = white(vehicle, 300)
    slow, again = (
        Controller(vehicle, "pilot", 300, np.random.default_rng(3), dt=held * DT) for _ in range(2)
    )
    log = cases.close_loop(vehicle, [], slow, noise, 0.7, held=held)
    steered, asked = log.commands[:, : len(vehicle.steered)], log.commands[::held]
    assert np.array_equal(steered, np.repeat(steered[::held], held, axis=0))
    seen = (log.run.states[:, :, 0][:, :12] + noise[:, :12])[::held]
    said = [again(held * k, one)[None] for k, one in enumerate(seen)]
    said = np.concatenate(
        [vehicle.asked(one, now[None, len(vehicle.steered) :]) for one, now in zip(said, asked, strict=True)]
    )
    assert np.abs(said - asked).max() < 1e-6
    assert len(np.unique(asked, axis=0)) > 20


def test_commands_depend_on_no_later_sample():
    noise, k = white(CRAFT[BOAT], 300), 200
    other = noise.copy()
    other[k:] = white(CRAFT[BOAT], 300, seed=5)[k:]
    first, second = (fed_back(BOAT, "pilot", noise=n)[0] for n in (noise, other))
    assert np.array_equal(first.commands[:k], second.commands[:k])
    assert not np.array_equal(first.commands[k], second.commands[k])


def test_commands_are_clipped():
    log = fed_back(BOAT, "pilot", push=over(Weather("slow", 0.06, 10.0, 0.0), CRAFT[BOAT], 300, rng()))[0]
    assert np.abs(log.commands).max() == 1.0


def lagging() -> list:
    late = [
        Effect("input_delay", None, {"delay": 0.25}),
        Effect("thruster_lag", None, {"time_constant": 0.4}),
    ]
    return [*late, Effect("thruster_gain", "star", {"factor": 0.6}, 15.0)]


def sticky() -> list:
    vehicle = CRAFT[BOAT]
    hysteresis = draw_outside("hysteresis", vehicle, cases.typical(vehicle, "rich"), rng()).build(0.2)
    assert isinstance(hysteresis, Outside)
    return [hysteresis]


@pytest.mark.parametrize("hidden", [lagging, sticky])
def test_the_logged_commands_alone_give_the_same_run(hidden):
    """What is hidden does with commands in the loop what it does with a log's."""
    log, _ = fed_back(BOAT, "tracking", hidden=hidden())
    again = cases.roll_out(CRAFT[BOAT], hidden(), log.commands, 0.7)
    assert np.allclose(log.run.states, again.run.states, atol=1e-12)


def test_a_controller_sees_what_wrong_sensors_say():
    hidden = [
        Effect("sensor_delay", "attitude", {"delay": 0.4}),
        Effect("gyro_bias", None, {"r": 0.05}, since=15.0),
    ]
    log, again = fed_back(BOAT, "pilot", hidden=hidden)
    assert log.noise is not None
    seen = log.seen() + log.noise
    seen[0] = log.run.signals()[0, :, 0] + log.noise[0]  # there is nothing late yet
    said = np.array([again(k, one[:12]) for k, one in enumerate(seen)])
    assert np.abs(said - log.commands).max() < 1e-9


# --- disturbances ---------------------------------------------------------------------------------


def rng() -> np.random.Generator:
    return np.random.default_rng(6)


def correlation(x: np.ndarray, lag: int) -> float:
    return float(np.mean(x[lag:] * x[:-lag]) / np.mean(x * x))


def test_a_gauss_markov_signal_has_its_deviation_from_the_start_and_forgets_exponentially():
    tau, deviation = 3.0, np.full(20000, 2.0)
    x = gauss_markov(61, deviation, tau, rng())[:, :, 0]
    assert np.std(x[[0, 30, 60]], axis=1) == pytest.approx(2.0, rel=0.02)
    for lag in (15, 30, 60):
        found = np.mean(x[0] * x[lag]) / 4.0
        assert found == pytest.approx(np.exp(-lag * DT / tau), abs=0.025)


@pytest.mark.parametrize("kind", ["gusts", "slow", "current"])
def test_what_pushes_has_its_size_and_memory(kind):
    size, memory = 0.04, 3.0
    push = over(Weather(kind, size, memory, 0.0), CRAFT[ROV], 60000, rng())
    # Two propellers of 120 N push Tethra ahead.
    named = {"gusts": (push.wrench, 240.0), "slow": (push.force, 240.0), "current": (push.water, 1.0)}
    rows, full = named[kind]
    assert rows is not None
    for x in rows[:, :2, 0].T:
        assert np.std(x) == pytest.approx(size * full, rel=0.1)
        assert correlation(x, round(memory / DT)) == pytest.approx(np.exp(-1.0), abs=0.1)


def test_a_spectrum_of_waves_has_the_closed_form_of_pierson_and_moskowitz():
    """Its integral is 1 / (5 peak^4); gamma = 3.3 raises it by 1 / (1 - 0.287 ln gamma)."""
    peak = 0.9
    omega = np.linspace(0.2, 30.0, 200000)
    area, higher = (np.trapezoid(jonswap(omega, peak, gamma), omega) for gamma in (1.0, 3.3))
    assert area == pytest.approx(1.0 / (5.0 * peak**4), rel=1e-3)
    assert higher / area == pytest.approx(1.0 / (1.0 - 0.287 * np.log(3.3)), rel=0.02)
    assert omega[np.argmax(jonswap(omega, peak))] == pytest.approx(peak, abs=1e-3)


def test_wave_forces_have_their_size_peak_period_and_direction():
    size, period, direction, samples = 0.05, 6.0, 0.8, 40000
    push = over(Weather("waves", size, period, direction), CRAFT[ROV], samples, rng())
    assert push.force is not None
    north, east, down = push.force[:, :, 0].T
    along = north * np.cos(direction) + east * np.sin(direction)
    assert np.hypot(north, east) == pytest.approx(np.abs(along))
    # Significant height: four deviations.
    assert 4.0 * np.std(along) == pytest.approx(4.0 * size * 240.0, rel=0.03)
    assert 4.0 * np.std(down) == pytest.approx(4.0 * size * 240.0, rel=0.03)
    assert abs(np.mean(along * down)) < 0.05 * np.var(along)  # a quarter of a turn apart
    power = np.abs(np.fft.rfft(along)) ** 2
    omega = 2.0 * np.pi * np.fft.rfftfreq(samples, DT)
    peak = 2.0 * np.pi / period
    # The variance below, about and above the peak is that of the spectrum.
    first, last = disturbances.SPECTRUM
    fine = np.linspace(first * peak, last * peak, 20000)
    for low, high in ((0.6, 0.9), (0.9, 1.15), (1.15, 2.5)):
        share = power[(omega >= low * peak) & (omega < high * peak)].sum() / power.sum()
        inside = (fine >= low * peak) & (fine < high * peak)
        assert share == pytest.approx(jonswap(fine[inside], peak).sum() / jonswap(fine, peak).sum(), abs=0.08)


def test_a_force_in_earth_axes_turns_with_the_heading():
    force = np.array([[[3.0], [1.0], [2.0]]])
    still = Disturbance(np.zeros((1, 6, 1)), force)
    east = np.array([[0.0], [0.0], [np.pi / 2]])  # the bow points east, starboard south
    assert still.at(0, east)[0][:, 0] == pytest.approx([1.0, -3.0, 2.0, 0.0, 0.0, 0.0])


def test_water_that_moves_steadily_is_a_steady_current():
    vehicle, samples = CRAFT[ROV], 100
    commands = 0.5 * white(vehicle, samples)[:, : len(vehicle.names)] / 0.01
    flow = np.array([0.1, -0.05, 0.0])
    water = Disturbance(np.zeros((samples, 6, 1)), water=np.tile(flow[:, None], (samples, 1, 1)))
    current = Effect("steady_current", None, {"north": 0.1, "east": -0.05})
    carried = cases.roll_out(vehicle, [], np.clip(commands, -1, 1), 0.4, water)
    known = cases.roll_out(vehicle, [current], np.clip(commands, -1, 1), 0.4)
    assert np.allclose(carried.run.states, known.run.states, atol=1e-12)


def test_nothing_pushes_a_locked_axis():
    assert np.flatnonzero(full_push(CRAFT[BOAT])).tolist() == [0, 1, 5]


# --- cases ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("steering", ["rich", "pilot"])
def test_commands_of_a_case_are_held_and_its_answer_says_so(tmp_path, steering):
    short: dict[str, Any] = {"duration_train": 20.0, "duration_test": 10.0, "excitation": steering}
    told = cases.make_case(tmp_path / "slow", BOAT, [], 1, held=10, **short)
    quick = cases.make_case(tmp_path / "quick", BOAT, [], 1, **short)
    assert told["options"]["held"] == 10 and "held" not in quick["options"]
    slow, other = (
        np.loadtxt(tmp_path / one / "train.csv", delimiter=",", skiprows=1) for one in ("slow", "quick")
    )
    commands = slow[:, -len(CRAFT[BOAT].names) :]
    assert np.array_equal(commands, np.repeat(commands[::10], 10, axis=0))
    assert (np.ptp(commands, axis=0) > 0.1).all()
    assert not np.array_equal(other[:, -1], np.repeat(other[::10, -1], 10))


def test_the_same_seed_gives_the_same_files(tmp_path):
    options: dict[str, Any] = {"duration_train": 20.0, "duration_test": 10.0, "excitation": "station"}
    gain = Effect("thruster_gain", "star", {"factor": 0.5})
    for name, seed in (("first", 1), ("again", 1), ("other", 2)):
        cases.make_case(tmp_path / name, BOAT, [gain], seed, disturbance="waves", **options)
    for file in ("vehicle.toml", "train.csv", "test.csv", "answer.json"):
        first, again, other = ((tmp_path / name / file).read_bytes() for name in ("first", "again", "other"))
        assert first == again
        assert (first == other) == (file == "vehicle.toml")


def test_a_share_of_cases_is_fed_back_and_says_so(tmp_path):
    plan = cases.Plan(nulls=2, singles=0, pairs=0, outside=0, misfit=0, train=20.0, test=10.0, feedback=0.5)
    cases.design(tmp_path, plan, [BOAT], seed=1)
    answers = [json.loads(path.read_text()) for path in sorted(tmp_path.glob("*/answer.json"))]
    steered = [a["options"].get("steering", "sticks") for a in answers]
    assert [s in STEERINGS for s in steered] == [False, True]
    fed = answers[1::2]
    assert all(a["options"]["disturbance"] in disturbances.KINDS for a in fed)
    assert all(("also" in a) == (a["options"]["disturbance"] == "waves") for a in answers)


@pytest.mark.parametrize(("upper", "right"), [(0.9, True), (1.1, False)])
def test_waves_may_be_named_where_they_push_and_the_test_log_confirms_it(upper, right):
    answer = {"findings": [], "also": ["waves"], "options": {}}
    finding = {"effect": "waves", "target": None, "alternatives": []}
    diagnosis = {"findings": [finding], "verdict": "explained", "gain": {"ratio_ci95": [0.7, upper]}}
    assert grading.grade(answer, diagnosis)["whole"] is right
    assert not grading.grade({**answer, "also": []}, diagnosis)["whole"]
