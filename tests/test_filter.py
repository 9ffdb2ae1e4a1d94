"""The filter against the dense Gaussian that it factorises, and against noise of known colour."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_continuous_lyapunov
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from jaxmarine._types import SENSORS
from jaxmarine.diagnosis import _amid, _knots, _search
from jaxmarine.diagnosis._amid import amid_more
from jaxmarine.diagnosis._explanation import Beside, Member, Model
from jaxmarine.diagnosis._innovations import log_score, remembered, whiten
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._signals import samples_at
from jaxmarine.diagnosis._workbench import SLOTS, Workbench
from jaxmarine.disturbances import RandomWrench
from jaxmarine.effects import LinearDamping, QuadraticDamping, SensorDelay, SteadyCurrent, Waves, WindPush
from jaxmarine.fitting import _filter, drifting, flowing, with_current, with_drift, with_swell
from jaxmarine.fitting._affine import Affine
from jaxmarine.fitting._damped import minimise_outside
from jaxmarine.fitting._disturbance import PLANE, Disturbance
from jaxmarine.fitting._filter import Line, Windowed
from jaxmarine.fitting._logarithms import USUAL_FLOW, count_of, logarithms_of, unlearned, with_logarithms
from jaxmarine.fitting._processes import Swell
from jaxmarine.logs import Log
from jaxmarine.physics import LATE, late
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed, Vehicle
from tests.boats import NOISE, boat, steps

STEPS, ROWS, AXES, COLUMNS = 3, 4, 2, 5
# Whether there is a swell, a drift and a current.
PLAIN, ALL = (False, False, False), (True, True, True)
KINDS = list(itertools.product([False, True], repeat=3))
SPREAD = np.full(12, 0.7)


def windows_of(
    joined: list[bool], gap: list[float], kind: tuple[bool, bool, bool] = PLAIN
) -> tuple[Windowed, Disturbance]:
    """Some random windows: linear systems with states of 13 numbers that change in 12 ways."""
    count, rng = len(joined), np.random.default_rng(3)
    swells, drifts, flows = kind

    def normal(*shape, scale=1.0):
        return jnp.asarray(scale * rng.normal(size=(count, *shape)))

    size, time, frequency = [0.8, 1.7], [0.9, 3.0], [0.0, 0.0]
    if swells:
        size, time, frequency = [*size, 1.1, 0.6], [*time, 2.0, 2.0], [*frequency, 1.3, 1.3]
    if drifts:
        size, time, frequency = [*size, 0.9], [*time, 4.0], [*frequency, 0.0]
    if flows:
        size, time, frequency = [*size, 0.7], [*time, 1.5], [*frequency, 0.0]
    force = Disturbance(
        size=jnp.array(size),
        time=jnp.array(time),
        frequency=jnp.array(frequency),
        gap=jnp.asarray(gap),
        joined=jnp.asarray(joined),
        axes=(0, 5),
        drifts=drifts,
        flows=flows,
    )
    # One by one: a record is of one window.
    line = jax.vmap(Line)(
        f=normal(STEPS, 13, 13 + AXES + PLANE, scale=0.3),
        h=normal(STEPS, ROWS, 13 + AXES + PLANE, scale=0.5),
        residual=normal(STEPS, ROWS, COLUMNS),
        dt=jnp.asarray(rng.uniform(0.1, 0.4, (count, STEPS))),
        by_plane=normal(STEPS, AXES, PLANE, scale=0.6),
        begin=normal(13, 12),
    )
    return jax.vmap(Windowed)(
        line=line,
        states=normal(STEPS, 13),
        end=normal(13, COLUMNS),
        delta=normal(12),
        gap=force.gap,
        joined=force.joined,
    ), force


def joined_up(every: Windowed, force: Disturbance):
    """Information by the columns and the determinants' logarithm of all windows, by the filter."""
    message = _filter.nothing_known(force, COLUMNS)
    information, log_det = 0.0, 0.0
    for w in range(len(every.gap)):
        window = jax.tree.map(lambda a, w=w: a[w], every)
        more, log, message = window.informed(message, force, jnp.asarray(SPREAD))
        information, log_det = information + more, log_det + log
    return np.asarray(information), float(log_det)


def left(force: Disturbance, dt: float) -> np.ndarray:
    """From the disturbance's states to those some time later.

    What is to the north and to the east is no pair: it decays alike, and does not turn.
    """
    return expm(dt * rates_of(force))


def rates_of(force: Disturbance) -> np.ndarray:
    """The derivative of the disturbance's states by themselves."""
    blocks = [np.atleast_2d(-1.0 / t) for t in np.asarray(force.time)[:AXES]]
    for time, frequency in zip(
        np.asarray(force.time)[AXES:], np.asarray(force.frequency)[AXES:], strict=True
    ):
        if frequency:
            # Two filters in a row, each s / ((s + 1 / T)^2 + w^2) but for a factor.
            pair = np.array([[-1 / time, -frequency], [frequency, -1 / time]])
            driven = np.sqrt(8.0) / time * np.outer([1.0, 1.0 / (frequency * time)], [1.0, 0.0])
            blocks.append(np.block([[pair, np.zeros((2, 2))], [driven, pair]]))
        else:
            blocks.append(-np.eye(PLANE) / time)
    return block_diag(*blocks)


def pushes_of(force: Disturbance) -> np.ndarray:
    """Intensity of the white noise that moves the disturbance's states.

    One noise moves both numbers of a swell's first pair, in the direction in which the transfer function of
    the first of them has no numerator but s.
    """
    size, time, frequency = (np.asarray(one) for one in (force.size, force.time, force.frequency))
    blocks = []
    for k in range(len(size)):
        if frequency[k]:
            # (s + 1/T) b_1 - w b_2 is s b_1: b_2 = b_1 / (w T).
            way = np.array([1.0, 1.0 / (frequency[k] * time[k])])
            blocks.append(np.pad(size[k] ** 2 * 4.0 / time[k] * np.outer(way, way), (0, 2)))
        else:
            blocks.append(2.0 * size[k] ** 2 / time[k] * np.eye(1 if k < AXES else PLANE))
    return block_diag(*blocks)


def van_loan(force: Disturbance, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Of the disturbance's states after some time, and of their mean over it: by the states before, and new.

    By matrix exponentials of the states beside their integral (Van Loan, 1978).
    """
    rates = rates_of(force)
    n = len(rates)
    along = np.block([[rates, np.zeros((n, n))], [np.eye(n) / dt, np.zeros((n, n))]])
    noise = np.zeros_like(along)
    noise[:n, :n] = pushes_of(force)
    power = expm(dt * np.block([[-along, noise], [np.zeros_like(along), along.T]]))
    goes_on = power[2 * n :, 2 * n :].T
    spread = goes_on @ power[: 2 * n, 2 * n :]
    return goes_on[:, :n], 0.5 * (spread + spread.T)


def dense(every: Windowed, force: Disturbance) -> tuple[np.ndarray, np.ndarray]:
    """All residuals with the derivatives of what they should be, and their covariance.

    State and disturbance are written out as sums of what is new: a start's changes, and its pushes.
    """
    whole = solve_continuous_lyapunov(rates_of(force), -pushes_of(force))
    states = np.arange(len(whole))
    pairs = [np.kron(np.eye(AXES), [[0, 0, 1, 0]])] if force.swells else []
    water = np.eye(PLANE) if force.flows else np.zeros((PLANE, 0))

    def output(level: np.ndarray) -> np.ndarray:
        drift = [level] if force.drifts else []
        return block_diag(np.concatenate([np.eye(AXES), *pairs, *drift], axis=1), water)

    def new(stays: np.ndarray) -> np.ndarray:
        """The root of what is new where so much stays: sizes stay as they are."""
        own = whole - stays @ whole @ stays.T
        return np.linalg.cholesky(own + 1e-14 * np.eye(len(own)))

    count, news = len(every.gap), len(every.gap) * (12 + len(states) * (2 * STEPS + 1))
    at, rows, seen = 0, [], []
    state, wrench = np.zeros((13, news)), np.zeros((len(states), news))
    known, before = np.zeros((13, COLUMNS)), np.zeros((13, COLUMNS))
    for w in range(count):
        window = jax.tree.map(lambda a, w=w: np.asarray(a[w]), every)
        turn = np.linalg.pinv(window.line.begin)
        signs = np.ones((13, 1))
        signs[3:7] = np.where(before[3:7, -1] @ window.start[3:7] < 0, -1.0, 1.0)
        ahead = -signs * before
        ahead[:, -1] += window.start
        if window.joined:
            changes, sure = turn @ (signs * state), turn @ (signs * known + ahead)
        else:
            changes, sure = np.zeros((12, news)), np.zeros((12, COLUMNS))
            changes[:, at : at + 12], sure[:, -1] = np.diag(SPREAD), window.delta
        state, known, at = window.line.begin @ changes, window.line.begin @ sure, at + 12
        stays = left(force, float(np.asarray(force.gap)[w]))
        wrench = stays @ wrench
        wrench[:, at : at + len(states)] += new(stays)
        at += len(states)
        for k in range(STEPS):
            h, f, by = window.line.h[k], window.line.f[k], output(window.line.by_plane[k])
            rows.append(h @ np.concatenate([state, by @ wrench]))
            seen.append(window.line.residual[k] - h[:, :13] @ known)
            goes_on, spread = van_loan(force, float(window.line.dt[k]))
            both = goes_on @ wrench
            both[:, at : at + len(both)] += np.linalg.cholesky(spread + 1e-15 * np.eye(len(both)))
            at += len(both)
            wrench, mean = np.split(both, 2)
            state, known = f @ np.concatenate([state, by @ mean]), f[:, :13] @ known
        before = window.end
    b = np.concatenate(rows)
    return np.concatenate(seen), b @ b.T + np.eye(len(b))


@pytest.mark.parametrize(
    ("share", "off"), [(1e-6, 1e-12), (0.01, 1e-12), (0.3, 1e-12), (1.0, 1e-12), (4.0, 1e-9), (12.0, 1e-3)]
)
def test_a_disturbance_over_a_hold_is_its_integral(share, off):
    """Means and what is new in them, for holds from a hundredth of its memories to many of them."""
    _, force = windows_of([False], [1e6], ALL)
    dt, n = share * float(force.time.min()), force.states
    goes_on, spread = van_loan(force, dt)
    over = force.over(jnp.asarray(dt))
    whole = solve_continuous_lyapunov(rates_of(force), -pushes_of(force))
    np.testing.assert_allclose(force.spread, whole, rtol=1e-12, atol=1e-12)
    level = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
    # So few places of an integral tell no more.
    close = {"rtol": 0, "atol": off}
    np.testing.assert_allclose(over.mean, goes_on[n:], **close)
    np.testing.assert_allclose(over.variance / level, spread[n:, n:] / level, **close)
    np.testing.assert_allclose(over.covariance / level, spread[:n, n:] / level, **close)
    covariances = [[over.variance, over.covariance.T], [over.covariance, over.new]]
    assert np.linalg.eigvalsh(np.block(covariances) / np.tile(level, (2, 2)))[0] > -1e-14
    # The states themselves are what they were.
    after = force.after(jnp.asarray(dt), jnp.eye(n))
    np.testing.assert_allclose(after, left(force, dt), rtol=0, atol=1e-12)
    np.testing.assert_allclose(over.new / level, spread[:n, :n] / level, **close)
    new = force.new(jnp.asarray(dt)) / level
    own = (whole - left(force, dt) @ whole @ left(force, dt).T) / level
    np.testing.assert_allclose(new, own, rtol=0, atol=1e-11)
    # Of many memories their exponential, which also grows, leaves fewer digits.
    np.testing.assert_allclose(new, spread[:n, :n] / level, rtol=0, atol=max(1e-11, 0.01 * off))


def test_a_quarter_of_a_turn_before_is_how_fast_a_swell_falls():
    """By a difference of what comes out of its filters, in units of its frequency."""
    swell, states = Swell(jnp.array(2.5), jnp.array(1.3)), np.array([0.7, -1.1, 0.4, 0.9])
    force = windows_of([False], [1e6], (True, False, False))[1]
    rates = rates_of(dataclasses.replace(force, time=jnp.full(4, 2.5)))[-4:, -4:]
    before, after = ((expm(t * rates) @ states)[2] for t in (-1e-4, 1e-4))
    found = swell.out(jnp.asarray(states))
    assert found[0] == states[2]
    assert found[1] == pytest.approx((before - after) / 2e-4 / 1.3, rel=1e-7)


def test_a_force_in_earth_axes_is_turned_into_those_of_the_craft():
    """By another library's rotations; a force at the origin has no moment."""
    turns = Rotation.from_euler("ZYX", [[2.0, 0.3, -0.4], [-0.7, 0.0, 0.0]])
    axes = 0, 1, 2, 5
    found = _filter.by_plane(axes, jnp.asarray(turns.as_quat(scalar_first=True)))
    for k, force in enumerate([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]):
        np.testing.assert_allclose(found[:, :3, k], turns.apply(force, inverse=True), atol=1e-12)
    assert (np.asarray(found)[:, 3] == 0).all()


def test_a_disturbance_that_forgets_nothing_is_constant_over_a_hold():
    _, force = windows_of([False], [1e6])
    over = dataclasses.replace(force, time=jnp.full(AXES, 1e12)).over(jnp.asarray(0.1))
    np.testing.assert_allclose(over.mean, np.eye(AXES), atol=1e-12)
    assert np.abs(over.variance).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("joined", "gap"),
    [
        ([False], [1e6]),
        ([False, True, True], [1e6, 0.0, 0.0]),
        ([False, True, False, True], [1e6, 0.0, 0.3, 0.0]),
        ([False, False, True], [1e6, 1e6, 0.0]),
    ],
)
def test_the_filter_is_the_dense_gaussian(joined, gap, kind):
    """Windows that go on, begin anew, follow after a gap, and belong to another log."""
    every, force = windows_of(joined, gap, kind)
    information, log_det = joined_up(every, force)
    seen, covariance = dense(every, force)
    np.testing.assert_allclose(information, seen.T @ np.linalg.solve(covariance, seen), rtol=1e-8, atol=1e-8)
    residual = seen[:, -1]
    exact = -2 * multivariate_normal(np.zeros(len(seen)), covariance).logpdf(residual)
    constant = len(seen) * np.log(2 * np.pi)
    assert information[-1, -1] + log_det + constant == pytest.approx(exact, rel=1e-10)


def test_an_attitude_is_the_same_by_a_quaternion_of_either_sign():
    """What is told of the middle one of three windows that go on, by all four numbers with another sign."""
    every, force = windows_of([False, True, True], [1e6, 0.0, 0.0], ALL)
    sign = np.ones((3, 13))
    sign[1, 3:7] = -1.0
    both = np.concatenate([sign, np.ones((3, AXES + PLANE))], axis=1)
    other = eqx.tree_at(
        lambda w: (w.line.f, w.line.h, w.line.begin, w.states, w.end),
        every,
        (
            every.line.f * sign[:, None, :, None] * both[:, None, None],
            every.line.h * both[:, None, None],
            every.line.begin * sign[..., None],
            every.states * sign[:, None],
            every.end * sign[..., None],
        ),
    )
    for mine, its in zip(joined_up(every, force), joined_up(other, force), strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-10, atol=1e-10)


def test_a_disturbance_of_no_size_is_none():
    """What is left is white noise and a free start."""
    every, force = windows_of([False, True], [1e6, 0.0])
    still = dataclasses.replace(force, size=jnp.zeros(AXES))
    information, _ = joined_up(every, still)
    seen, covariance = dense(every, still)
    assert np.linalg.matrix_rank(covariance - np.eye(len(covariance)), tol=1e-9) <= 12
    np.testing.assert_allclose(information, seen.T @ np.linalg.solve(covariance, seen), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_sizes_and_memories_come_back_from_their_logarithms(kind):
    _, force = windows_of([False], [1e6], kind)
    unit = np.array([20.0, 3.0])
    again = with_logarithms(force, jnp.asarray(unit), jnp.asarray(logarithms_of(force, unit)))
    for name in ("size", "time", "frequency"):
        np.testing.assert_allclose(getattr(again, name), getattr(force, name), rtol=1e-12)


@pytest.mark.parametrize("others", [(False, False), (True, False), (False, True), (True, True)])
def test_without_its_swell_a_disturbance_is_one_whose_swell_has_no_size(others):
    """By the likelihood; and what is known of the other logarithms stays with them."""
    every, force = windows_of([False, True, False], [1e6, 0.0, 0.4], (True, *others))
    still = dataclasses.replace(force, size=force.size.at[AXES : 2 * AXES].set(0.0))
    known = np.random.default_rng(0).normal(size=(count_of(force),) * 2)
    path = _filter.Path.measured(3, force.axes)
    model = Model((), np.zeros(0), jnp.zeros((3, 12)), 0.0, beside=Beside(force, path, known))
    calm = _amid.calmed(model).beside
    assert calm.force.kind == (False, *others)
    for mine, its in zip(joined_up(every, calm.force), joined_up(every, still), strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-9, atol=1e-9)
    unit = np.ones(AXES)
    kept = [list(logarithms_of(force, unit)).index(one) for one in logarithms_of(calm.force, unit)]
    np.testing.assert_array_equal(calm.covariance, known[np.ix_(kept, kept)])


# --- along the path of a craft ---------------------------------------------------------------------

KNOWN = np.array([2.0, 1.5, 0.6])  # N, N, N m
MEMORY, LENGTH = 5.0, 240.0  # s


def pushed_boat(size: np.ndarray, craft: Vehicle | None = None) -> Log:
    """A log of the boat by random wrenches, with a Gauss-Markov one on top that it does not hold.

    - `craft`: the boat with what else acts on it.
    """
    craft = boat() if craft is None else craft
    rng, dt, free = np.random.default_rng(5), 0.1, [0, 1, 5]
    samples = round(LENGTH / dt)
    keep, wrench = np.exp(-dt / MEMORY), np.zeros((samples, 6))
    new = size * rng.normal(size=(samples, 3))
    for k in range(samples):
        before = wrench[k - 1, free] if k else 0.0 * size
        wrench[k, free] = keep * before + np.sqrt(1 - keep**2) * new[k] if k else new[k]
    t, given = dt * np.arange(samples), np.zeros((samples, 6))
    given[:, free] = steps(samples, seed=2, hold=40) * [40.0, 20.0, 8.0]
    blank = Log(t, np.full((samples, 18), np.nan), None, given + wrench, (), "log.csv")
    shown = np.asarray(simulate(craft, blank, initial_state(craft)).channels)
    noise = np.repeat([NOISE.get(kind, np.nan) for kind in SENSORS], 3)
    shown = shown + noise * np.random.default_rng(6).normal(size=shown.shape)
    return dataclasses.replace(blank, channels=shown, wrench=given)


def estimated_on(log: Log) -> tuple[Workbench, Model]:
    """The boat's workbench, and its model at the sizes and memories that suit the log."""
    bench = workbench(boat(), (log,), (LinearDamping, QuadraticDamping), None)
    # Two logs, of which a test makes this one, are then seen by the same programs.
    bench = bench._like(room=dataclasses.replace(bench.room, logs=2))
    return bench, bench.likeliest(_amid.disturbed(bench, bench.frozen(bench.start())))


@pytest.fixture(scope="module")
def disturbed() -> tuple[Workbench, Model]:
    return estimated_on(pushed_boat(KNOWN))


def test_sizes_and_memories_are_found(disturbed):
    """Within three standard errors of a variance of 240 s / (2 * 5 s) independent values: 30 % of a size."""
    _, model = disturbed
    force = model.beside.force
    assert np.asarray(force.size) == pytest.approx(KNOWN, rel=0.45)
    assert np.all(np.abs(np.log(np.asarray(force.time) / MEMORY)) < 1.0)


def test_a_curvature_that_is_none_is_not_handed_on(disturbed, monkeypatch):
    """As a line search that fails may leave it; from the one that is handed on a search can begin."""
    bench, model = disturbed
    search = _filter.optimize.minimize

    def failed(*given, **options):
        found = search(*given, **options)
        found.hess_inv = np.diag([-1.0, *np.ones(len(found.x) - 1)])
        return found

    every = bench.lines(model)
    given = bench.spread, every, model.beside.force, bench.fine.unit
    monkeypatch.setattr(_filter.optimize, "minimize", failed)
    _, covariance, _ = _filter.estimated(*given, model.beside.covariance)
    np.testing.assert_array_equal(covariance, model.beside.covariance)
    monkeypatch.undo()
    assert np.linalg.eigvalsh(_filter.estimated(*given, covariance)[1])[0] > 0


@pytest.mark.parametrize("factor", [0.02, 50.0])
def test_sizes_that_are_far_off_are_found_soon(disturbed, monkeypatch, factor):
    """Where they were found from near, in at most 5 looks for each number (by slopes alone in 6 to 10)."""
    bench, model = disturbed
    every = bench.lines(model)
    spread, near = bench.spread, model.beside.force
    looks, sloped = [], _filter._sloped
    monkeypatch.setattr(_filter, "_sloped", lambda *given: looks.append(1) or sloped(*given))
    far = dataclasses.replace(near, size=factor * near.size)
    found, _, worth = _filter.estimated(spread, every, far, bench.fine.unit, unlearned(far), far=True)
    assert len(looks) <= 5 * count_of(near)
    best = _filter.improbability(spread, every, [near], bench.fine.unit)[0]
    assert worth < best + 2 * _filter.ENOUGH
    np.testing.assert_allclose(np.asarray(found.size), np.asarray(near.size), rtol=0.05)


@pytest.mark.parametrize("factor", [0.02, 50.0])
def test_a_model_is_as_likely_from_a_disturbance_that_is_far_off(disturbed, factor):
    """As from near, within half a nat and what is not worth a step more (`_workbench.LIKELIER`)."""
    bench, model = disturbed
    far = dataclasses.replace(model.beside.force, size=factor * model.beside.force.size)
    beside = dataclasses.replace(model.beside, force=far, covariance=unlearned(far))
    again = bench.likeliest(dataclasses.replace(model, beside=beside, cost=np.inf))
    assert again.cost == pytest.approx(model.cost, abs=1.0)


def test_a_size_comes_near_by_what_is_expected_of_it():
    """Of numbers that are seen as they are, one step leads to their root mean square, which is likeliest.

    The maximum of a normal density in its standard deviation, in closed form.
    """
    seen, looks = np.random.default_rng(0).normal(scale=3.0, size=200), []

    def sloped(log_size, memory):
        looks.append(log_size)
        share = seen**2 * np.exp(-2 * log_size)
        return np.sum(share + 2 * log_size), np.array([2 * len(seen) - 2 * share.sum(), 0.0])

    found = _filter._come_near(sloped, np.array([-4.0, 1.0]), np.array([len(seen), 0.0]))
    assert np.exp(found[0]) == pytest.approx(np.sqrt(np.mean(seen**2)), rel=1e-12)
    assert found[1] == 1.0
    assert len(looks) == 2


def test_a_first_state_is_taken_back_to_its_changes():
    """Far from the guess about all axes, where they are not orthogonal: against NumPy's pseudo-inverse."""
    guess, far = initial_state(boat()), 0.3 * jnp.array([1.0, -1.0, 1.0]) / np.sqrt(3)

    def moved(delta):
        state = guess.moved(delta)
        return jnp.concatenate([state.position, state.attitude, state.velocity])

    begin = jax.jacfwd(moved)(jnp.zeros(12).at[3:6].set(far))
    every, _ = windows_of([False], [1e6])
    line = dataclasses.replace(jax.tree.map(lambda a: a[0], every.line), begin=begin)
    np.testing.assert_allclose(np.asarray(line.back), np.linalg.pinv(begin), atol=1e-13)


@pytest.mark.slow
def test_a_wave_that_keeps_in_step_is_likelier_than_the_swell_that_hides_it():
    """By the odds of a name, and its numbers are found; a swell forgets, and a regular wave does not."""
    wave = Waves(north=jnp.array(4.0), east=jnp.array(-3.0), period=jnp.array(4.5), phase=jnp.array(0.8))
    log = pushed_boat(0.2 * KNOWN, boat().place(Placed(wave, None)))
    bench = workbench(boat(), (log,), (Waves,), None)
    model = bench.likeliest(_amid.disturbed(bench, bench.frozen(bench.start())))
    swell = _amid.widened(bench, model, with_swell)
    assert swell.beside.force.swells and swell.cost < model.cost - 50
    (begun,) = _search._in_step(bench, swell)
    found = bench.likeliest(begun, 12, 1e-4, 1)
    assert not found.beside.force.swells
    assert swell.cost - found.cost > _search.prior_nats(bench, found.members[-1]) + np.log(150)
    named = _search.trial_of(swell, found).parameters(bench)
    for name in ("north", "east", "period"):
        assert abs(named[name]) == pytest.approx(abs(float(getattr(wave, name))), rel=0.05)
    assert _search._in_step(bench, model) == []


@pytest.mark.slow
def test_a_late_sensor_is_read_along_all_windows(monkeypatch):
    """As if they were one, also where they are held some at a time; `physics.late` along their paths."""
    bench = workbench(boat(), (pushed_boat(KNOWN),), (SensorDelay,), None)
    model = _amid.disturbed(bench, bench.frozen(bench.start()))
    (late_one,) = [i for i, one in enumerate(bench.layout.suspects) if one.target == "velocity"]
    model = bench.with_member(model, Member(late_one), np.array([0.7]))
    model = dataclasses.replace(model, beside=dataclasses.replace(model.beside, path=bench.fine.path))
    count, (problem, _) = bench.fine.count, bench.along(model)
    windows = bench.fine.problem.windows
    log, step = windows.log[:count, None], windows.step[:count]
    t = bench.fine.problem.records.t[log, step].reshape(-1)
    for held in (640, 200):
        monkeypatch.setattr(_filter, "HELD", held)
        every = bench.lines(model)
        channels = np.zeros((len(t), 12))
        channels[:, 6:] = np.asarray(every.states)[:count, :, 7:].reshape(-1, 6)
        delay = np.zeros((len(t), 4))
        delay[:, LATE.index("velocity")] = 0.7
        shown = np.asarray(late(t, jnp.asarray(channels), jnp.asarray(delay)))
        values, weight = (np.asarray(a)[:count].reshape(-1, 18) for a in (windows.measured, windows.weight))
        for channel in (6, 7):
            row = problem.channels.index(channel)
            off = np.asarray(every.line.residual)[:count, :, row, -1].ravel()
            expected = (shown[:, channel] - values[:, channel]) * weight[:, channel]
            np.testing.assert_allclose(off, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_many_windows_are_held_some_at_a_time(disturbed, monkeypatch):
    """What they say is the same to rounding."""
    bench, model = disturbed
    whole = bench.screen(model)
    monkeypatch.setattr(_filter, "HELD", 200)
    parts = bench.screen(model)
    for name in ("chi2", "g", "h"):
        a, b = getattr(whole, name), getattr(parts, name)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def test_scores_scatter_as_the_likelihood_says(disturbed):
    """Of a file that is exact: their variance is their information, and no suspect saves more than chance."""
    bench, model = disturbed
    stats = bench.screen(model)
    h, count = stats.h.sum(0), len(stats.chi2)
    telling = np.diag(h) > 1e-9 * np.diag(h).max()
    z = stats.g.sum(0)[telling] / np.sqrt(np.diag(h)[telling])
    assert np.abs(z).max() < 4.0
    ratios = count * stats.g.var(axis=0)[telling] / np.diag(h)[telling]
    assert np.median(ratios) == pytest.approx(1.0, abs=0.35)


def test_the_slope_is_that_of_the_likelihood(disturbed):
    """Against central differences of it, along a coefficient of the file, with the path held."""
    bench, model = disturbed
    free = dataclasses.replace(model, frozen=False)
    likely = bench._likelihood(free)
    path, h = model.beside.path, 0.2 * bench.base[0].prior

    def of(step: float):
        z = np.zeros(SLOTS)
        z[0] = step
        group = jnp.asarray(bench.fine.group)
        affine = likely.affine.at(jnp.asarray(z))
        found = _filter.innovations(likely.problem, affine, likely.force, path, group, bench._most_groups)
        return float(found.minus_twice.sum()), float(found.g.sum(0)[0]), float(found.h.sum(0)[0, 0])

    (below, *_), (here, slope, curvature), (above, *_) = of(-h), of(0.0), of(h)
    # The determinant's own slope is left out: in these units it is of order one.
    assert (above - below) / (4 * h * np.sqrt(curvature)) == pytest.approx(
        slope / np.sqrt(curvature), abs=0.3
    )
    assert (above + below - 2 * here) / (2 * h**2) == pytest.approx(curvature, rel=0.1)


def test_many_columns_are_told_as_well_by_a_few_at_a_time(disturbed):
    """Mixtures of all suspects' at once against seven at a time, which leaves some room in the last part."""
    bench, model = disturbed
    problem, own = bench.problem(model.members, bench.fine.problem), bench._every_column(model)
    rng = np.random.default_rng(0)
    mixed, acts = rng.normal(size=(own.acts.shape[1], 16)), rng.uniform(0.5, 1.0, (len(own.acts), 16))
    every = Affine(own.theta, own.columns @ mixed, jnp.asarray(acts))
    rest = model.beside.force, model.beside.path, jnp.asarray(bench.fine.group), bench._most_groups
    whole = _filter.innovations(problem, every, *rest)
    parts = _filter.innovations(problem, every, *rest, width=7)
    # In standard errors, of which rounding leaves some 1e-10.
    size = np.sqrt(np.diag(whole.h.sum(0)))
    assert (size > 0).all()
    np.testing.assert_allclose(parts.minus_twice, whole.minus_twice, rtol=1e-9)
    units = {"g": size[None], "h": np.outer(size, size)[None]}
    for name, unit in units.items():
        ours, theirs = (np.asarray(getattr(one, name)) / unit for one in (parts, whole))
        np.testing.assert_allclose(ours, theirs, atol=1e-7)
    np.testing.assert_allclose(parts.path.delta, whole.path.delta, atol=1e-9)


def test_a_wrench_is_held_from_each_sample_and_shows_there_at_once():
    """Sample by sample by hand, on random systems; accelerations show what acts at their own sample."""
    every, _ = windows_of([False, True], [1e6, 0.0])
    wrench = np.random.default_rng(0).normal(size=(STEPS, AXES, 3))
    for window in (jax.tree.map(lambda a, i=i: np.asarray(a[i]), every) for i in range(2)):
        by_residual, by_end = window.held(jnp.asarray(wrench))
        state = np.zeros((13, 3))
        for k in range(STEPS):
            pushed = np.concatenate([state, wrench[k]])
            shown, moved = window.line.h[k][:, : 13 + AXES], window.line.f[k][:, : 13 + AXES]
            np.testing.assert_allclose(by_residual[k], shown @ pushed, atol=1e-12)
            state = moved @ pushed
        np.testing.assert_allclose(by_end, state, atol=1e-12)


def test_wrenches_of_given_shapes_are_summed_over_all_windows(disturbed):
    """Against logs in which they act: by differences of the likelihood, which is a parabola of their sizes.

    One of them lasts for many windows, as what disturbs the boat does.
    """
    bench, model = disturbed
    t, (log,) = bench.expected(model).t, bench.data.logs
    shapes = np.zeros((*t.shape, 6, 2))
    shapes[..., 0, 0], shapes[..., 5, 1] = np.sin(2 * np.pi * t / 80.0), np.cos(2 * np.pi * t / 7.0)
    g, h = _knots.with_shapes(bench, model, shapes)
    step = np.asarray(bench.data.windows.step)

    def minus_twice(sizes: np.ndarray) -> float:
        wrench = log.wrench.copy()
        wrench[step] += shapes @ sizes
        return float(bench.on((dataclasses.replace(log, wrench=wrench),)).screen(model).chi2.sum())

    here = minus_twice(np.zeros(2))
    for i, size in enumerate(1.0 / np.sqrt(np.diag(h)[-2:])):
        above, below = (minus_twice(sign * size * np.eye(2)[i]) for sign in (1.0, -1.0))
        assert (above + below - 2 * here) / (2 * size**2) == pytest.approx(h[i - 2, i - 2], rel=0.02)
        # The slope in standard errors, without that of the determinant along the moved path.
        assert (above - below) / 4 == pytest.approx(g[i - 2] * size, abs=0.1)
    # What lasts is told more than four times too well window by window: as if each began with another one.
    every = t.shape[1] // bench.knots
    apart, lasts = _knots.at_knots(bench, model), shapes[:, every // 2 :: every, :, 0].reshape(len(t), -1)
    of_windows = apart.h[:, -6 * bench.knots :, -6 * bench.knots :]
    assert 4 * h[-2, -2] < np.einsum("wi,wij,wj->", lasts, of_windows, lasts)


def test_a_knot_has_the_wrench_that_was_commanded_there(disturbed):
    bench, _ = disturbed
    (log,) = bench.data.logs
    commanded = log.wrench[samples_at(bench.cut, bench.knots)] * bench.vehicle.free
    np.testing.assert_allclose(bench.places.driven, commanded, atol=1e-12)
    assert np.ptp(commanded) > 1.0


def test_what_acts_is_given_where_the_craft_is_expected_in_each_hold(disturbed):
    """Against simulations from where three parts begin, by what is commanded and expected to push."""
    bench, model = disturbed
    (log,), given = bench.data.logs, _knots.knots(bench, model).given
    step, parts = np.asarray(bench.fine.problem.windows.step), bench.fine.parts
    names = ("x", "y", "psi", "u", "v", "r")
    states = np.stack([given.signals[name] for name in names], -1).reshape(bench.fine.count, -1, len(names))
    for part in (0, 3, 5 * parts + 2):
        rows = step[part]
        x, y, psi, u, v, r = states[part, 0].tolist()
        start = initial_state(bench.vehicle, (x, y, 0.0), (0.0, 0.0, psi), (u, v, 0.0, 0.0, 0.0, r))
        push = np.zeros((len(rows), 6))
        push[:, np.array(model.beside.force.axes)] = model.beside.path.push[part, :-PLANE]
        piece = dataclasses.replace(
            log, t=log.t[rows], channels=log.channels[rows], wrench=log.wrench[rows] + push
        )
        run = simulate(bench.vehicle, piece, start).states
        there = np.column_stack([run.position[:, :2], run.velocity[:, [0, 1, 5]]])
        np.testing.assert_allclose(states[part][:, [0, 1, 3, 4, 5]], there, atol=1e-6)
        np.testing.assert_array_equal(given.t.reshape(bench.fine.count, -1)[part], log.t[rows])


def test_a_disturbance_is_estimated_again_where_a_wrench_acts(disturbed):
    """As that of the log in which the wrench does not act, which had stood in for it."""
    bench, model = disturbed
    (log,), t = bench.data.logs, bench.expected(model).t
    step = np.asarray(bench.data.windows.step)
    acts, without = np.zeros((*t.shape, 6)), log.wrench.copy()
    acts[..., 0] = 6.0 * np.sin(2 * np.pi * t / 80.0)
    without[step] -= acts
    on = bench.on((dataclasses.replace(log, wrench=without),))
    spoilt = on.likeliest(dataclasses.replace(model, cost=np.inf))
    again, lost = _knots.beside_wrench(on, spoilt, np.zeros(len(spoilt.z)), acts)
    assert float(spoilt.beside.force.size[0]) > 1.5 * float(model.beside.force.size[0])
    assert np.asarray(again.beside.force.size) == pytest.approx(np.asarray(model.beside.force.size), rel=0.1)
    # Without the wrench the log asks for the larger one.
    assert lost > 3.0


def test_a_path_that_runs_away_is_no_step(disturbed):
    """A measured log led to a path at 1e119 with a likelihood of exp(4e99), both of them finite."""
    bench, model = disturbed
    likely = bench._likelihood(model)
    z, path, solver = jnp.zeros(SLOTS), model.beside.path, _filter.FilterGaussNewton()
    found = _filter._improbable((z, path), likely)[1]
    far = eqx.tree_at(lambda f: f.path.delta, found, found.path.delta.at[3, 11].set(1e50))
    assert solver.usable(found) and not solver.usable(far)


@pytest.mark.parametrize("begins", [0.0, 0.5])
def test_slopes_promise_by_chance_what_as_many_numbers_save(begins):
    """Against steps from slopes drawn as those of a model that is right: by their information."""
    rng = np.random.default_rng(0)
    root, z = rng.normal(size=(5, 5)), jnp.full(5, begins)
    h, precision = root @ root.T, np.array([0.0, 0.1, 1.0, 10.0, 1e12])
    path, solver = _filter.Path.measured(2, (0,)), _filter.FilterGaussNewton()

    def promised(slopes: np.ndarray) -> float:
        g = slopes - precision * begins
        found = _filter.Innovations(jnp.zeros(2), jnp.array([g, 0 * g]), jnp.asarray(h[None]), path)
        at_once = float(_filter.saved_at_once(z, found, jnp.asarray(precision)))
        _, moved = solver.moved((z, path), found, jnp.asarray(precision), jnp.zeros(()))
        assert at_once == pytest.approx(2 * float(moved), rel=1e-6)
        return at_once

    each = np.array([promised(root @ rng.normal(size=5)) for _ in range(1000)])
    found = _filter.Innovations(jnp.zeros(2), jnp.zeros((2, 5)), jnp.asarray(h[None]), path)
    chance = float(_filter.saved_by_chance(found, jnp.asarray(precision)))
    # Two standard deviations of a chi-square leave one in twenty; a prior makes it a bit narrower.
    assert each.mean() + 1.8 * each.std() < chance < each.mean() + 2.6 * each.std()
    assert 0.93 < (each < chance).mean() < 0.99


@pytest.mark.parametrize(("times", "ends"), [(0.5, True), (20.0, False)])
def test_a_step_that_failed_and_promised_no_more_than_chance_is_the_last(times, ends):
    """Of slopes that point uphill: from the optimum every step fails, whatever it promises."""
    solver, path = _filter.FilterGaussNewton(), _filter.Path.measured(1, (0,))
    # Of three numbers.
    chance = 3.0 + 2.0 * np.sqrt(6.0)
    g = np.zeros(3)
    g[0] = np.sqrt(times * chance)
    tried: list[float] = []

    def of(y):
        z, path = y
        tried.append(float(z[0]))
        found = _filter.Innovations(jnp.zeros(1), jnp.asarray(g[None]), jnp.eye(3)[None], path)
        return 0.5 * (z @ z), found

    how = {"limit": 7, "share": 1e-6, "samples": 100.0, "damping": 1e-4}
    options = {name: jnp.asarray(value) for name, value in how.items()}
    y, _, stats = minimise_outside(of, solver, (jnp.zeros(3), path), jnp.zeros(3), options)
    assert not y[0].any() and float(stats["cost"]) == 0.0
    # However short steps have become, what slopes promise at once is more.
    assert len(tried) == (2 if ends else 7)


@pytest.mark.parametrize(("minus_twice", "worth"), [(50.0, 0.01), (1500.0, 0.15), (11600.0, 100.0)])
def test_a_step_is_worth_more_where_no_weather_explains_what_is_missed(minus_twice, worth):
    """Of a hundred samples: up to 16 each may be weather, of what is beyond a hundredth decides nothing."""
    assert float(_filter.worth_a_step(1e-4, 100, minus_twice)) == pytest.approx(worth)


def test_a_log_with_a_gap_is_two_logs(disturbed):
    """Sixty seconds are twenty memories: what is known of the disturbance behind them is nothing."""
    bench, _ = disturbed
    (log,), samples = bench.data.logs, round(bench.data.length / 0.1)
    first = 20 * samples

    def rows(kept: np.ndarray) -> Log:
        return dataclasses.replace(log, t=log.t[kept], channels=log.channels[kept], wrench=log.wrench[kept])

    before, after = np.arange(first), np.arange(first + 600, len(log.t))

    def screened(logs: tuple[Log, ...]):
        on = bench.on(logs)
        model = on.refine(_amid.disturbed(on, on.frozen(on.start())))
        # What a window without a next one does over a gap is of no use, and may grow beyond all bounds.
        assert np.asarray(on.lines(model).line.dt).max() == pytest.approx(0.1)
        return on.screen(model)

    one, two = screened((rows(np.r_[before, after]),)), screened((rows(before), rows(after)))
    for name in ("chi2", "g", "h"):
        ours, theirs = np.asarray(getattr(one, name)), np.asarray(getattr(two, name))
        # The first windows begin where samples were smoothed, without those on the other side of the gap: a
        # twentieth of a nat.
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=0.05)


@pytest.mark.slow
def test_the_score_of_a_log_is_its_likelihood_per_number(disturbed):
    """That of the screening where the log is the training's own; weather counts for nothing, damping does."""
    bench, model = disturbed
    again, own = bench.on(bench.data.logs), bench.screen(model).chi2.sum() / bench.samples
    # Starts are followed from the samples anew: paths differ by less than a thousandth of a number's noise.
    assert log_score(again, model) == pytest.approx(-0.5 * (own + np.log(2 * np.pi)), abs=1e-3)
    beside = model.beside
    force = dataclasses.replace(beside.force, size=3 * beside.force.size)
    larger = dataclasses.replace(model, beside=dataclasses.replace(beside, force=force))
    assert log_score(again, larger) == pytest.approx(log_score(again, model), abs=1e-3)
    place = next(i for i, c in enumerate(bench.base) if c.kind == "damping.linear" and c.place == (0, 0))
    braked = dataclasses.replace(model, z=model.z + 20.0 * (np.arange(len(model.z)) == place))
    assert log_score(again, braked) < log_score(again, model) - 0.01


def fewer(bench: Workbench) -> tuple[Workbench, Workbench]:
    """A workbench of half of its log with room for one log more, and one without: one test log of two."""
    (log,), half = bench.data.logs, len(bench.data.logs[0].t) // 2
    first, second = (
        dataclasses.replace(log, t=log.t[part], channels=log.channels[part], wrench=log.wrench[part])
        for part in (slice(half), slice(half, None))
    )
    return bench.on((first, second)).on((first,)), bench.on((first,))


def test_there_may_be_room_for_more_logs_than_there_are(disturbed):
    """What acts at each sample is told of all logs that there is room for, or no program takes it."""
    benches = fewer(disturbed[0])
    roomy, alone = (one.problem((), one.fine.problem).records for one in benches)
    assert roomy.segment.shape == roomy.t.shape and len(roomy.t) == 2
    samples = len(benches[0].data.logs[0].t)
    np.testing.assert_array_equal(roomy.segment[0, :samples], alone.segment[0, :samples])


@pytest.mark.slow
def test_fewer_logs_are_scored_with_the_programs_of_more(disturbed):
    roomy, alone = fewer(disturbed[0])
    assert log_score(roomy, disturbed[1]) == pytest.approx(log_score(alone, disturbed[1]), abs=1e-9)


def test_what_is_whitened_is_white_noise_of_size_one(disturbed):
    """Its mean square within four standard errors, and nothing before tells of it; without memory it does."""
    bench, model = disturbed
    white = whiten(bench, model)
    seen = white[np.isfinite(white)]
    assert len(seen) == bench.samples
    assert np.mean(seen**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(seen)))
    assert remembered(bench, model) is None
    beside = model.beside
    small = dataclasses.replace(beside.force, size=0.1 * beside.force.size)
    lacking = dataclasses.replace(model, beside=dataclasses.replace(beside, force=small))
    found = remembered(bench, lacking)
    assert found is not None and found.on is None and found.channel in ("u", "v", "r", "x", "y", "psi")


def seen(pushes: np.ndarray, **acting: np.ndarray) -> Log:
    """A log of the boat under pushes ahead, abeam and round [N, N, N m], and what acts on it besides."""
    t, given = 0.1 * np.arange(len(pushes)), np.zeros((len(pushes), 6))
    given[:, [0, 1, 5]] = pushes
    blank = Log(t, np.full((len(t), 18), np.nan), None, given, (), "log.csv")
    shown = np.asarray(simulate(boat(), blank, initial_state(boat()), **acting).channels)
    noise = np.repeat([NOISE.get(kind, np.nan) for kind in SENSORS], 3)
    return dataclasses.replace(
        blank, channels=shown + noise * np.random.default_rng(8).normal(size=shown.shape)
    )


def in_water(water: np.ndarray) -> Log:
    """A log of the boat in water that moves so [m/s]."""
    return seen(steps(len(water), seed=2, hold=40) * [40.0, 20.0, 8.0], water=water)


SIZE, LASTS = 0.15, 20.0  # m/s, s


def wandering() -> np.ndarray:
    wanders = RandomWrench(np.zeros(6), np.ones(6), current=SIZE, current_memory=LASTS)
    return wanders.draw_current(0.1 * np.arange(round(LENGTH / 0.1)), 3)


def drifted(force: np.ndarray) -> Log:
    """A log of the boat, which turns all the while, under a force to the north and to the east [N]."""
    return seen(steps(len(force), seed=2, hold=40) * [40.0, 20.0, 4.0] + [0.0, 0.0, 6.0], drift=force)


@pytest.mark.slow
def test_a_force_that_keeps_its_direction_is_told_from_one_that_turns_with_the_hull():
    """Size and memory within three standard errors; a steady one is left to its name."""
    size, lasts, zero = 4.0, 12.0, np.zeros(6)
    t = 0.1 * np.arange(round(LENGTH / 0.1))
    force = RandomWrench(zero, zero, drift=size, drift_memory=lasts).draw_drift(t, 3)
    bench, pushed = estimated_on(drifted(force))
    amid = _amid.widened(bench, pushed, with_drift)
    found = amid.beside.force
    # Of 2 * 240 s / (2 * 12 s) independent values: 16 % of a size.
    assert found.drifts and amid.cost < pushed.cost - 50
    assert float(found.size[-1]) == pytest.approx(size, rel=0.5)
    assert abs(np.log(float(found.time[-1]) / lasts)) < 1.2
    # What turns with the hull gives way.
    assert np.all(np.asarray(found.size[:2]) < 0.5 * np.asarray(pushed.beside.force.size[:2]))
    steady = np.tile([4.0, -2.0, 0.0], (len(t), 1))
    bench = workbench(boat(), (drifted(steady),), (LinearDamping, QuadraticDamping, WindPush), None)
    model = bench.likeliest(_amid.disturbed(bench, bench.frozen(bench.start())))
    assert not amid_more(bench, model).beside.force.drifts
    assert amid_more(bench, model, steady=False).beside.force.drifts


@pytest.mark.slow
def test_a_current_is_told_from_wrenches():
    """Its size and memory within three standard errors, and where the water went; wrenches hardly stay."""
    water = wandering()
    bench, pushed = estimated_on(in_water(water))
    model = _amid.widened(bench, pushed, with_current)
    force = model.beside.force
    # Hundreds of nats: what it does turns with the boat.
    assert force.flows and model.cost < pushed.cost - 100
    # Of 2 * 240 s / (2 * 20 s) independent values: 30 % of a size, and more of a memory.
    assert float(force.size[-1]) == pytest.approx(SIZE, rel=0.9)
    assert abs(np.log(float(force.time[-1]) / LASTS)) < 1.5
    assert np.all(np.asarray(force.size[:3]) < 0.5 * np.asarray(pushed.beside.force.size))
    middle = np.asarray(bench.fine.problem.windows.step)[: bench.fine.count].mean(axis=1)
    expected = np.asarray(model.beside.path.push)[: bench.fine.count, -PLANE:]
    went = water[middle.astype(int), :2]
    later = slice(20, None)  # ten seconds after which something is known
    assert np.sqrt(((expected - went)[later] ** 2).mean()) < 0.5 * went[later].std()


CURRENT = (False, False, True)


@pytest.mark.slow
def test_a_current_is_taken_alone_and_a_steady_one_is_left_to_its_name():
    """Beside the one that wanders no swell pays for its numbers."""
    catalogue = (LinearDamping, QuadraticDamping, SteadyCurrent)
    for water, kind in ((wandering(), CURRENT), (np.tile([0.2, -0.1, 0.0], (2400, 1)), PLAIN)):
        bench = workbench(boat(), (in_water(water),), catalogue, None)
        model = bench.likeliest(_amid.disturbed(bench, bench.frozen(bench.start())))
        assert amid_more(bench, model).beside.force.kind == kind
        # Where a search has not named it, it disturbs all the same.
        assert amid_more(bench, model, steady=False).beside.force.kind == CURRENT


@pytest.mark.slow
def test_where_nothing_disturbs_sizes_go_to_zero():
    """To less than a tenth of what shows in the noise."""
    bench, model = estimated_on(pushed_boat(np.zeros(3)))
    assert np.all(np.asarray(model.beside.force.size) < 0.15 * KNOWN)
    # And the likelihood is that of white noise: a coefficient is told as exactly.
    white, beside = (bench.screen(one) for one in (bench.undisturbed(model), model))
    own = bench.own(0)[:, 0]
    assert own @ beside.h.sum(0) @ own == pytest.approx(own @ white.h.sum(0) @ own, rel=0.3)


@pytest.mark.parametrize("axes", [(0,), (0, 1, 5)])
@pytest.mark.parametrize("order", [*map(", ".join, itertools.permutations(["swell", "drift", "current"]))])
def test_what_is_known_stays_beside_a_wider_disturbance(axes, order):
    """The wrench on the craft and its covariance with all else are as before, but for what is new."""
    n, rng, nothing = len(axes), np.random.default_rng(3), jnp.zeros(1)
    level = jnp.asarray(rng.uniform(1.0, 2.0, n))
    narrow = Disturbance(level, 3.0 * jnp.ones(n), jnp.zeros(n), nothing, nothing > 0, axes)

    def swelling(force: Disturbance) -> Disturbance:
        more = jnp.arange(1.0, n + 1), jnp.full(n, 10.0), jnp.ones(n)
        parts = zip((force.size, force.time, force.frequency), more, strict=True)
        own = [jnp.concatenate([one[:n], new, one[n:]]) for one, new in parts]
        return dataclasses.replace(force, size=own[0], time=own[1], frequency=own[2])

    states = 13 + narrow.states
    root = rng.normal(size=(states, states))
    message = _filter.Message(
        *map(jnp.asarray, (rng.normal(size=(states, 4)), root @ root.T, rng.normal(size=(13, 4))))
    )
    now = narrow
    for name in order.split(", "):
        wider = {"swell": swelling, "drift": lambda one: drifting(one, 3.0), "current": flowing}[name](now)
        message, now = message.widened(now, wider), wider
    assert now.kind == ALL
    heading = jnp.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])
    level = _filter.by_plane(axes, heading)

    def pushed(force, message):
        by = np.asarray(block_diag(np.eye(13), force.output(level)))
        return by @ message.mean, by @ message.covariance @ by.T

    swell, drift = np.arange(1.0, n + 1) ** 2, 3.0**2 * np.asarray(level @ level.T)
    new = block_diag(np.zeros((13, 13)), np.diag(swell) + drift, USUAL_FLOW.median**2 * np.eye(PLANE))
    first = _filter.Message(message.mean[:states], jnp.asarray(root @ root.T), message.end)
    mean, covariance = pushed(now, message)
    before = pushed(narrow, dataclasses.replace(first, mean=message.mean[:states]))
    np.testing.assert_allclose(mean, before[0])
    np.testing.assert_allclose(covariance, before[1] + new)
    # The second of each of two pairs is a little larger than the first: it turns by 1 rad/s for 10 s.
    sizes = 2 * (2 + 2 / 10.0**2) * swell.sum() + PLANE * (3.0**2 + USUAL_FLOW.median**2)
    assert np.trace(message.covariance) == pytest.approx(np.trace(root @ root.T) + sizes)
