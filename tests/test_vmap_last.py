"""`vmap_last` against `jax.vmap`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._vmap_last import vmap_last
from jaxmarine.physics import apply, rotation, to_euler

COUNT = 5
RNG = np.random.default_rng(0)
X = jnp.asarray(RNG.normal(size=(4, COUNT)))
Y = jnp.asarray(RNG.normal(size=(4, COUNT)))
A = jnp.asarray(RNG.normal(size=(3, 4)))
MANY_A = jnp.asarray(RNG.normal(size=(3, 4, COUNT)))


def entrywise(x, y, a):
    return jnp.where(x > 0, jnp.sin(x) * y, 2.0 - y**2) / (1.0 + jnp.abs(x)), jnp.clip(x, -0.5, y), a.sum()


def scalars(x, y, a):
    return jnp.where(x.sum() > 0, x, y), jnp.maximum(x[0], 0.1) * y, x[1] * a


def axes(x, y, a):
    table = jnp.stack([x, y, jnp.ones(4)], axis=1)
    first, rest = jnp.split(jnp.concatenate([x, y[::2], a[0]]), [3])
    return (
        table.T,
        table[1:3, ::2],
        table.reshape(2, 6),
        first[None, :],
        rest.sum(),
        table.sum(),
        table.sum(0),
    )


def products(x, y, a):
    square = a.T @ a + jnp.eye(4).at[0, 1].set(1.0)
    # In reverse, by its transpose.
    slope = jax.grad(lambda y: x @ apply(jnp.arange(16.0).reshape(4, 4), y))(y)
    return apply(a, x), a @ x, x @ y, (a * x[None, :]).sum(-1), jnp.outer(x, y) @ y, apply(square, y), slope


def attitudes(x, y, a):
    turn = rotation(x)
    return to_euler(x), apply(turn, y[:3]), apply(turn.T, a[0, :3]), jnp.cross(x[:3], y[1:])


def others(x, y, a):
    """Operations without a rule."""
    grown = jax.lax.fori_loop(0, 3, lambda _, z: jnp.tanh(z + y), x)
    return (
        jnp.cumsum(x),
        jnp.sort(grown),
        jnp.linalg.norm(x),
        jax.nn.softplus(y),
        x[jnp.argmax(y)],
        grown[::-1] @ a.T,
    )


FUNCTIONS = (entrywise, scalars, axes, products, attitudes, others)


def equal(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        # Sums of few terms in another order.
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("a, alike", [(A, True), (MANY_A, False)])
def test_it_is_vmap(function, a, alike):
    expected = jax.vmap(function, (-1, -1, None if alike else -1), -1)(X, Y, a)
    found = vmap_last(function, (True, True, not alike))(X, Y, a)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    equal(found, expected)


@pytest.mark.parametrize("function", (entrywise, products, others))
def test_it_is_differentiated_and_compiled_as_vmap(function):
    def of(many):
        def total(x, y, a):
            return sum(jnp.sin(leaf).sum() for leaf in jax.tree.leaves(many(x, y, a)))

        return jax.jit(jax.grad(total, argnums=(0, 1, 2)))(X, Y, A)

    equal(
        of(vmap_last(function, (True, True, False))),
        of(jax.vmap(function, (-1, -1, None), -1)),
    )


def test_what_is_closed_over_is_shared():
    def of(a):
        return vmap_last(lambda x: apply(a, x), (True,))(X)

    np.testing.assert_allclose(jax.jit(of)(A), A @ X, rtol=1e-13)
    slope = jax.jacfwd(of)(A)  # d(A X)_in / dA_jk = delta_ij X_kn
    np.testing.assert_allclose(slope, np.einsum("ij,kn->injk", np.eye(3), X), rtol=1e-13)


def test_a_product_with_one_matrix_is_one_product_for_all():
    text = str(jax.make_jaxpr(vmap_last(apply, (False, True)))(A, X))
    assert text.count("dot_general") == 1
    # The elements stay behind: nothing is turned round.
    turned = jax.make_jaxpr(vmap_last(attitudes, (True, True, False)))(X, Y, A)
    assert "[5,4]" not in str(turned) and "[5,3]" not in str(turned)
