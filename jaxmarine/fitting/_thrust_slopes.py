"""How the thrust hangs on the constants of the thrusters.

A thruster's thrust depends on its own constants only, so one tangent for each kind of constant serves all
thrusters. What a constant does lasts beyond its segment, by the lag: one pass over the logs follows where
the lag stands, and keeps its derivatives where windows begin. All others are made window by window, as those
of every sample of a long log are more than a memory holds.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics import UNLIMITED, Asked, Drive, Late, step_lengths
from ._parts import in_parts
from ._rollout import BLOCK, Problem, late_of, of_segment
from ._windows import Windows


class _Rows(eqx.Module):
    """What the thrust at some samples comes of: one row each, or all rows of all logs.

    - `late`, `d_late`: the commands that act, and their derivatives with respect to the delay.
    - `before`: where the lag stands; `dt`: length of the hold [s].
    """

    late: Late
    d_late: Late
    before: Float[Array, "*rows thrusters"]
    dt: Float[Array, "*rows"]
    segment: Int[Array, "*rows"]


class ThrustSlopes(eqx.Module):
    """Derivatives of the thrusters' thrust with respect to z, for one window at a time.

    - `slopes`: of each segment's constants with respect to z.
    - `touched`: whether any is not zero.
    - `begun`: at the first sample of each window, of where the lag stands, with respect to the constants.
    """

    drives: Drive
    rows: _Rows
    slopes: Float[Array, "segments kinds thrusters z"]
    touched: Bool[Array, ""]
    begun: Float[Array, "windows segments kinds thrusters"]

    @classmethod
    def of(cls, problem: Problem, drives: Drive, slopes: Drive, late: Late, before: Array) -> "ThrustSlopes":
        """For the drive constants of each segment, and their derivatives [segments, thrusters, z].

        - `late`, `before` [logs, steps, thrusters]: the commands that act, and where the lag stands.
        """
        records = problem.records

        def acting(delay):
            return late_of(problem, eqx.tree_at(lambda d: d.delay, drives, delay))

        def by_delay():
            return jax.jvp(acting, (drives.delay,), (jnp.ones_like(drives.delay),))[1]

        by_z = jnp.stack(jax.tree.leaves(slopes), axis=1)
        # Most causes are none of a thruster, and without a lag nothing lasts.
        touched = (by_z != 0).any()
        d_late = jax.lax.cond(touched, by_delay, lambda: jax.tree.map(jnp.zeros_like, late))
        rows = _Rows(late, d_late, before, jax.vmap(step_lengths)(records.t), records.segment)
        shape = (problem.windows.count, *by_z.shape[:-1])
        slow = (drives.lag > 0).any()
        if drives.rate is not None:
            slow = slow | (drives.rate < UNLIMITED).any()
        begun = jax.lax.cond(
            touched & slow,
            lambda: _begun(drives, rows, problem.windows, shape),
            lambda: jnp.zeros(shape),
        )
        return cls(drives, rows, by_z, touched, begun)

    def at(
        self, windows: Windows, begun: Float[Array, "segments kinds thrusters"], twice: bool
    ) -> Float[Array, "points thrusters z"]:
        """At every step of a window: of the mean thrust, and `twice` of that at the samples behind it.

        - `begun`: that of this window.
        """
        rows = jax.tree.map(lambda a: a[windows.log, windows.step], self.rows)
        own, by_constants, by_before = _tangents(self.drives, rows, len(self.slopes))

        def step(lag, now):
            after, decay = now
            return decay * lag + after, lag

        follow = own * by_constants.after[:, None], by_before.after[:, None, None]
        _, lag = jax.lax.scan(step, begun, follow)
        here = [
            own * at_once[:, None] + lasting[:, None, None] * lag
            for at_once, lasting in zip(by_constants[: 1 + twice], by_before[: 1 + twice], strict=True)
        ]
        return jnp.einsum("pskt,sktz->ptz", jnp.concatenate(here), self.slopes)


class _Pushed(NamedTuple):
    """Of thrust: mean over the hold, that at its sample, where the lag stands after it, what is asked for."""

    mean: Array
    instant: Array
    after: Array
    goal: Array


def _tangents(drives: Drive, rows: _Rows, segments: int) -> tuple[Array, _Pushed, _Pushed]:
    """Derivatives of the thrust at some rows.

    - Whether each row is in a segment [rows, segments, 1, 1].
    - With respect to each kind of constant in its own segment, from where the lag stands [rows, kinds,
      thrusters].
    - With respect to where the lag stands before the hold [rows, thrusters].
    """
    shape = rows.before.shape
    here = jax.tree.map(lambda a: jnp.broadcast_to(a, shape), of_segment(drives, rows.segment))

    def pushed(drive, late, before):
        asked = Asked.of(drive, late, rows.dt[:, None])
        push = asked.thrust(before)
        return _Pushed(push.mean, push.instant, asked.after(before), asked.goal)

    def along(drive, before):
        late = jax.tree.map(lambda a: a * drive.delay, rows.d_late)
        return jax.jvp(pushed, (here, rows.late, rows.before), (drive, late, before))[1]

    nothing = jnp.zeros(shape)
    leaves, structure = jax.tree.flatten(here)
    units = np.eye(len(leaves))[..., None, None]
    basis = jax.tree.unflatten(structure, [jnp.broadcast_to(one, (len(one), *shape)) for one in units])
    by_constants = jax.vmap(along, in_axes=(0, None), out_axes=1)(basis, nothing)
    by_before = along(jax.tree.map(jnp.zeros_like, here), jnp.ones(shape))
    own = jax.nn.one_hot(rows.segment, segments, dtype=nothing.dtype)[:, :, None, None]
    return own, by_constants, by_before


def _begun(drives: Drive, rows: _Rows, windows: Windows, shape: tuple[int, ...]) -> Array:
    """Derivatives [windows, segments, kinds, thrusters] of where the lag stands at the windows' first
    samples, by one pass over all logs.
    """
    logs, steps = rows.segment.shape
    count = shape[0]
    # A window that begins at a sample, none at the last one; several may begin at the same.
    begins = windows.log, windows.step[:, 0]
    first = jnp.full((logs, steps), count).at[begins].min(jnp.arange(count))

    def in_blocks(a):
        blocks = jax.vmap(in_parts, (0, None))(a, BLOCK)
        return blocks.reshape(logs * blocks.shape[1], *blocks.shape[2:])

    def block(carry, now):
        rows, first, fresh = now
        own, by_constants, by_before = _tangents(drives, rows, shape[1])
        lag, out = carry
        lag = jnp.where(fresh, own[0] * by_constants.goal[:1], lag)

        def row(carry, now):
            lag, out = carry
            after, decay, first = now
            # A sample at which no window begins goes into the row behind the last.
            out = jax.lax.dynamic_update_index_in_dim(out, lag, first, axis=0)
            return (decay * lag + after, out), None

        follow = own * by_constants.after[:, None], by_before.after[:, None, None], first
        return jax.lax.scan(row, (lag, out), follow)[0], None

    # Whether a sample, and so a block, is the first of its log.
    fresh = in_blocks(jnp.broadcast_to(jnp.arange(steps) == 0, (logs, steps)))[:, 0]
    begin = jnp.zeros(shape[1:]), jnp.zeros((count + 1, *shape[1:]))
    (_, out), _ = jax.lax.scan(block, begin, (jax.tree.map(in_blocks, rows), in_blocks(first), fresh))
    return out[first[begins]]
