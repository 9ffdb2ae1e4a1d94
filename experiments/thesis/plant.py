"""Tethra, the operator at its sticks, the pool, and the noise of its measurements (thesis, sec. 5.2-5.3).

    log = plant.dive(plant.tethra(), duration=1000.0, 0)
    noisy = plant.noisy(log, "text", seed=1)

The log holds commands, attitude, velocities and accelerations of every tenth of a second.
"""

import dataclasses
from typing import Literal, Self, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.signal
from jaxtyping import Array, Float

import jaxmarine as jm
from jaxmarine._types import CHANNELS, SENSORS, Matrix6, Vector3, Wrench
from jaxmarine.effects import Craft, InputDelay, Motion, Saturation, Suspect, ThrusterLag, WrenchEffect
from jaxmarine.physics import from_euler, rotation
from jaxmarine.simulation import inputs

Noise = Literal["text", "listing", "tenth", "realistic", "white", "coloured"]

DT = 0.1  # [s] between samples (sec. 5.3)
FINE = 10  # integration steps per sample: the truth is finer than any model that is fitted to it
# Four degrees of freedom and time delays and saturation of the thrusters (fig. 5.4); all numbers are assumed.
STICKS = ("surge", "heave", "roll", "yaw")
DELAY, LAG, LIMIT = 2 * DT, 0.15, 1.0  # [s], [s], [command]
# Wrench of a full stick about its trim [N, N m]: gives motion as rich as the four thrusters allow.
FULL = np.array([130.0, 85.0, 35.0, 28.0])
HOLDS = (1.0, 6.0)  # [s] for which a stick is held
SLEW = 0.3  # [s]

# The listing's displacement and centre of buoyancy, seen from the plane of the horizontal thrusters,
# where (5.15), (5.18) and the vehicle file have their origin.
WEIGHT, BUOYANCY = 2269.7, 2394.5  # [N]
COG, COB = (-0.0052, 0.0, -0.2269), (-0.0006, 0.0, -0.3817)  # [m]

# Standard deviations of a realistic set of sensors: 2 cm, 0.005 rad, 1 cm/s, 0.01 rad/s.
REALISTIC = {"position": 0.02, "attitude": 0.005, "velocity": 0.01, "rate": 0.01}
# [s] memory of noise that lasts; sec. 6.3 speaks of it and gives no numbers.
MEMORY = 5.0


def tethra() -> jm.Vehicle:
    """The thesis' plant: (5.18), (5.24), the listing's restoring forces; its thrusters' lags are assumed."""
    file = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    body = dataclasses.replace(
        file.body,
        weight=jnp.asarray(WEIGHT),
        buoyancy=jnp.asarray(BUOYANCY),
        cog=jnp.array(COG),
        cob=jnp.array(COB),
    )
    return dataclasses.replace(file, body=body).place(
        jm.Placed(InputDelay(jnp.asarray(DELAY))),
        jm.Placed(Saturation(jnp.asarray(LIMIT))),
        jm.Placed(ThrusterLag(jnp.asarray(LAG))),
    )


# --- the pool -------------------------------------------------------------------------------------


class Pool(WrenchEffect):
    """Walls, floor and surface as springs with dampers that push on the corners of the hull.

    - `low`, `high`: the corners of the water [m] NED; the surface is at `low[2]`.
    - `corners`: of the hull, in body axes [m].
    - `stiffness` [N/m], `damping` [N s/m] of each contact, along the wall's normal, never pulling.

    At the surface this stands for the buoyancy of what comes out of the water: 2394 N over half a
    metre. Neutral: no stiffness. Source: linear viscoelastic (Kelvin-Voigt) contact.
    """

    name = "pool"
    units = {"stiffness": "N/m", "damping": "N s/m"}

    low: Vector3
    high: Vector3
    corners: Float[Array, "corners 3"]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        side = jnp.array([12.5, 6.25, 1.75])
        # The frame is 1 m long and wide, and reaches from its lowest tubes to the floats' top.
        unit = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.55, 0.43]), axis=-1).reshape(8, 3)
        return cls(-side, side, jnp.asarray(unit), jnp.zeros(()), jnp.zeros(()))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        del craft
        return ()

    def __call__(self, motion: Motion) -> Wrench:
        def contact(arm):
            place = motion.position + motion.rotation @ arm
            speed = motion.rotation @ (motion.nu[:3] + jnp.cross(motion.nu[3:], arm))
            force = self._push(self.low - place, -speed) - self._push(place - self.high, speed)
            body = motion.rotation.T @ force
            return jnp.concatenate([body, jnp.cross(arm, body)])

        return jax.vmap(contact)(self.corners).sum(axis=0)

    def _push(self, depth: Vector3, speed: Vector3) -> Vector3:
        """Force [N] of three walls, off each wall, from the depth [m] and the speed [m/s] into it."""
        force = jnp.maximum(self.stiffness * depth + self.damping * speed, 0.0)
        return jnp.where(depth > 0, force, 0.0)


def pool() -> jm.Placed:
    """A pool of 25 by 12.5 m and 3.5 m depth with walls that give some centimetres."""
    sized = Pool.neutral(jm.load_vehicle(jm.packaged_vehicle("tethra")))
    stiff = (jnp.asarray(4000.0), jnp.asarray(400.0))
    return jm.Placed(eqx.tree_at(lambda p: (p.stiffness, p.damping), sized, stiff))


# --- the operator ---------------------------------------------------------------------------------


def sticks(t: Float[np.ndarray, " times"], seed: int) -> Float[np.ndarray, "times 4"]:
    """Sticks of surge, heave, roll and yaw, each held at random for some seconds, slewing in 0.3 s.

    A hold is followed by its opposite, as long: the operator keeps the craft near where it started.
    """
    rng = np.random.default_rng(seed)
    out = np.zeros((len(t), len(STICKS)))
    for stick in out.T:
        at = 0
        while at < len(t):
            held = round(rng.uniform(*HOLDS) / DT)
            stick[at : at + held] = rng.uniform(-1.0, 1.0)
            stick[at + held : at + 2 * held] = -stick[at]
            at += 2 * held
    return scipy.ndimage.uniform_filter1d(out, round(SLEW / DT), axis=0, mode="nearest")


def commands(
    vehicle: jm.Vehicle, levels: Float[np.ndarray, "times 4"]
) -> Float[np.ndarray, "times thrusters"]:
    """Thruster commands of stick levels; the heave stick is trimmed against the buoyancy."""
    wrench = np.zeros((len(levels), 6))
    wrench[:, [0, 2, 3, 5]] = levels * FULL
    wrench[:, 2] += float(vehicle.body.buoyancy - vehicle.body.weight)
    return np.array(jm.allocate(vehicle, jnp.asarray(wrench), STICKS))


def dive(vehicle: jm.Vehicle, duration: float, *seeds: int, idle: tuple[str, ...] = ()) -> jm.Log:
    """The true motion of the vehicle with an operator at its sticks, from rest; `noisy` measures it.

    - `duration` [s] of each operator; one follows on the other, so that `dive(v, T, 0, 1)` goes on where
      `dive(v, T, 0)` ends.
    - `idle`: sticks that are left alone.
    """
    count = round(duration / DT)
    t = np.arange(count * len(seeds)) * DT
    levels = np.concatenate([sticks(t[:count], seed) for seed in seeds])
    told = commands(vehicle, levels * [name not in idle for name in STICKS])
    fine = np.arange(len(t) * FINE) * (DT / FINE)
    names = vehicle.thruster_names
    blank = np.full((len(fine), len(CHANNELS)), np.nan)
    asked = jm.Log(fine, blank, np.repeat(told, FINE, axis=0), None, names, "dive")
    channels = np.array(jm.simulate(vehicle, asked, jm.initial_state(vehicle)).channels)[::FINE]
    return jm.Log(t, channels, told, None, names, f"dive {seeds[0]}")


# --- what is measured -----------------------------------------------------------------------------


def noisy(log: jm.Log, kind: Noise, seed: int) -> jm.Log:
    """The log as sensors show it.

    - "text" (sec. 5.3.1): velocities off by up to 0.1 % of their magnitude, accelerations by up to 0.5 m/s²
      and 0.05 rad/s², uniformly; attitude exact, no positions.
    - "tenth": the same with a tenth of it on the accelerations, which is less than they are themselves.
    - "listing" (AddNoise): velocities by up to 10 %, accelerations by up to 50 % (linear) and 5 % (angular)
      of their magnitude; the forces' share of it is `noisy_forces`.
    - "realistic": normal with `REALISTIC`, on positions too; accelerations are not measured.
    - "white", "coloured": velocities alone are off, with the same mean square of `REALISTIC`: from sample to
      sample, or half of it as a bias and half with a `MEMORY` (sec. 6.3: non-zero mean and correlated).
    """
    rng = np.random.default_rng([seed, 1])
    channels = log.channels.copy()
    nu, nu_dot = channels[:, 6:12], channels[:, 12:]
    if kind == "realistic":
        deviation = np.array([REALISTIC.get(name, np.nan) for name, own in SENSORS.items() for _ in own])
        channels = channels + deviation * rng.standard_normal(channels.shape)
    elif kind in ("white", "coloured"):
        size = np.repeat([REALISTIC["velocity"], REALISTIC["rate"]], 3)
        off = rng.standard_normal(nu.shape)
        if kind == "coloured":
            kept = np.exp(-DT / MEMORY)
            off[1:] *= np.sqrt(1.0 - kept**2)
            slow = scipy.signal.lfilter([1.0], [1.0, -kept], off, axis=0)
            off = np.sqrt(0.5) * (slow + rng.choice([-1.0, 1.0], 6))
        channels[:, 6:12] = nu + size * off
        channels[:, :3] = np.nan
    elif kind in ("text", "tenth", "listing"):
        share = np.array([0.5] * 3 + [0.05] * 3)
        size = {"text": 1.0, "tenth": 0.1, "listing": np.abs(nu_dot)}[kind]
        nu_share = 0.1 if kind == "listing" else 1e-3
        channels[:, 12:] = nu_dot + share * size * rng.uniform(-1.0, 1.0, nu_dot.shape)
        channels[:, 6:12] = nu * (1.0 + nu_share * rng.uniform(-1.0, 1.0, nu.shape))
        channels[:, :3] = np.nan
    else:
        raise ValueError(f"Argument `kind` must be one of {get_args(Noise)}, but is {kind!r}.")
    return dataclasses.replace(log, channels=channels)


def forces(vehicle: jm.Vehicle, log: jm.Log) -> Float[np.ndarray, "times 6"]:
    """tau - g(eta) at each sample [N, N m], from commands and logged attitude; propulsion and g are known."""
    return np.array(_forces(vehicle, *map(jnp.asarray, (log.t, log.commands, log.channels[:, 3:6]))))


# As one program: run piece by piece, what loops over the samples is compiled anew each time.
@eqx.filter_jit
def _forces(vehicle: jm.Vehicle, t, commands, attitudes) -> Float[Array, "times 6"]:
    plant = vehicle.plant()
    _, at = inputs(plant, t, commands, jnp.zeros((len(t), 6)))

    def one(attitude, thrust):
        return plant.allocation @ thrust - plant.load.restoring(rotation(from_euler(attitude))[2])

    return jax.vmap(one)(attitudes, at.thrust)


def noisy_forces(force: Float[np.ndarray, "times 6"], kind: Noise, seed: int) -> Float[np.ndarray, "times 6"]:
    """tau - g as the listing spoils it, by up to 50 % (forces) and 5 % (moments); else as it is."""
    if kind != "listing":
        return force
    share = np.array([0.5] * 3 + [0.05] * 3)
    return force * (1.0 + share * np.random.default_rng([seed, 2]).uniform(-1.0, 1.0, force.shape))


def truth(vehicle: jm.Vehicle) -> dict[str, Matrix6]:
    """The matrices that are to be found."""
    return {"M": vehicle.mass_matrix, "D_l": vehicle.damping.linear, "D_q": vehicle.damping.quadratic}
