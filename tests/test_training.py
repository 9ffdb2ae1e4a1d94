"""The ways to train of appendix A, on problems whose answer linear algebra has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.thesis import training

RNG = np.random.default_rng(3)
X = RNG.normal(size=(40, 4)) * [1.0, 0.5, 2.0, 1.0]
Y = X @ [1.0, -2.0, 0.0, 0.5] + 0.3 * RNG.normal(size=40)
DATA = jnp.asarray(X), jnp.asarray(Y)
HESSIAN, PULL = X.T @ X / 40, X.T @ Y / 40  # of half the mean square
START = jnp.array([0.5, 0.5, -0.5, 0.1])
DECAY = 0.05


def miss(w, samples):
    return samples[0] @ w - samples[1]


@pytest.mark.parametrize("train", [training.newton, training.marquardt])
@pytest.mark.parametrize("decay", [0.0, DECAY])
def test_weights_that_decay_are_those_of_the_ridge(train, decay):
    # A penalty of decay w'w has 2 decay beside the Hessian, which (A.21) prints as decay.
    ridge = np.linalg.solve(HESSIAN + 2.0 * decay * np.eye(4), PULL)
    steps = 1 if train is training.newton else 50
    np.testing.assert_allclose(train(miss, START, DATA, decay, steps), ridge, rtol=1e-6)


def test_steepest_descent_contracts_by_the_hessian():
    best, rate = np.linalg.solve(HESSIAN, PULL), 0.1
    left = np.linalg.matrix_power(np.eye(4) - rate * HESSIAN, 7) @ (np.asarray(START) - best)
    np.testing.assert_allclose(training.steepest_descent(miss, START, DATA, rate, 7), best + left, rtol=1e-9)


def test_sample_by_sample_every_sample_has_its_turn_in_each_epoch():
    key, rate = jax.random.key(4), 0.02
    w = np.asarray(START)
    orders = [np.asarray(jax.random.permutation(k, 40)) for k in jax.random.split(key, 2)]
    assert (orders[0] != orders[1]).any()
    for k in np.concatenate(orders):
        w = w + rate * (Y[k] - X[k] @ w) * X[k]  # (A.14) with delta = e, its sign mended
    np.testing.assert_allclose(training.sequential(miss, START, DATA, rate, key, 2), w, rtol=1e-9)


def test_pruning_takes_out_what_says_nothing_and_the_rest_follow():
    # The third input is larger where the weights are judged, so that an error of its weight tells.
    fresh = RNG.normal(size=(4000, 4)) * [1.0, 1.0, 20.0, 1.0]
    judge = jnp.asarray(fresh), jnp.asarray(fresh @ [1.0, -2.0, 0.0, 0.5])
    whole = np.linalg.lstsq(X, Y, rcond=None)[0]
    found, kept = training.pruned(miss, jnp.asarray(whole), DATA, judge)
    # The third weight is truly zero, and no other is.
    np.testing.assert_array_equal(kept, [1, 1, 0, 1])
    alone = np.linalg.lstsq(X[:, [0, 1, 3]], Y, rcond=None)[0]
    np.testing.assert_allclose(found[np.array([0, 1, 3])], alone, rtol=1e-5)  # 1e-8 keeps H regular
    assert float(found[2]) == 0.0
