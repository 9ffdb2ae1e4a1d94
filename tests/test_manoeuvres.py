"""Turning circles and dives of the packaged ship and torpedo, against equations of others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxmarine as jm
from jaxmarine.effects import WrenchEffect
from tests.crafts import packaged

# KVLCC2 as in Yasukawa and Yoshimura (2015) and ShipMMG.
RHO, L, DRAFT, D = 1025.0, 7.0, 0.46, 0.216
X_G, MASS = 0.25, 1025.0 * 3.27
M_X, M_Y = (k * 0.5 * RHO * L**2 * DRAFT for k in (0.022, 0.223))
INERTIA = MASS * ((0.25 * L) ** 2 + X_G**2) + 0.011 * 0.5 * RHO * L**4 * DRAFT
REVOLUTIONS, SPEED, RATE = 17.95, 1.17248, 0.276


def hull(u, v, r, xp=np):
    """The polynomials of the hull: X, Y, N."""
    speed = xp.sqrt(u**2 + v**2)
    a, b = v / speed, r * L / speed
    x = -0.022 - 0.040 * a**2 + 0.002 * a * b + 0.011 * b**2 + 0.771 * a**4
    y = -0.315 * a + 0.083 * b - 1.607 * a**3 + 0.379 * a**2 * b - 0.391 * a * b**2 + 0.008 * b**3
    n = -0.137 * a - 0.049 * b - 0.030 * a**3 - 0.294 * a**2 * b + 0.055 * a * b**2 - 0.013 * b**3
    size = 0.5 * RHO * L * DRAFT * speed**2
    return size * x, size * y, size * L * n


def mmg(t, state, angle):
    """The standard method's equations of motion about midship, at a constant wake."""
    u, v, r, _, _, psi = state
    delta = np.sign(angle) * min(abs(angle), RATE * t)
    advance = (1 - 0.4) * u / (REVOLUTIONS * D)
    kt = 0.2931 - 0.2753 * advance - 0.1385 * advance**2
    x_p = (1 - 0.22) * RHO * kt * REVOLUTIONS**2 * D**4
    share = D / 0.345
    race = 1 + 0.5 * (np.sqrt(1 + 8 * kt / (np.pi * advance**2)) - 1)
    u_r = 1.09 * (1 - 0.4) * u * np.sqrt(share * race**2 + 1 - share)
    drift = -(v - 0.71 * L * r)
    v_r = (0.395 if drift < 0 else 0.640) * drift
    normal = 0.5 * RHO * 0.0539 * 2.747 * (u_r**2 + v_r**2) * np.sin(delta - np.arctan2(v_r, u_r))
    x_h, y_h, n_h = hull(u, v, r)
    x = x_h + x_p - (1 - 0.387) * normal * np.sin(delta) + (MASS + M_Y) * v * r + X_G * MASS * r**2
    y = y_h - (1 + 0.312) * normal * np.cos(delta) - (MASS + M_X) * u * r
    n = n_h + (0.5 + 0.312 * 0.464) * L * normal * np.cos(delta) - X_G * MASS * u * r
    matrix = np.array([[MASS + M_Y, X_G * MASS], [X_G * MASS, INERTIA]])
    sway, yaw = np.linalg.solve(matrix, [y, n])
    return [
        x / (MASS + M_X),
        sway,
        yaw,
        u * np.cos(psi) - v * np.sin(psi),
        u * np.sin(psi) + v * np.cos(psi),
        r,
    ]


class Polynomials(WrenchEffect):
    """The hull's polynomials in the place of its terms in the file; they include the Munk moment."""

    name = "polynomials"
    units = {}

    @classmethod
    def neutral(cls, craft):
        return cls()

    @classmethod
    def suspects(cls, craft):
        return ()

    def __call__(self, motion):
        u, v, r = (motion.nu_r[i] for i in (0, 1, 5))
        x, y, n = hull(u, v, r, jnp)
        return jnp.zeros(6).at[jnp.array([0, 1, 5])].set(jnp.stack([x, y, n + (M_Y - M_X) * u * v]))


def circle(t, x, y, psi) -> np.ndarray:
    """Advance, transfer and tactical diameter, in lengths."""
    psi, y = np.abs(psi), np.abs(y)
    at = [np.interp(turn, psi, t) for turn in (np.pi / 2, np.pi)]
    return np.array([np.interp(at[0], t, x), *np.interp(at, t, y)]) / L


def by_jaxmarine(vehicle: jm.Vehicle, angle: float) -> np.ndarray:
    t = np.arange(0.0, 120.0, 0.1)
    commands = np.stack([np.full_like(t, REVOLUTIONS), np.where(t > 0.0, angle, 0.0)], axis=1)
    log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, "circle")
    run = jm.simulate(vehicle, log, jm.initial_state(vehicle, velocity=(SPEED, 0, 0, 0, 0, 0)))
    # The rudder is told at the second sample.
    return circle(t, *(np.asarray(run[name]) for name in ("x", "y")), np.unwrap(np.asarray(run["psi"])))


@pytest.mark.parametrize("degrees", [35.0, -35.0, 20.0])
def test_the_tanker_turns_as_others_say(degrees):
    angle = np.deg2rad(degrees)
    begin = [SPEED, 0, 0, 0, 0, 0]
    run = scipy.integrate.solve_ivp(mmg, (0, 120), begin, args=(angle,), rtol=1e-8, atol=1e-9, max_step=0.5)
    other = circle(run.t, *run.y[3:])
    tanker = packaged("kvlcc2")
    plain = jax.tree.map(jnp.zeros_like, tanker.damping)
    bare = jm.Vehicle(**{**vars(tanker), "damping": plain, "placed": (jm.Placed(Polynomials()),)})
    # A delay of one sample, 0.1 s of some 30 s.
    np.testing.assert_allclose(by_jaxmarine(bare, angle), other, rtol=0.01)
    # The file's own terms stand for the polynomials.
    np.testing.assert_allclose(by_jaxmarine(tanker, angle), other, rtol=0.03)


# remus100 of PythonVehicleSimulator from rest: 1200 revolutions a minute, planes at -3 degrees from 10 s to
# 25 s, rudder at 5 degrees from then on; Euler steps of 5 ms.
TORPEDO = {
    20.0: {"z": -1.56391, "theta": 0.13297, "u": 2.00809},
    40.0: {
        "y": 8.75077,
        "z": -3.39292,
        "psi": 0.71693,
        "phi": 0.02051,
        "u": 1.99726,
        "v": -0.14232,
        "r": 0.04646,
    },
    60.0: {
        "x": 91.03481,
        "y": 43.3494,
        "z": -3.34087,
        "psi": 1.64626,
        "u": 1.99726,
        "v": -0.14232,
        "r": 0.04646,
    },
}


def test_the_torpedo_dives_and_turns_as_others_say():
    torpedo = packaged("remus100")
    t = np.arange(0.0, 61.0, 0.1)
    rudder = np.where(t >= 25, np.deg2rad(5.0), 0.0)
    plane = np.where((t >= 10) & (t < 25), np.deg2rad(-3.0), 0.0)
    # The shaft starts from rest.
    commands = np.stack([np.where(t > 0, 20.0, 0.0), rudder, rudder, plane, plane], axis=1)
    log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, torpedo.command_names, "dive")
    run = jm.simulate(torpedo, log, jm.initial_state(torpedo))
    for time, values in TORPEDO.items():
        found = {name: float(run[name][round(time / 0.1)]) for name in values}
        assert found == pytest.approx(values, rel=0.01), time
