"""Dependences of a missing wrench on made-up knots, whose cause is known by construction."""

import numpy as np
import pytest

from jaxmarine.diagnosis._knots import Knots
from jaxmarine.diagnosis._score import Reduced
from jaxmarine.diagnosis._signals import Places
from jaxmarine.diagnosis._unknown import dependences

WINDOWS, KNOTS, HEAVE = 60, 8, 2
SHAPE = (WINDOWS, KNOTS)
# Standard deviation with which a window determines a knot [N].
STD = 0.1


def drift(rng: np.random.Generator, slow: float) -> np.ndarray:
    """A first-order Gauss-Markov signal of unit size along all knots; `slow`: knots that it remembers."""
    decay = np.exp(-1.0 / slow)
    out = np.zeros(WINDOWS * KNOTS)
    for i, kick in enumerate(rng.normal(size=out.size)[1:], 1):
        out[i] = decay * out[i - 1] + np.sqrt(1 - decay**2) * kick
    return out.reshape(SHAPE)


def knots_with(heave: np.ndarray, signals: dict[str, np.ndarray], rng: np.random.Generator) -> Knots:
    """Knots of a craft free in heave that misses a given force, seen with noise."""
    wrench = np.zeros((*SHAPE, 6))
    wrench[..., HEAVE] = heave
    information = np.zeros(6)
    information[HEAVE] = STD**-2.0
    h = np.tile(np.diag(np.tile(information, KNOTS)), (WINDOWS, 1, 1))
    seen = wrench + STD * rng.normal(size=wrench.shape)
    g = -np.einsum("wab,wb->wa", h, seen.reshape(WINDOWS, -1))
    free = np.zeros(6)
    free[HEAVE] = 1.0
    return Knots(
        stats=Reduced(np.ones(WINDOWS), g, h),
        width=0,
        precision=np.zeros(0),
        offset=np.zeros(0),
        free=free,
        places=Places(
            t=np.arange(WINDOWS * KNOTS, dtype=float).reshape(SHAPE),
            log=np.zeros(WINDOWS, int),
            rotation=np.tile(np.eye(3), (*SHAPE, 1, 1)),
            velocity=np.zeros((*SHAPE, 6)),
            signals=signals,
            played={},
        ),
    )


@pytest.mark.parametrize(
    ("names", "force"),
    [
        (("z",), lambda s: np.sin(2 * np.pi * s["z"] / 2.0)),
        (("u",), lambda s: np.abs(s["u"]) * s["u"]),
        (("psi", "u"), lambda s: s["u"] * np.sin(2 * s["psi"])),
    ],
    ids=["a place, in waves", "a velocity, squared", "a heading and a velocity together"],
)
def test_the_signals_of_a_missing_force_are_named(names, force):
    rng = np.random.default_rng(3)
    signals = {name: drift(rng, 4.0) for name in ("z", "u", "w", "port")}
    signals["psi"] = np.pi * drift(rng, 4.0)
    (found,) = dependences(knots_with(force(signals), signals, rng), 1.0)
    assert found.dof == "heave"
    assert set(found.signals) == set(names)


def test_a_force_that_depends_on_nothing_is_not_blamed_on_a_signal():
    rng = np.random.default_rng(4)
    signals = {name: drift(rng, 4.0) for name in ("z", "u", "w", "port")}
    assert dependences(knots_with(drift(rng, 3.0), signals, rng), 5.0) == ()


def test_a_velocity_that_a_disturbance_has_caused_is_not_its_cause():
    rng = np.random.default_rng(5)
    push, told = drift(rng, 3.0), drift(rng, 4.0)
    # What the commands make of the velocity, and what the disturbance adds to it.
    signals = {"u": drift(rng, 4.0), "w": told + 0.7 * push}
    moved = knots_with(push, signals, rng)
    assert [found.signals for found in dependences(moved, 1.0)] == [("w",)]
    assert dependences(moved, 1.0, {"w": told}) == ()
    # A drag that the file lacks shows on both.
    lacking = knots_with(-0.8 * signals["w"] + 0.3 * push, signals, rng)
    assert [found.signals for found in dependences(lacking, 1.0, {"w": told})] == [("w",)]
