"""Vehicle files made of what other programs have."""

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxmarine as jm
from jaxmarine._errors import InputError
from jaxmarine.cli import app
from jaxmarine.exports import export
from jaxmarine.imports import import_vehicle
from tests.crafts import packaged

# By hand, as people write them: added mass in the plug-in, which Gazebo wants negative; forward-left-up.
WORLD = """<sdf version="1.11"><world name="w"><gravity>0 0 -9.81</gravity>
<plugin filename="gz-sim-buoyancy-system" name="gz::sim::systems::Buoyancy">
  <uniform_fluid_density>1000</uniform_fluid_density></plugin>
<model name="rov">
  <link name="hull"><pose>1 0 0 0 0 0</pose>
    <inertial><pose>0.1 0 -0.2 0 0 0</pose><mass>10</mass>
      <inertia><ixx>1</ixx><iyy>2</iyy><izz>3</izz></inertia></inertial>
    <collision name="c"><pose>0 0.05 0.1 0 0 0</pose>
      <geometry><box><size>0.5 0.2 0.1</size></box></geometry></collision></link>
  <link name="screw"><pose>0.5 0.3 0 0 0 0</pose><inertial><mass>0.1</mass></inertial></link>
  <link name="arm"><inertial><mass>1</mass></inertial></link>
  <joint name="left_joint" type="revolute"><parent>hull</parent><child>screw</child>
    <axis><xyz>1 0 0</xyz></axis></joint>
  <plugin filename="gz-sim-thruster-system" name="gz::sim::systems::Thruster">
    <joint_name>left_joint</joint_name><max_thrust_cmd>50</max_thrust_cmd>
    <min_thrust_cmd>-40</min_thrust_cmd></plugin>
  <plugin filename="gz-sim-hydrodynamics-system" name="gz::sim::systems::Hydrodynamics">
    <link_name>hull</link_name><xDotU>-5</xDotU><nDotR>-0.5</nDotR><xU>-4</xU><yR>-2</yR>
    <yVabsV>-30</yVabsV><yVabsR>-7</yVabsR></plugin>
</model></world></sdf>"""


def test_a_world_of_gazebo_is_read_by_hand_worked_numbers(tmp_path):
    (tmp_path / "rov.sdf").write_text(WORLD)
    done = CliRunner().invoke(app, ["import", str(tmp_path / "rov.sdf"), "--out", str(tmp_path / "rov.toml")])
    assert done.exit_code == 0, done.output
    assert "yVabsR" in done.output and "arm" in done.output
    assert "# Imported from rov.sdf." in (tmp_path / "rov.toml").read_text(encoding="utf-8")
    rov = jm.load_vehicle(tmp_path / "rov.toml")
    assert float(rov.body.buoyancy) == pytest.approx(1000 * 9.81 * 0.01)
    assert np.allclose(rov.body.cog, [0.1, 0.0, 0.2]) and np.allclose(rov.body.cob, [0.0, -0.05, -0.1])
    # Parallel axes: 1 + 10 * 0.2², 2 + 10 (0.1² + 0.2²), 3 + 10 * 0.1².
    assert np.allclose(np.diag(rov.body.matrix)[3:], [1.4, 2.5, 3.1])
    assert rov.added_mass[0, 0] == 5.0 and rov.added_mass[5, 5] == 0.5
    # Left and up are to port and upwards here: the force to port by a turn to port is one to starboard by one
    # to starboard.
    assert rov.damping.linear[0, 0] == 4.0 and rov.damping.linear[1, 5] == 2.0
    assert rov.damping.quadratic[1, 1] == 30.0
    assert np.allclose(rov.thrusters.position, [[-0.5, -0.3, 0.0]])
    assert rov.thruster_names == ("left",)
    assert rov.thrusters.max_thrust[0] == 50.0 and rov.thrusters.reverse[0] == 40.0


def test_what_was_exported_to_gazebo_comes_back(tmp_path):
    vehicle = packaged("tethra")
    export(vehicle, tmp_path / "rov.sdf", "sdf")
    import_vehicle(tmp_path / "rov.sdf", tmp_path / "rov.toml")
    back = jm.load_vehicle(tmp_path / "rov.toml").plant()
    plant = vehicle.plant()
    down = jnp.array([0.3, -0.2, 0.9])
    assert np.allclose(back.load.rigid, plant.load.rigid) and np.allclose(back.load.added, plant.load.added)
    assert np.allclose(back.damping.linear, plant.damping.linear)
    assert np.allclose(back.damping.quadratic, plant.damping.quadratic)
    assert np.allclose(back.load.restoring(down), plant.load.restoring(down))
    assert np.allclose(back.allocation, plant.allocation)
    assert np.allclose(back.drive.max_thrust, plant.drive.max_thrust)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("Hydrodynamics", "Hydro"), "no model with a plug-in Hydrodynamics"),
        (("<link_name>hull", "<link_name>boat"), "no link `boat`"),
        (("<mass>10</mass>", "<mass>ten</mass>"), "which are no numbers"),
        (("<mass>10</mass>", "<mass>-10</mass>"), "mass"),
        (("</world></sdf>", ""), "is not valid XML"),
        (("<sdf", "<!DOCTYPE a [<!ENTITY b 'c'>]><sdf"), "declares entities"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(change, said, tmp_path):
    (tmp_path / "rov.sdf").write_text(WORLD.replace(*change))
    with pytest.raises(InputError, match=said):
        import_vehicle(tmp_path / "rov.sdf", tmp_path / "rov.toml")
    assert not (tmp_path / "rov.toml").exists()


@pytest.mark.parametrize("suffix", [".py", ".m"])
def test_a_script_of_derivatives_is_worked_out_and_not_run(suffix, tmp_path):
    mark, end, power, row = (
        ("#", "", "**", "0.1, 0, 0.02") if suffix == ".py" else ("%", ";", "^", "0.1 0 0.02")
    )
    lines = [
        f"m = 20 / 2{end}   {mark} mass (kg)",
        f"R = 0.5{end}",
        f"Ig = [m * R{power}2, 3, 4]{end}",
        f"rg = [{row}]{end}",
        f"Xudot = -0.1 * m{end}",
        f"Yrdot = 0.5{end}",
        f"Nrdot = -2{end}",
        f"Xu = -3{end}",
        f"X_uabsu = -4{end}",
        f"Nrr = -5{end}",
        f"Kp = 7{end}",
        "open('/nowhere/else', 'w')",
        f"Zw = __import__('os').getpid(){end}",
    ]
    (tmp_path / f"boat{suffix}").write_text("\n".join(lines))
    notes = import_vehicle(tmp_path / f"boat{suffix}", tmp_path / "boat.toml")
    assert any("feed energy" in note and "Kp" in note for note in notes)
    assert any("no arithmetic" in note and "Zw" in note for note in notes)
    boat = jm.load_vehicle(tmp_path / "boat.toml")
    assert float(boat.body.mass) == 10.0 and np.allclose(boat.body.cog, [0.1, 0.0, 0.02])
    # Parallel axes: 10 * 0.5² + 10 * 0.02², 3 + 10 (0.1² + 0.02²), 4 + 10 * 0.1².
    assert np.allclose(np.diag(boat.body.matrix)[3:], [2.504, 3.104, 4.1])
    assert (
        boat.added_mass[0, 0] == 1.0
        and boat.added_mass[5, 1] == boat.added_mass[1, 5] == -0.5
        and boat.added_mass[5, 5] == 2.0
    )
    assert boat.damping.linear[0, 0] == 3.0 and boat.damping.linear[2, 2] == 0.0
    assert boat.damping.quadratic[0, 0] == 4.0 and boat.damping.quadratic[5, 5] == 5.0


def test_a_script_without_a_vehicle_is_said(tmp_path):
    (tmp_path / "plot.py").write_text("x = 1\n")
    with pytest.raises(InputError, match=r"no lines such as `m = 11.5`"):
        import_vehicle(tmp_path / "plot.py", tmp_path / "boat.toml")
    (tmp_path / "otter.py").write_text("m = 55\nXudot = -5\nIg = m * other\n")
    with pytest.raises(InputError, match="no inertia that can be worked out"):
        import_vehicle(tmp_path / "otter.py", tmp_path / "boat.toml")
    with pytest.raises(InputError, match=r"known are \.m, \.py, \.sdf, \.world"):
        import_vehicle(tmp_path / "boat.step", tmp_path / "boat.toml")
