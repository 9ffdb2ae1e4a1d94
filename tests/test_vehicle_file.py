"""Vehicle files: numbers in, matrices out, and back to the same file."""

import tomllib
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from jaxmarine._errors import InputError
from jaxmarine._files import written_whole
from jaxmarine._types import DOFS
from jaxmarine.vehicle_file import (
    EffectEntry,
    VehicleFile,
    read_vehicle_file,
    write_vehicle_file,
)

MINIMAL = """
schema = 1
name = "brick"

[body]
mass = 2.0
inertia = [[5.0, 0.0, -0.5], [0.0, 6.0, 0.0], [-0.5, 0.0, 7.0]]
cog = [0.1, 0.2, 0.3]
cob = [0.0, 0.0, 0.0]

[added_mass]
matrix = [1, 2, 3, 4, 5, 6]

[damping]
linear = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0]
quadratic = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
"""

THRUSTERS = """
[[thruster]]
name = "bow"
position = [1.0, 0.0, 0.0]
direction = [0.0, 3.0, 4.0]
max_thrust = 50
saturation = 1.5

[[thruster]]
name = "stern"
position = [-1.0, 0.0, 0.0]
direction = [1.0, 0.0, 0.0]
max_thrust = 80.0
deadband = 0.05
lag = 0.2
delay = 0.1
saturation = 0.8
"""

EFFECTS = """
[[effect]]
effect = "thruster_gain"
target = "stern"
since = 120
since_log = "second.csv"
factor = 0.71

[[effect]]
effect = "learned"
arrays = "brick.npz"
inputs = ["u", "psi"]
"""


def read(tmp_path: Path, text: str) -> VehicleFile:
    (tmp_path / "vehicle.toml").write_text(text, encoding="utf-8")
    return read_vehicle_file(tmp_path / "vehicle.toml")


def test_defaults_are_those_of_the_contract(tmp_path):
    file = read(tmp_path, MINIMAL)
    assert file.dof == DOFS
    assert (file.environment.density, file.environment.gravity) == (1025.0, 9.81)
    assert file.weight == 2.0 * 9.81 and file.buoyancy == file.weight
    assert file.thruster_names == () and file.command_limits.shape == (0,)
    assert file.sensors.stated() == {} and file.effect == ()
    heavier = read(tmp_path, MINIMAL.replace("[added_mass]", "weight = 30\n[added_mass]"))
    assert heavier.weight == 30.0 and heavier.buoyancy == 30.0


def test_the_rigid_body_matrix_is_the_one_worked_by_hand(tmp_path):
    # m S(cog) with m cog = (0.2, 0.4, 0.6)
    expected = [
        [2.0, 0.0, 0.0, 0.0, 0.6, -0.4],
        [0.0, 2.0, 0.0, -0.6, 0.0, 0.2],
        [0.0, 0.0, 2.0, 0.4, -0.2, 0.0],
        [0.0, -0.6, 0.4, 5.0, 0.0, -0.5],
        [0.6, 0.0, -0.2, 0.0, 6.0, 0.0],
        [-0.4, 0.2, 0.0, -0.5, 0.0, 7.0],
    ]
    assert np.allclose(read(tmp_path, MINIMAL).rigid_body_matrix, expected, rtol=1e-15, atol=0)


def test_the_rigid_body_matrix_gives_the_kinetic_energy_of_point_masses(tmp_path):
    rng = np.random.default_rng(1)
    points, masses = rng.normal(size=(5, 3)), rng.uniform(1, 2, 5)
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, points, strict=True))
    cog = masses @ points / masses.sum()
    text = (
        MINIMAL.replace("mass = 2.0", f"mass = {masses.sum()}")
        .replace("[[5.0, 0.0, -0.5], [0.0, 6.0, 0.0], [-0.5, 0.0, 7.0]]", str(inertia.tolist()))
        .replace("[0.1, 0.2, 0.3]", str(cog.tolist()))
    )
    matrix = read(tmp_path, text).rigid_body_matrix
    velocity, rate = rng.normal(size=3), rng.normal(size=3)
    speeds = velocity + np.cross(rate, points)
    nu = np.concatenate([velocity, rate])
    assert nu @ matrix @ nu == pytest.approx(np.sum(masses * np.sum(speeds**2, axis=1)), rel=1e-12)


def test_a_mass_matrix_takes_the_place_of_mass_and_inertia(tmp_path):
    matrix = np.diag([9.0, 9, 9, 1, 1, 1])
    matrix[0, 4] = matrix[4, 0] = -2.0
    given = f"mass_matrix = {matrix.tolist()}\n[added_mass]"
    file = read(tmp_path, MINIMAL.replace("[added_mass]", given))
    assert np.array_equal(file.rigid_body_matrix, matrix)
    assert file.weight == 2.0 * 9.81
    lines = [line for line in MINIMAL.splitlines() if not line.startswith("inertia")]
    assert np.array_equal(
        read(tmp_path, "\n".join(lines).replace("[added_mass]", given)).rigid_body_matrix, matrix
    )


def test_six_numbers_are_a_diagonal(tmp_path):
    file = read(tmp_path, MINIMAL)
    assert np.array_equal(file.added_mass_matrix, np.diag([1, 2, 3, 4, 5, 6]))
    assert np.array_equal(file.linear, np.diag([10, 20, 30, 40, 50, 60]))
    assert np.array_equal(file.quadratic, np.zeros((6, 6)))


def test_thrusters_have_unit_directions_and_limits_of_at_least_one(tmp_path):
    file = read(tmp_path, MINIMAL + THRUSTERS)
    assert file.thruster_names == ("bow", "stern")
    assert file.command_limits.tolist() == [1.5, 1.0]
    assert file.thruster[0].direction == pytest.approx((0, 0.6, 0.8))
    assert file.thruster[1].lag == 0.2
    first = file.thruster[0]
    assert (first.deadband, first.lag, first.delay) == (0, 0, 0)


def test_what_a_thruster_does_astern_and_its_curve_are_kept_where_they_are_stated(tmp_path):
    stated = "max_thrust = 80.0\nmax_thrust_reverse = 56.0\nquadratic = 0.4\nadvance_loss = 9.5"
    file = read(tmp_path, MINIMAL + THRUSTERS.replace("max_thrust = 80.0", stated))
    assert [(one.max_thrust_reverse, one.quadratic) for one in file.thruster] == [(None, 0.0), (56.0, 0.4)]
    write_vehicle_file(file, tmp_path / "copy.toml")
    assert read_vehicle_file(tmp_path / "copy.toml") == file
    bow, stern = tomllib.loads((tmp_path / "copy.toml").read_text())["thruster"]
    assert not {"max_thrust_reverse", "quadratic", "advance_loss"} & {*bow}
    assert (stern["max_thrust_reverse"], stern["quadratic"], stern["advance_loss"]) == (56.0, 0.4, 9.5)
    for wrong, said in (
        ("max_thrust_reverse = 0", "the thrust at command -1"),
        ("quadratic = 3", "from -1 to 2"),
        ("advance_loss = 9.5\nswivel = [0, 0, 1]", "`swivel` and `advance_loss`"),
    ):
        text = THRUSTERS.replace("max_thrust = 80.0", f"max_thrust = 80.0\n{wrong}")
        with pytest.raises(InputError, match=said):
            read(tmp_path, MINIMAL + text)


def test_degrees_of_freedom_stand_in_their_own_order(tmp_path):
    text = MINIMAL.replace('name = "brick"', 'name = "brick"\ndof = ["yaw", "surge"]')
    assert read(tmp_path, text).dof == ("surge", "yaw")


def test_inertia_about_locked_axes_need_not_be_known(tmp_path):
    text = MINIMAL.replace("[5.0, 0.0, -0.5]", "[0, 0, 0]").replace("[0.0, 6.0, 0.0]", "[0, 0, 0]")
    text = text.replace("[-0.5, 0.0, 7.0]", "[0, 0, 7.0]")
    planar = text.replace('name = "brick"', 'name = "brick"\ndof = ["surge", "sway", "yaw"]')
    assert read(tmp_path, planar).rigid_body_matrix[5, 5] == 7.0
    with pytest.raises(InputError, match=r"`body.inertia` must be positive definite"):
        read(tmp_path, text)


def test_an_unsymmetric_added_mass_is_accepted(tmp_path):
    matrix = np.diag([1.0, 2, 3, 4, 5, 6])
    matrix[1, 5], matrix[5, 1] = 1.3, 0.4
    text = MINIMAL.replace("[1, 2, 3, 4, 5, 6]", str(matrix.tolist()))
    assert np.array_equal(read(tmp_path, text).added_mass_matrix, matrix)


def test_effects_keep_their_parameters_apart(tmp_path):
    gain, learned = read(tmp_path, MINIMAL + THRUSTERS + EFFECTS).effect
    assert gain == EffectEntry(
        effect="thruster_gain",
        target="stern",
        since=120.0,
        since_log="second.csv",
        parameters={"factor": 0.71},
    )
    assert (learned.arrays, learned.inputs, learned.parameters) == ("brick.npz", ("u", "psi"), {})


def test_what_an_effect_may_be_is_asked_of_the_caller(tmp_path):
    read(tmp_path, MINIMAL + EFFECTS)

    def only_learned(entry: EffectEntry, file: VehicleFile) -> None:
        assert file.name == "brick"
        if entry.effect != "learned":
            raise ValueError(f"names `{entry.effect}`, which is no effect.")

    with pytest.raises(InputError, match=r"vehicle.toml: `effect\[1\]` names `thruster_gain`"):
        read_vehicle_file(tmp_path / "vehicle.toml", only_learned)


def test_a_file_survives_writing_and_reading(tmp_path):
    text = MINIMAL + "\n[sensors]\nposition = 0.01\nrate = 1e-5\n" + THRUSTERS + EFFECTS
    file = read(tmp_path, text.replace('"brick"', r'"br\"ick\\ ü"'))
    write_vehicle_file(file, tmp_path / "copy.toml")
    assert read_vehicle_file(tmp_path / "copy.toml") == file
    assert {path.name for path in tmp_path.iterdir()} == {"vehicle.toml", "copy.toml"}
    # other people's scripts find the same keys by the standard library alone
    plain = tomllib.loads((tmp_path / "copy.toml").read_text(encoding="utf-8"))
    assert plain["effect"][0] == {
        "effect": "thruster_gain",
        "target": "stern",
        "since": 120.0,
        "since_log": "second.csv",
        "factor": 0.71,
    }
    assert plain["effect"][1]["inputs"] == ["u", "psi"]
    assert plain["sensors"] == {"position": 0.01, "rate": 1e-5}
    assert plain["added_mass"]["matrix"][5] == [0, 0, 0, 0, 0, 6]
    assert "weight" not in plain["body"]


numbers = st.floats(-1e12, 1e12)
positive = st.floats(1e-9, 1e9)


@hypothesis.given(
    mass=positive,
    cog=st.tuples(numbers, numbers, numbers).map(lambda c: [x * 1e-16 for x in c]),
    damping=st.lists(st.lists(numbers, min_size=6, max_size=6), min_size=6, max_size=6),
    added=st.lists(positive, min_size=6, max_size=6),
    direction=st.tuples(numbers, numbers, numbers).filter(lambda d: max(map(abs, d)) > 1e-3),
    parameters=st.dictionaries(
        st.text(st.characters(codec="utf-8", exclude_characters="\r"), max_size=8).filter(
            lambda key: key not in EffectEntry.model_fields
        ),
        numbers,
        max_size=4,
    ),
    name=st.text(st.characters(codec="utf-8"), min_size=1),
)
def test_every_number_round_trips_exactly(
    tmp_path_factory, mass, cog, damping, added, direction, parameters, name
):
    file = VehicleFile.model_validate(
        {
            "schema": 1,
            "name": name,
            "body": {
                "mass": mass,
                "inertia": np.eye(3),
                "cog": cog,
                "cob": (0, 0, 0),
                "mass_matrix": np.eye(6) * mass,
            },
            "added_mass": {"matrix": added},
            "damping": {"linear": np.array(damping), "quadratic": damping},
            "thruster": [
                {
                    "name": "only one",
                    "position": cog,
                    "direction": direction,
                    "max_thrust": mass,
                }
            ],
            "effect": [{"effect": "made_up", **parameters}],
        }
    )
    path = tmp_path_factory.mktemp("vehicle") / "v.toml"
    write_vehicle_file(file, path)
    again = read_vehicle_file(path)
    assert again == file
    assert np.array_equal(again.linear, damping)
    assert again.effect[0].parameters == parameters
    assert np.linalg.norm(again.thruster[0].direction) == pytest.approx(1, abs=1e-9)


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "vehicle.toml"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), written_whole(path) as beside:
        beside.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_who_reads_the_old_file_is_not_disturbed_by_a_write(tmp_path):
    path = tmp_path / "vehicle.toml"
    path.write_text("old")
    with path.open() as reader:
        with written_whole(path) as beside:
            beside.write_text("new")
        assert reader.read() == "old"
    assert path.read_text() == "new"


def test_a_folder_that_is_not_there_cannot_be_written_to(tmp_path):
    file = read(tmp_path, MINIMAL)
    with pytest.raises(InputError, match=r"nowhere.*cannot be written, because no such file"):
        write_vehicle_file(file, tmp_path / "nowhere" / "v.toml")


def test_the_shared_vehicles_are_read_and_kept(shared, tmp_path):
    for path in sorted((shared / "cases").glob("*/vehicle.toml")):
        file = read_vehicle_file(path)
        plain = tomllib.loads(path.read_text())
        assert file.thruster_names == tuple(one["name"] for one in plain["thruster"])
        assert np.array_equal(file.linear, plain["damping"]["linear"])
        assert file.sensors.stated() == plain["sensors"]
        assert file.weight == plain["body"]["weight"]
        write_vehicle_file(file, tmp_path / "copy.toml")
        assert read_vehicle_file(tmp_path / "copy.toml") == file
