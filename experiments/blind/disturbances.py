"""What pushes a craft in open water: gusts, slow forces, waves, a current that wanders.

Wind, a tether's pull and waves keep their direction in earth axes; gusts are turbulence about the hull and
turn with it. None of them depends on a logged signal.
"""

from dataclasses import dataclass

import numpy as np

from .plant import Disturbance
from .vehicle import Array, Vehicle

DT = 0.1  # s
KINDS = ("none", "gusts", "slow", "waves", "current")
# Standard deviations, as shares of full thrust or, of the current, in m/s; memories and peak periods in s.
SIZE = {"gusts": (0.01, 0.03), "slow": (0.03, 0.06), "waves": (0.02, 0.05), "current": (0.03, 0.1)}
MEMORY = {"gusts": (2.0, 5.0), "slow": (8.0, 15.0), "waves": (3.0, 9.0), "current": (30.0, 60.0)}
SPECTRUM = (0.6, 2.5)  # share of the peak frequency from and to which wave forces have components
COMPONENTS = 24
PEAKEDNESS = 3.3  # gamma of the mean spectrum that JONSWAP found


@dataclass(frozen=True)
class Weather:
    """A disturbance that goes on: its kind, standard deviation, memory or peak period [s], direction [rad].

    `size`: as a share of `full_push`, or in m/s of a current. `direction`: where waves run to.
    """

    kind: str
    size: float
    memory: float
    direction: float


def draw(kind: str, rng: np.random.Generator) -> Weather:
    """A random weather of this kind."""
    size, memory = (float(rng.uniform(*of[kind])) for of in (SIZE, MEMORY))
    return Weather(kind, size, memory, float(rng.uniform(-np.pi, np.pi)))


def middling(kind: str) -> Weather:
    """The weather in the middle of this kind."""
    return Weather(kind, sum(SIZE[kind]) / 2, sum(MEMORY[kind]) / 2, 0.5)


def full_push(vehicle: Vehicle) -> Array:
    """What counts as full thrust on each axis, six rows [N, N m].

    Water and wind do not know where the thrusters point: a force is as large from all sides, that of full
    thrust ahead or abeam. It turns the craft on a quarter of the farthest thruster's arm, with no more than
    the thrusters' full moment, and passes through the height of its centre. A locked axis has none.
    """
    thrust = np.abs(vehicle.allocation).sum(1)
    force, arm = thrust[:2].max(), np.linalg.norm(vehicle.places, axis=1).max()
    full = np.array([force, force, force, 0.0, 0.0, min(thrust[5], 0.25 * force * arm)])
    return full * np.isin(np.arange(6), vehicle.free)


def gauss_markov(samples: int, deviation: Array, tau: float, rng: np.random.Generator) -> Array:
    """First-order Gauss-Markov signals of these deviations (n,), (K, n, 1).

    w_k+1 = a w_k + sqrt(1 - a^2) deviation N(0, 1) with a = exp(-dt / tau).
    """
    a = np.exp(-DT / tau)
    kicks = rng.standard_normal((samples, len(deviation))) * deviation
    out = np.empty((samples, len(deviation)))
    out[0] = kicks[0]
    for k in range(1, samples):
        out[k] = a * out[k - 1] + np.sqrt(1.0 - a * a) * kicks[k]
    return out[:, :, None]


def jonswap(omega: Array, peak: float, gamma: float = PEAKEDNESS) -> Array:
    """Shape of a wave spectrum over frequencies [rad/s], after Hasselmann et al. (1973).

    omega^-5 exp(-5/4 (peak / omega)^4) gamma^b with b = exp(-(omega - peak)^2 / (2 sigma^2 peak^2)), sigma
    0.07 below the peak and 0.09 above it; with gamma = 1 after Pierson and Moskowitz (1964).
    """
    width = np.where(omega <= peak, 0.07, 0.09) * peak
    narrow = np.exp(-0.5 * ((omega - peak) / width) ** 2)
    return omega**-5.0 * np.exp(-1.25 * (peak / omega) ** 4) * gamma**narrow


def components(period: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies [rad/s] and amplitudes of waves of this peak period that add up to a deviation of 1.

    One frequency at random in each of as many equal bands, so that the sum does not repeat.
    """
    peak = 2.0 * np.pi / period
    edges = np.linspace(*SPECTRUM, COMPONENTS + 1) * peak
    omega = rng.uniform(edges[:-1], edges[1:])
    amplitude = np.sqrt(jonswap(omega, peak))
    return omega, amplitude * np.sqrt(2.0 / (amplitude**2).sum())


def over(weather: Weather, vehicle: Vehicle, samples: int, rng: np.random.Generator) -> Disturbance:
    """What a weather does to a craft over so many samples."""
    calm = np.zeros((samples, 6, 1))
    full = weather.size * full_push(vehicle)
    level, turn = full[:3], np.array([0.0, 0.0, 0.0, 0.0, 0.0, full[5]])
    match weather.kind:
        case "gusts":
            return Disturbance(gauss_markov(samples, full, weather.memory, rng))
        case "slow":
            wrench = gauss_markov(samples, turn, weather.memory, rng)
            return Disturbance(wrench, gauss_markov(samples, level, weather.memory, rng))
        case "current":
            level_flow = weather.size * np.array([1.0, 1.0, 0.0])
            return Disturbance(calm, water=gauss_markov(samples, level_flow, weather.memory, rng))
        case "waves":
            omega, amplitude = components(weather.memory, rng)
            phase = omega * DT * np.arange(samples)[:, None] + rng.uniform(0.0, 2.0 * np.pi, len(omega))
            # Water runs in circles: its push along the waves leads the one upwards by a quarter of a turn.
            along, up = np.cos(phase) @ amplitude, np.sin(phase) @ amplitude
            towards = np.array([np.cos(weather.direction), np.sin(weather.direction)])
            force = np.column_stack([along[:, None] * level[:2] * towards, -up * level[2]])
            # A hull is turned by what differs between its ends, whose phases are not those of its middle.
            apart = rng.uniform(0.0, 2.0 * np.pi, len(omega))
            calm[:, 5, 0] = full[5] * (np.sin(phase + apart) @ amplitude)
            return Disturbance(calm, force[:, :, None])
        case kind:
            raise ValueError(f"Disturbance `{kind}` is not known.")
