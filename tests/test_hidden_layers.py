"""Networks of many weights inside the physics: trained by gradients, with error bars of their last layer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from jaxmarine._types import CHANNELS
from jaxmarine.effects import Motion, WrenchEffect
from jaxmarine.examples import hidden
from jaxmarine.fitting._estimate import Estimate, units
from jaxmarine.fitting._free import set_free
from jaxmarine.fitting._hidden import Unknowns, by_samples, by_windows, hidden_layers
from jaxmarine.networks import learned_wrench
from tests.crafts import packaged


class Force(WrenchEffect):
    """X = f(u / 0.25) - f(0) [N] of an Equinox network f, in surge."""

    name = "network"
    units = {}

    arrays: eqx.Module
    frame: eqx.Module = eqx.field(static=True)

    @classmethod
    def neutral(cls, craft):
        raise NotImplementedError

    @classmethod
    def suspects(cls, craft):
        return ()

    def force(self, u):
        f = eqx.combine(self.arrays, self.frame)
        return (f(u / 0.25) - f(jnp.zeros(1)))[0]

    def __call__(self, motion: Motion):
        return jnp.zeros(6).at[0].set(self.force(motion.nu_r[:1]))


def with_network(craft, width, depth=2):
    net = eqx.nn.MLP(1, 1, width, depth, activation=jnp.tanh, key=jax.random.key(0))
    return craft.place(jm.Placed(Force(*eqx.partition(net, eqx.is_array))))


def with_all(vehicle):
    return vehicle.placed[0].effect.arrays, vehicle.added_mass, vehicle.damping.linear


def prior_of(vehicle, *stds):
    return tuple(
        jax.tree.map(lambda x, s=std: jnp.full_like(x, s), part)
        for part, std in zip(with_all(vehicle), stds, strict=True)
    )


SHIP = packaged("cybership2")
HEAVY = eqx.tree_at(lambda v: v.added_mass, SHIP, replace_fn=lambda m: m.at[0, 0].add(6.0))  # [kg]


MASS = float(SHIP.mass_matrix[0, 0])
WIDTH = 0.7  # of the prior of each weight


def only(vehicle):
    return vehicle.placed[0].effect.arrays.layers


SMALL = with_network(SHIP, 3, depth=1)


def small_prior():
    """Of its layers; the last bias has no force."""
    prior = jax.tree.map(lambda a: jnp.full_like(a, WIDTH), only(SMALL))
    return eqx.tree_at(lambda p: p[-1].bias, prior, jnp.zeros(1))


@pytest.fixture(scope="module")
def tank():
    """A log of surge between -0.3 and 0.3 m/s whose forces are given [N]; the same as features see it.

    Beside the file's damping a force of 0.3 tanh(u / 0.2) brakes, and noise.
    """
    rng, t = np.random.default_rng(2), np.arange(0.0, 60.0, 0.2)
    channels = np.zeros((len(t), len(CHANNELS)))
    channels[:, 0] = 0.4 * (1 - np.cos(0.5 * t)) + 0.1 / 1.3 * (1 - np.cos(1.3 * t))
    channels[:, 6] = u = 0.2 * np.sin(0.5 * t) + 0.1 * np.sin(1.3 * t)
    channels[:, 12] = 0.1 * np.cos(0.5 * t) + 0.13 * np.cos(1.3 * t) + 0.02 * rng.normal(size=len(t))
    drag = float(SHIP.damping.linear[0, 0]) * u + float(SHIP.damping.quadratic[0, 0]) * np.abs(u) * u
    force = MASS * channels[:, 12] + 0.3 * np.tanh(u / 0.2) + 0.2 * rng.normal(size=len(t))
    wrench = np.zeros((len(t), 6))
    wrench[:, 0] = force + drag
    return jm.Log(t, channels, None, wrench, (), "tank"), u, channels[:, 12], force


@pytest.fixture(scope="module")
def fit(tank):
    """A small network, by gradients."""
    return jm.fit(SMALL, tank[0], only, loss="one_step", solver="gradients", prior=small_prior())


def test_what_comes_before_the_last_layer_is_hidden():
    net = with_network(SHIP, 4)
    found = hidden_layers(net, with_all, prior_of(net, 2.0, 10.0, 1.0))
    assert found.count == (4 + 4) + (16 + 4)
    assert all((width == 2.0).all() for width in found.width)
    # Numbered arrays likewise; a number as prior is relative, and 1 is the size of what is zero.
    term = learned_wrench("surge", ("u",), (), np.array([-1.0]), np.array([1.0]), 1.0, jax.random.key(0), 5)
    placed = SHIP.place(jm.Placed(term, "surge"))
    own = hidden_layers(placed, lambda v: v.placed[0].effect.network, 0.5)
    first = placed.placed[0].effect.weight_1
    assert own.count == first.size + 5
    np.testing.assert_allclose(own.width[0], 0.5 * np.abs(first))
    assert hidden_layers(SHIP, lambda v: v.damping.linear, None).count == 0
    assert hidden_layers(net, lambda v: v.placed[0].effect.arrays.layers[0].weight, None).count == 0


def training_of(log, loss, small):
    """A loss, a point, a direction and a batch; of the small network, or of another with mass and damping."""
    start, free = (SMALL, only) if small else (with_network(HEAVY, 3), with_all)
    options = {"prior": small_prior() if small else prior_of(start, 1.0, 10.0, 1.0), "entries": "diagonal"}
    layers = hidden_layers(start, free, options["prior"])
    freed, scales = set_free(start, free, **options, without=layers.places)
    z_units, noise = units(freed, scales), start.stated_noise
    nothing = np.zeros(len(z_units.precision))
    raw, own, z = np.asarray(freed.start), np.ones(len(noise)), len(nothing)
    none = [np.zeros(shape) for shape in ((0, z), (0, z, z), (z, z))]
    near = Estimate(nothing, raw, *none, 0.0, 0.0, 0, True, "", own, own)
    if loss == "one_step":
        training = by_samples(layers, freed, z_units, [log], noise, near)
    else:
        training = by_windows(layers, freed, z_units, [log], noise, 4.0, False, near)
    rng = np.random.default_rng(0)

    def drawn(size):
        return Unknowns(
            jnp.asarray(size * rng.normal(size=len(nothing))),
            tuple(jnp.asarray(size * rng.normal(size=a.shape)) for a in training.start),
        )

    return training, drawn(0.1), drawn(1.0), jnp.asarray([0, 3, 5, 3])


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "small"), [("one_step", True), ("trajectory", False)])
def test_reverse_gradients_are_those_of_differences(tank, loss, small):
    training, at, way, batch = training_of(tank[0], loss, small)
    both = eqx.filter_jit(lambda training, x: jax.value_and_grad(lambda x: training(x, batch))(x))
    reverse = both(training, at)[1]
    assert all(float(jnp.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(reverse))
    slope = sum(jax.tree.leaves(jax.tree.map(lambda a, b: (a * b).sum(), reverse, way)))
    after, before = (
        both(training, jax.tree.map(lambda x, y, h=h: x + h * y, at, way))[0] for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(slope, (after - before) / 2e-5, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["one_step", "trajectory"])
def test_reverse_gradients_are_those_of_forward_mode(tank, loss):
    training, at, way, batch = training_of(tank[0], loss, small=False)

    @eqx.filter_jit
    def both(training, at, way):
        def of(x):
            return training(x, batch)

        return jax.grad(of)(at), jax.jvp(of, (at,), (way,))[1]

    reverse, forward = both(training, at, way)
    slope = sum(jax.tree.leaves(jax.tree.map(lambda a, b: (a * b).sum(), reverse, way)))
    np.testing.assert_allclose(slope, forward, rtol=1e-9)


def test_the_error_bars_of_a_last_layer_are_those_of_ridge_regression(fit, tank):
    """X = sum_j w_j (h_j(u) - h_j(0)) with weights of prior width s: cov = (H'H / sigma² + 1 / s²)^-1."""
    _, u, acceleration, force = tank
    before, after = (only(v) for v in (fit.start, fit.vehicle))
    first = after[0]
    assert float(jnp.abs(first.weight - before[0].weight).max()) > 1e-3
    assert fit.converged and "hidden layers trained by" in fit.result
    assert [p.name for p in fit.parameters] == [
        f"placed[0].effect.arrays.layers[1].weight[0,{k}]" for k in range(3)
    ]

    def nodes(u):
        return np.tanh(np.asarray(first.weight)[:, 0] * u[:, None] / 0.25 + np.asarray(first.bias))

    features = (nodes(u) - nodes(np.zeros(1))) / MASS
    right, anchor = acceleration - force / MASS, np.asarray(before[1].weight)[0]

    def ridge(sigma):
        information = features.T @ features / sigma**2 + np.eye(3) / WIDTH**2
        right_side = features.T @ right / sigma**2 + anchor / WIDTH**2
        return np.linalg.solve(information, right_side), np.linalg.inv(information)

    # First weighed by how much the acceleration changes, then by what that leaves.
    rest = right - features @ ridge(acceleration.std())[0]
    values, covariance = ridge(np.sqrt((rest**2).mean()))
    np.testing.assert_allclose([p.value for p in fit.parameters], values, rtol=1e-4)
    np.testing.assert_allclose(fit.uncertainty.covariance_model, covariance, rtol=1e-4)
    root = fit.posterior.root
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-4)


def test_a_band_is_wider_where_the_network_has_seen_nothing(fit):
    drawn = fit.draw(200, jax.random.key(1))
    values = np.array([only(v)[1].weight[0] for v in drawn])
    # Of 200 draws a standard deviation is known to a twentieth.
    np.testing.assert_allclose(values.std(axis=0), [p.std_model for p in fit.parameters], rtol=0.15)
    # Simulated: full ahead leaves the speeds of the log, which end at 0.3 m/s.
    t = np.arange(0.0, 20.0, 0.2)
    channels, spread = np.full((len(t), len(CHANNELS)), np.nan), []
    for thrust in (0.05, 1.0):
        commands = np.tile([thrust, thrust, 0.0], (len(t), 1))
        log = jm.Log(t, channels, commands, None, SHIP.thruster_names, "ahead")
        tracks = [np.asarray(jm.simulate(v, log, jm.initial_state(v))["u"]) for v in drawn[:10]]
        spread.append((np.mean(tracks, axis=0)[-1], np.std(tracks, axis=0)[-1]))
    (slow, narrow), (fast, wide) = spread
    assert slow < 0.3 < 0.5 < fast
    assert wide > 2 * narrow


@pytest.mark.parametrize(
    ("solver", "said"), [("newton", "but is 'newton'"), ("gradients", "beside the last one")]
)
def test_what_no_training_can_be_is_said(unchecked, tank, solver, said):
    with pytest.raises(ValueError, match=said):
        jm.fit(SHIP, tank[0], lambda v: v.damping.linear, solver=solver)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["one_step", "trajectory"])
def test_a_network_of_many_weights_is_trained_with_mass_and_damping(loss):
    """650 weights beside a mass that is wrong by 6 kg: gradients by themselves, within the errors told."""
    train, _ = hidden(SHIP, "quadratic_damping", "surge", {"value": 8.0}, duration=(60.0, 5.0), dt=0.2)
    start = with_network(HEAVY, 24)
    prior = prior_of(start, 1.0, 10.0, 1.0)
    found = jm.fit(start, train, with_all, loss=loss, prior=prior, entries="diagonal")
    assert found.converged and "hidden layers trained by" in found.result
    assert not any("layers[0]" in p.name or "layers[1]" in p.name for p in found.parameters)
    mass = found["added_mass[surge]"]
    assert mass.start == pytest.approx(8.0)
    assert mass.value == pytest.approx(2.0, abs=3 * mass.std_model)

    def braking(vehicle, u):
        more = float((vehicle.damping.linear - SHIP.damping.linear)[0, 0])
        return float(vehicle.placed[0].effect.force(jnp.array([u]))) - more * u

    drawn = found.draw(50, jax.random.key(0))
    assert all(np.linalg.eigvalsh(np.asarray(v.mass_matrix)).min() > 0 for v in drawn)
    for u in (-0.2, -0.1, 0.1, 0.2):  # where the log went
        std = np.std([braking(v, u) for v in drawn])
        assert braking(found.vehicle, u) == pytest.approx(-8.0 * u * abs(u), abs=3 * std)
