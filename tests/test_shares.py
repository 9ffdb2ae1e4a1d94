"""A fit whose logs lie in several places comes to what one process comes to."""

import equinox as eqx
import numpy as np
import pytest

from jaxmarine.fitting import fit
from jaxmarine.fitting._shares import Share, Shares
from jaxmarine.logs import read_logs, write_log
from jaxmarine.vehicle_io import load_vehicle, save_vehicle
from tests.boats import boat, record, steps
from tests.fleet_work import child

# Sums in another order, and the solver's loop in another program: some roundings at each of its steps.
ROUNDED = 1e-7


def free(vehicle):
    return vehicle.damping.linear, vehicle.thrusters.max_thrust


@pytest.fixture(scope="module")
def logs():
    """Two logs of a boat whose damping and thrust the file has wrong by a fifth."""
    return [record(boat(), steps(seed=i), seed=i, name=f"log{i}.csv") for i in range(2)]


def start():
    file = boat()
    return eqx.tree_at(free, file, (0.8 * file.damping.linear, 1.2 * file.thrusters.max_thrust))


@pytest.mark.slow
def test_shares_come_to_what_one_process_comes_to(logs):
    one = fit(start(), logs, free, entries="diagonal", prior=0.5)
    shares = Shares([Share(start(), [log]) for log in logs])
    two = fit(start(), shares, free, entries="diagonal", prior=0.5)
    assert [p.name for p in one.parameters] == [p.name for p in two.parameters]
    for what in ("value", "std_model", "std_sandwich"):
        numbers = [[getattr(p, what) for p in made.parameters] for made in (one, two)]
        np.testing.assert_allclose(numbers[1], numbers[0], rtol=ROUNDED)
    np.testing.assert_allclose(two.information, one.information, rtol=ROUNDED, atol=1e-6)
    np.testing.assert_allclose(two.left, one.left, rtol=ROUNDED)
    np.testing.assert_allclose(two.weighed, one.weighed, rtol=ROUNDED)
    assert (two.steps, two.result) == (one.steps, one.result)
    assert two.reduced_chi2 == pytest.approx(one.reduced_chi2, rel=ROUNDED)
    # And it has moved: the file was wrong by a fifth.
    assert abs(two.parameters[-1].value / two.parameters[-1].start - 1) > 0.1
    assert "velocities seen" not in str(two)


def test_shares_cannot_reject_windows():
    with pytest.raises(ValueError, match="without `reject`"):
        fit(boat(), Shares([]), free, reject=True)


REMOTE = """
import sys
if __name__ == "__main__":
    import jax
    jax.config.update("jax_enable_x64", True)
    import jaxmarine as jm
    from tests.test_shares import free
    vehicle = jm.load_vehicle(sys.argv[1])
    with jm.fleets.shared(vehicle, sys.argv[2:], workers=2) as logs:
        fit = jm.fit(vehicle, logs, free, entries="diagonal", prior=0.5)
    print(*(p.value for p in fit.parameters))
"""


@pytest.mark.slow
def test_logs_on_two_workers_come_to_what_one_process_comes_to(logs, tmp_path):
    save_vehicle(start(), tmp_path / "boat.toml")
    paths = [tmp_path / log.name for log in logs]
    for log, path in zip(logs, paths, strict=True):
        write_log(log, path)
    file = load_vehicle(tmp_path / "boat.toml")
    one = fit(file, read_logs(paths, file), free, entries="diagonal", prior=0.5)
    done = child(REMOTE, tmp_path / "boat.toml", *paths)
    assert done.returncode == 0, done.stderr
    values = [float(word) for word in done.stdout.split()]
    np.testing.assert_allclose(values, [p.value for p in one.parameters], rtol=ROUNDED)
