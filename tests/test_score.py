"""The sums that decide a verdict, against dense least squares and against numbers worked by hand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._errors import InputError
from jaxmarine._types import CHANNELS
from jaxmarine.diagnosis._couplings import couplings
from jaxmarine.diagnosis._explanation import Beginning, Member
from jaxmarine.diagnosis._gain import Candidate, _stretches, gain
from jaxmarine.diagnosis._gain import predictions as predicted
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._result import Predictions
from jaxmarine.diagnosis._score import Reduced, root, savings, step_with
from jaxmarine.diagnosis._signals import Places
from jaxmarine.effects import Craft, Suspect, ThrusterGain, Waves
from jaxmarine.fitting import Room, cut, noise_of
from jaxmarine.simulation import initial_state
from jaxmarine.vehicle import Damping, Placed, inverse_dynamics
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle
from tests.boats import boat, record, steps

WINDOWS, ROWS, KNOWN, OWN = 12, 30, 3, 2


def least(jacobian: np.ndarray, residual: np.ndarray, prior: np.ndarray, offset: np.ndarray) -> float:
    """The least chi-square of residual + jacobian x with x_i + offset_i held near 0 by the first prior_i."""
    count = jacobian.shape[1]
    pull = np.zeros((len(prior), count))
    pull[:, : len(prior)] = np.diag(np.sqrt(prior))
    whole = np.vstack([jacobian, pull])
    target = np.concatenate([residual, np.sqrt(prior) * offset])
    x = np.linalg.lstsq(whole, -target)[0]
    return float(((whole @ x + target) ** 2).sum())


def test_savings_are_those_of_dense_least_squares():
    """Two suspects beside three known numbers under a prior; acting always, or from each window on."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(WINDOWS, ROWS, KNOWN + 2 * OWN))
    truth = np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.5, -0.4])
    residual = rng.normal(size=(WINDOWS, ROWS)) - jacobian @ truth
    stats = Reduced(
        (residual**2).sum(1),
        np.einsum("wri,wr->wi", jacobian, residual),
        np.einsum("wri,wrj->wij", jacobian, jacobian),
    )
    known, rest = np.split(np.eye(KNOWN + 2 * OWN), [KNOWN], axis=1)
    owns = (rest[:, :OWN], rest[:, OWN:])
    prior, offset = np.array([4.0, 100.0, 1e-3]), np.array([0.2, -0.1, 0.4])
    earliest = 3
    table = savings(stats, known, prior, offset, owns, earliest)

    def flat(columns: np.ndarray, begin: int) -> np.ndarray:
        acting = (np.arange(WINDOWS) >= begin)[:, None, None]
        now = np.concatenate([jacobian @ known, acting * (jacobian @ columns)], axis=2)
        return now.reshape(WINDOWS * ROWS, -1)

    for i, own in enumerate(owns):
        before = least(flat(own[:, :0], 0), residual.ravel(), prior, offset)
        for begin in range(WINDOWS):
            if begin and (begin < earliest or begin > WINDOWS - earliest):
                assert table[i, begin] == -np.inf
                continue
            after = least(flat(own, begin), residual.ravel(), prior, offset)
            # The ridge of 1e-10 that keeps the elimination regular is all that differs.
            assert table[i, begin] == pytest.approx(before - after, rel=1e-6)
    assert table[1, 0] > 10 * table[0, 0]


def test_a_step_with_entries_held_is_least_in_the_others():
    """Against the Karush-Kuhn-Tucker equations, on columns in units a million apart."""
    rng = np.random.default_rng(1)
    units = np.array([1.0, 1e3, 1e-3, 1.0, 10.0])
    rows = rng.normal(size=(40, 5)) * units
    h, g = rows.T @ rows, rows.T @ rng.normal(size=40)
    held, values = np.array([1, 4]), np.array([2e-4, -0.03])
    pick = np.eye(5)[held]
    multipliers = np.block([[h, pick.T], [pick, np.zeros((2, 2))]])
    exact = np.linalg.solve(multipliers, np.concatenate([-g, values]))[:5]
    # The ridge of 1e-10 that keeps the solve regular is all that differs.
    assert step_with(g, h, held, values) * units == pytest.approx(exact * units, rel=1e-7)


def shown(
    times: np.ndarray, before: np.ndarray, after: np.ndarray, measured: np.ndarray, begin: int, noise, log=""
) -> Predictions:
    return Predictions(times, begin, measured, before, after, noise, log)


def predictions(starts: int, size: float, seed: int):
    """Predictions of u that miss the measurement by errors of a given size."""
    rng = np.random.default_rng(seed)
    shown = np.full((starts, 6, len(CHANNELS)), np.nan)
    shown[..., CHANNELS.index("u")] = size * rng.choice([-1.0, 1.0], size=(starts, 6))
    return shown


def test_the_gain_is_the_ratio_of_root_mean_square_errors():
    starts, stride = 60, 1.0
    times = stride * np.arange(starts)[:, None] + np.arange(6)
    measured = np.where(np.isfinite(predictions(starts, 1.0, 0)), 0.0, np.nan)
    before, after = predictions(starts, 0.4, 1), predictions(starts, 0.1, 2)
    # Samples of the run-in do not count, but for saying whether the start is good.
    before[:, :2], after[:, :2] = 100.0, 0.01
    noise = np.full(len(CHANNELS), 0.02)
    found, _ = gain([shown(times, before, after, measured, 2, noise)], noise, [True])
    assert found.ratio == pytest.approx(0.25)
    # Errors of one size at every start are the same in every stretch.
    assert found.ratio_ci95 == pytest.approx((0.25, 0.25))
    assert found.velocity is not None and found.position is None
    assert (found.velocity.before, found.velocity.after) == pytest.approx((0.4, 0.1))


@pytest.mark.parametrize(("starts", "stretches"), [(20, 2), (60, 6), (200, 10)])
def test_intervals_of_the_gain_hold_the_truth_as_often_as_they_say(starts, stretches):
    """Ten neighbouring starts, half a second apart, share their errors."""
    alike, sigma, draws, rng = 10, 0.3, 100, np.random.default_rng(4)
    noise = np.ones(len(CHANNELS))
    times = 0.5 * np.arange(starts)[:, None] + np.arange(6.0)
    assert _stretches(times) == stretches
    before = predictions(starts, 1.0, 5)
    measured = np.where(np.isfinite(before), 0.0, np.nan)
    truth = np.exp(sigma**2)  # root mean square of the lognormal sizes
    inside = 0
    for _ in range(draws):
        size = np.repeat(rng.lognormal(sigma=sigma, size=starts // alike), alike)[:, None, None]
        each = shown(times, before, size * before, measured, 0, noise)
        interval = gain([each], noise, [True])[0].ratio_ci95
        assert interval is not None
        inside += interval[0] < truth < interval[1]
    # 95 %, less some 5 % that the skewness of so few sizes takes, and three standard errors of the count.
    assert inside >= 81


def test_a_log_of_hardly_more_than_one_prediction_gives_no_interval():
    times = 0.1 * np.arange(30)[:, None] + np.linspace(0.0, 9.0, 91)
    before = np.full((30, 91, len(CHANNELS)), np.nan)
    before[..., CHANNELS.index("u")] = 1.0
    measured = np.where(np.isfinite(before), 0.0, np.nan)
    noise = np.ones(len(CHANNELS))
    found, _ = gain([shown(times, before, 0.5 * before, measured, 40, noise)], noise, [True])
    assert found.ratio == pytest.approx(0.5) and found.ratio_ci95 is None


@pytest.mark.slow
def test_a_wave_is_met_again_at_another_phase():
    """The period is that of training; the phase of a later log is read from what lies before each start."""
    craft = boat()

    def rocked(phase: float):
        wave = Waves(jnp.asarray(12.0), jnp.asarray(5.0), jnp.asarray(3.0), jnp.asarray(phase))
        return craft.place(Placed(wave))

    log = record(rocked(2.0), steps(400))
    noise = noise_of(craft, [log])
    data = cut(craft, [log], noise, 4.0)
    families = (ThrusterGain(jnp.ones(3)),)  # a program takes one parameter at least
    candidates = [
        Candidate(vehicle, families, np.ones((1, 3)), np.ones((1, len(vehicle.placed))))
        for vehicle in (rocked(2.0), rocked(-1.1), craft)
    ]
    room = Room.of(data.records, data.windows)
    times, (right, turned, without), measured, begin = predicted(
        candidates, log, noise, 4.0, 0.1, np.zeros(len(log.t), int), room, 8
    )

    def ratio(before: np.ndarray, after: np.ndarray) -> float:
        return gain([shown(times, before, after, measured, begin, noise)], noise, [True])[0].ratio

    # Whether the file's phase is right or not, it is forgotten.
    assert ratio(right, turned) == pytest.approx(1.0, abs=1e-3)
    assert ratio(without, turned) < 0.5


def test_beginnings_of_the_file_and_of_members_cut_the_logs_together():
    """Two logs; the file's effect begins in the second, a member in the first, the test comes last."""
    craft = boat()
    fouled = Placed(ThrusterGain(jnp.array([0.5, 1.0, 1.0])), "port", 6.0, "second")
    logs = [record(craft, steps(200), name=name) for name in ("first", "second")]
    bench = workbench(craft.place(fouled), logs, (ThrusterGain,), 1.5)
    members = (Member(0, Beginning(0, 12.0)),)
    found = bench.stretches(members)
    pairs = [list(zip(found.passed[rows], found.gates[rows, 0], strict=True)) for rows in found.of_samples]
    assert pairs[0] == [(0, 0.0)] * 120 + [(1, 0.0)] * 80
    assert pairs[1] == [(1, 0.0)] * 60 + [(1, 1.0)] * 140
    # What has begun goes on in a log that comes after; a training log met again keeps its own.
    later = bench.stretches(members, record(craft, steps(50, seed=1), name="third"))
    assert set(zip(later.passed[later.of_samples[0]], later.gates[later.of_samples[0], 0], strict=True)) == {
        (1, 1.0)
    }
    again = bench.stretches(members, logs[0])
    assert np.array_equal(again.passed[again.of_samples[0]], found.passed[found.of_samples[0]])
    # The member's numbers act from its beginning on only.
    acts = np.asarray(bench.affine(members).acts)[:, bench.slices(members)[0]]
    assert [acts[row, 0] for row in range(len(found.passed))] == list(found.passed)


def test_what_the_programs_have_no_room_for_is_said():
    craft, logs = boat(), [record(boat(), steps(200), name=name) for name in ("first", "second")]

    class Wide(ThrusterGain):
        """More parameters than any diagnosis fits at once."""

        @classmethod
        def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
            del craft
            return (Suspect(cls, None, {f"factor_{i}": (0,) for i in range(50)}),)

    with pytest.raises(InputError, match=r"thruster_gain has 50 parameters, .* at most 44 at once"):
        workbench(craft, logs, (Wide,), 1.5)
    half = ThrusterGain(jnp.array([0.5, 1.0, 1.0]))
    often = craft.place(*(Placed(half, "port", since) for since in (4.0, 8.0, 12.0, 16.0)))
    with pytest.raises(InputError, match="begin at 4 times within these logs; a diagnosis has room for 3"):
        workbench(often, logs[:1], (ThrusterGain,), 1.5).stretches(())


def test_couplings_are_what_inverse_dynamics_asks_for_where_they_are_doubled():
    """All terms off the diagonals together; velocities change evenly, so that the differences are exact."""
    vehicle = load_vehicle(packaged_vehicle("tethra"))
    rng = np.random.default_rng(0)
    added, quadratic = (jnp.diag(jnp.diag(m)) for m in (vehicle.added_mass, vehicle.damping.quadratic))
    vehicle = dataclasses.replace(
        vehicle,
        # What joins sway and yaw is a suspect by itself.
        added_mass=added.at[0, 1].set(7.0).at[1, 0].set(7.0),
        damping=Damping(vehicle.damping.linear, quadratic.at[0, 4].set(3.0).at[5, 1].set(-2.0)),
    )
    t = np.arange(5) * 0.5
    nu_dot = rng.normal(size=(2, 1, 6))
    nu = rng.normal(size=(2, 1, 6)) + nu_dot * t[:, None]
    where = Places(np.tile(t, (2, 1)), np.zeros(2, int), np.tile(np.eye(3), (2, 5, 1, 1)), nu, nu, {}, {})
    found = couplings(vehicle, where)

    def doubled(matrix):
        return 2 * matrix - jnp.diag(jnp.diag(matrix))

    more = dataclasses.replace(
        vehicle,
        added_mass=doubled(vehicle.added_mass),
        damping=Damping(vehicle.damping.linear, doubled(vehicle.damping.quadratic)),
    )
    start = initial_state(vehicle)
    for window in range(2):
        for knot in range(5):
            state = dataclasses.replace(start, velocity=jnp.asarray(nu[window, knot]))
            asked = [inverse_dynamics(v, state, jnp.asarray(nu_dot[window, 0]), 0.0) for v in (more, vehicle)]
            # Rounding of forces of some thousand newtons.
            np.testing.assert_allclose(found[window, knot].sum(-1), asked[0] - asked[1], atol=1e-9)
    assert found.shape[-1] == 3


def test_a_root_is_that_of_the_nearest_semidefinite_matrix():
    """Of a matrix of rank two in very different units; and of one that rounding has spoilt."""
    rng = np.random.default_rng(0)
    units = np.array([1.0, 1e6, 1e-6])
    thin = units[:, None] * rng.normal(size=(3, 2))
    h = thin @ thin.T
    half = root(h)
    assert np.allclose(half @ half.T / np.outer(units, units), h / np.outer(units, units), atol=1e-12)
    spoilt = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    half = root(spoilt)
    assert np.allclose(half @ half.T, np.ones((2, 2)), atol=1e-8)
    assert np.linalg.eigvalsh(half @ half.T).min() > -1e-15
