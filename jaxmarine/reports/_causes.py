"""Each cause in words: a short title, and one sentence with its numbers.

All texts are plain; what stands between backticks is a name from a file. The page escapes both.
"""

import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from .._types import DOFS
from ..diagnosis import Finding
from ..logs import moment
from ..vehicle import Vehicle
from ._curves import CHANNEL_TITLES
from ._numbers import joined, number, percent, plus_minus, sentence, unit_on

_TITLES = {
    "steady_current": "steady current",
    "waves": "waves",
    "tether_drag": "drag of a cable",
    "wind_push": "push of the wind",
    "payload": "payload",
    "buoyancy": "buoyancy",
    "trim": "shifted centre of buoyancy",
    "hull_lift": "lift of the hull",
    "turning_lift": "lift of the hull in turns",
    "thrust_curve": "shape of the thrust curve",
    "thruster_lag": "lag of the thrusters",
    "input_delay": "delay of the commands",
    "deadband": "dead band of the thrusters",
    "saturation": "saturation of the thrusters",
    "inflow_loss": "thrust lost to the inflow",
    "velocity_lever_arm": "place of the velocity sensor",
    "velocity_scale": "scale of the velocity sensor",
    "velocity_misalignment": "misaligned velocity sensor",
    "velocity_in_earth_axes": "velocity logged in earth axes",
    "gyro_bias": "bias of the gyros",
    "compass_deviation": "deviation of the compass",
    "exchanged_thrusters": "exchanged columns of commands",
    "surface_lag": "lag of the control surfaces",
    "surface_rate": "rate of the control surfaces",
    "cross_flow_drag": "drag across the flow",
    "wind": "load of the wind",
    "voltage": "thrust by the battery's voltage",
}
_AXIS_TITLES = {
    "added_mass": "added mass in {}",
    "linear_damping": "linear damping in {}",
    "quadratic_damping": "quadratic damping in {}",
    "fluid_memory": "fluid memory in {}",
}
_KINDS = {
    "thruster_gain": "thrust of each thruster",
    "reverse_thrust": "thrust of each thruster astern",
    "constant_wrench": "constant force",
    "surface_gain": "force of each control surface",
    "surface_offset": "offset of each control surface",
    "surface_stuck": "each control surface stuck",
    "wake": "wake of each propeller",
}


_OF_SURFACE = {
    "surface_gain": "force",
    "surface_offset": "offset",
    "surface_stuck": "stuck deflection",
    "wake": "wake",
}


def title(label: str) -> str:
    """What a label such as `thruster_gain:port` accuses, in a few words."""
    name, _, target = label.partition(":")
    if name in _OF_SURFACE:
        who = "all control surfaces" if target == "all" else f"`{target}`"
        return f"{_OF_SURFACE[name]} of {who}"
    if name in ("thruster_gain", "reverse_thrust"):
        who = "all thrusters" if target == "all" else f"`{target}`"
        return f"thrust of {who}{' astern' if name == 'reverse_thrust' else ''}"
    if name == "coupled_damping" and "<-" in target:
        pushed, moving = target.split("<-", 1)
        return f"damping in {pushed} from motion in {moving}"
    if name == "coupled_added_mass" and "+" in target:
        return f"added mass between {' and '.join(target.split('+', 1))}"
    if name == "sensor_delay" and target:
        return f"late {target}"
    if name in ("constant_wrench", "unknown") and target:
        return f"{'constant' if name == 'constant_wrench' else 'unknown'} {_force(target)}"
    if name in _AXIS_TITLES and target:
        return _AXIS_TITLES[name].format(target)
    return _TITLES.get(name, name.replace("_", " ")) + (f" in {target}" if target else "")


def kind(name: str) -> str:
    """An effect's name without its target, in a few words."""
    return _KINDS.get(name) or _TITLES.get(name, name.replace("_", " "))


def signal(name: str) -> str:
    """A column of the log in words."""
    if name == "t":
        return "time `t`"
    words = CHANNEL_TITLES.get(name)
    return f"command of `{name}`" if words is None else f"{words.rpartition(' ')[0]} `{name}`"


def _force(dof: str) -> str:
    return f"{'moment' if dof in DOFS[3:] else 'force'} in {dof}"


def _pm(finding: Finding, name: str, scale: float = 1.0, unit: str | None = None) -> str:
    parameter = finding.parameters[name]
    shown = unit_on(parameter.unit, finding.target) if unit is None else unit
    return plus_minus(scale * parameter.value, abs(scale) * parameter.std, shown)


def _size(finding: Finding, name: str) -> str:
    """The parameter without its sign, which the sentence puts into words."""
    return _pm(finding, name, -1.0 if finding.parameters[name].value < 0 else 1.0)


def _value(finding: Finding, name: str) -> float:
    parameter = finding.parameters.get(name)
    return 0.0 if parameter is None else parameter.value


def _listed(finding: Finding, names: Iterable[str] = ()) -> str:
    """`north 0.10 ± 0.01 m/s, east …` of the parameters that there are."""
    wanted = [name for name in (tuple(names) or finding.parameters) if name in finding.parameters]
    return ", ".join(f"{name} {_pm(finding, name)}" for name in wanted)


def _place(finding: Finding, words: Mapping[str, tuple[str, str]]) -> str:
    """Coordinates in words; per coordinate those for a positive and for a negative one."""
    return joined(
        [
            f"{_size(finding, name)} {words[name][_value(finding, name) < 0]}"
            for name in words
            if name in finding.parameters
        ]
    )


_FROM_ORIGIN = {
    "x": ("ahead of", "behind"),
    "y": ("to starboard of", "to port of"),
    "z": ("below", "above"),
}
_SHIFTED = {
    "x": ("further forward", "further aft"),
    "y": ("further to starboard", "further to port"),
    "z": ("lower", "higher"),
}
_PUSHES = {
    "surge": ("pushes the vehicle forward", "pushes the vehicle backward"),
    "sway": ("pushes the vehicle to starboard", "pushes the vehicle to port"),
    "heave": ("pushes the vehicle down", "pushes the vehicle up"),
    "roll": ("rolls the vehicle to starboard", "rolls the vehicle to port"),
    "pitch": ("turns the bow up", "turns the bow down"),
    "yaw": ("turns the bow to starboard", "turns the bow to port"),
}


def _more(value: float) -> str:
    return "more" if value >= 0 else "less"


def _steady_current(f: Finding, v: Vehicle) -> str:
    north, east = _value(f, "north"), _value(f, "east")
    towards = round(math.degrees(math.atan2(east, north))) % 360
    speed = number(math.hypot(north, east), 2)
    return f"the water moves {speed} m/s towards {towards}° ({_listed(f)})"


def _waves(f: Finding, v: Vehicle) -> str:
    north, east = _value(f, "north"), _value(f, "east")
    along = round(math.degrees(math.atan2(east, north))) % 180
    force = number(math.hypot(north, east), 2)
    return (
        f"waves push the vehicle to and fro with up to {force} N along {along}°/{along + 180}°, "
        f"once in {_pm(f, 'period')} ({_listed(f, ('north', 'east', 'phase'))})"
    )


def _tether_drag(f: Finding, v: Vehicle) -> str:
    at_one = number(_value(f, "coefficient"), 2)
    return (
        f"something towed, such as a cable, drags with {at_one} N at 1 m/s and with the square of "
        f"the speed (coefficient {_pm(f, 'coefficient')})"
    )


def _wind_push(f: Finding, v: Vehicle) -> str:
    north, east = _value(f, "north"), _value(f, "east")
    towards = round(math.degrees(math.atan2(east, north))) % 360
    force = number(math.hypot(north, east), 2)
    return f"a steady force of {force} N, as of the wind, pushes towards {towards}° ({_listed(f)})"


def _changed(matrix: np.ndarray, f: Finding) -> str:
    """`(file 77, now 89)`: the coefficient of the file and what it comes to with the finding."""
    i = DOFS.index(f.target) if f.target in DOFS else 0
    file = float(np.asarray(matrix)[i, i])
    return f"(file {number(file)}, now {number(file + _value(f, 'value'))})"


def _added_mass(f: Finding, v: Vehicle) -> str:
    return (
        f"the vehicle carries {_size(f, 'value')} {_more(_value(f, 'value'))} added mass in "
        f"{f.target} than the file says {_changed(np.asarray(v.added_mass), f)}"
    )


def _payload(f: Finding, v: Vehicle) -> str:
    there = _value(f, "mass") >= 0
    text = f"{'a body of' if there else 'the vehicle lacks a body of'} {_size(f, 'mass')}"
    if "volume" in f.parameters:
        displaced = float(v.density) * _value(f, "volume")
        in_water = number((_value(f, "mass") - displaced) * float(v.gravity), 2)
        litres = _pm(f, "volume", 1000.0, "litres")
        text += f" and {litres}, which weighs {in_water} N in water,"
    return f"{text} {'sits' if there else 'at a place'} {_place(f, _FROM_ORIGIN)} the body origin"


def _buoyancy(f: Finding, v: Vehicle) -> str:
    force = _value(f, "force")
    kilograms = number(abs(force) / float(v.gravity), 2)
    return (
        f"the vehicle has {_size(f, 'force')} {_more(force)} buoyancy than the file says: in water "
        f"it is {kilograms} kg {'lighter' if force >= 0 else 'heavier'}"
    )


def _trim(f: Finding, v: Vehicle) -> str:
    return f"the centre of buoyancy lies {_place(f, _SHIFTED)} than the file says"


def _linear_damping(f: Finding, v: Vehicle) -> str:
    return (
        f"the vehicle has {_size(f, 'value')} {_more(_value(f, 'value'))} linear damping in "
        f"{f.target} than the file says {_changed(np.asarray(v.damping.linear), f)}"
    )


def _quadratic_damping(f: Finding, v: Vehicle) -> str:
    return (
        f"the vehicle has {_size(f, 'value')} {_more(_value(f, 'value'))} quadratic damping in "
        f"{f.target} than the file says {_changed(np.asarray(v.damping.quadratic), f)}"
    )


def _coupled_damping(f: Finding, v: Vehicle) -> str:
    pushed, _, moving = (f.target or "").partition("<-")
    return (
        f"motion in {moving} causes a {_force(pushed)} that the file does not have "
        f"(linear damping {_pm(f, 'value')})"
    )


def _coupled_added_mass(f: Finding, v: Vehicle) -> str:
    one, _, other = (f.target or "").partition("+")
    return (
        f"the water couples {one} and {other} otherwise than the file says: {_size(f, 'value')} "
        f"{_more(_value(f, 'value'))} added mass between them"
    )


def _hull_lift(f: Finding, v: Vehicle) -> str:
    return f"at an angle to the flow the hull feels a lift that the file does not have ({_listed(f)})"


def _turning_lift(f: Finding, v: Vehicle) -> str:
    return f"in turns at speed the hull feels a lift that the file does not have ({_listed(f)})"


def _fluid_memory(f: Finding, v: Vehicle) -> str:
    return (
        f"part of the damping in {f.target} comes late: {_pm(f, 'gain')}, building up over "
        f"{_pm(f, 'time_constant')}"
    )


def _constant_wrench(f: Finding, v: Vehicle) -> str:
    target = f.target or ""
    kind = "moment" if target in DOFS[3:] else "force"
    way = _PUSHES.get(target, ("acts", "acts"))[_value(f, "value") < 0]
    return f"a constant {kind} of {_size(f, 'value')} in {target} {way}"


def _thruster_gain(f: Finding, v: Vehicle) -> str:
    return _factor_of_thrust(f, "")


def _reverse_thrust(f: Finding, v: Vehicle) -> str:
    return _factor_of_thrust(f, "at negative commands ")


def _factor_of_thrust(f: Finding, when: str) -> str:
    factor = f.parameters["factor"]
    who = "all thrusters give" if f.target == "all" else f"thruster `{f.target}` gives"
    text = f"{when}{who} {_pm(f, 'factor')} times the thrust of the file"
    slack = 2 * factor.std if math.isfinite(factor.std) else 0.0
    if abs(factor.value) < 0.05 + slack:
        return f"{text}: commands are practically not acted on"
    return f"{text}: it pushes the wrong way" if factor.value < 0 else text


def _surface_gain(f: Finding, v: Vehicle) -> str:
    who = "all control surfaces give" if f.target == "all" else f"surface `{f.target}` gives"
    text = f"{who} {_pm(f, 'factor')} times the force of the file"
    return f"{text}: it acts the wrong way" if _value(f, "factor") < 0 else text


def _degrees(f: Finding, name: str) -> str:
    """An angle with its sign, and what is known of it."""
    angle = f.parameters[name]
    return f"{plus_minus(math.degrees(angle.value), math.degrees(angle.std))}°"


def _surface_offset(f: Finding, v: Vehicle) -> str:
    return f"surface `{f.target}` stands {_degrees(f, 'angle')} beside its command"


def _surface_stuck(f: Finding, v: Vehicle) -> str:
    return f"surface `{f.target}` is stuck at {_degrees(f, 'angle')}, whatever is commanded"


def _surface_lag(f: Finding, v: Vehicle) -> str:
    lag = _pm(f, "time_constant")
    return f"the control surfaces follow their commands with {lag} more lag than the file says"


def _surface_rate(f: Finding, v: Vehicle) -> str:
    return f"the control surfaces turn no faster than {_degrees(f, 'limit')}/s"


def _wake(f: Finding, v: Vehicle) -> str:
    fraction = _pm(f, "fraction")
    return f"the wake fraction of `{f.target}` is that of the file plus {fraction}"


def _cross_flow_drag(f: Finding, v: Vehicle) -> str:
    return f"the hull's drag coefficient across the flow is that of the file plus {_pm(f, 'coefficient')}"


def _wind(f: Finding, v: Vehicle) -> str:
    return f"the wind pushes otherwise than the file says (first harmonics plus {_listed(f)})"


def _voltage(f: Finding, v: Vehicle) -> str:
    share = number(100.0 * 0.9 ** _value(f, "exponent"), 2)
    return (
        f"thrust goes with the battery's voltage: at nine tenths of it there is {share} % as much (power "
        f"{_pm(f, 'exponent')} more than the file's)"
    )


def _thrust_curve(f: Finding, v: Vehicle) -> str:
    half = percent(1.0 - _value(f, "quadratic") / 2)
    return (
        f"thrust is not proportional to the command: at half command there is {half} of the file's "
        f"thrust, at full command all of it (quadratic part {_pm(f, 'quadratic')})"
    )


def _thruster_lag(f: Finding, v: Vehicle) -> str:
    return f"thrust follows the command with a lag of {_pm(f, 'time_constant')} (the time to 63 %)"


def _input_delay(f: Finding, v: Vehicle) -> str:
    return f"every command acts {_pm(f, 'delay')} late"


def _deadband(f: Finding, v: Vehicle) -> str:
    return (
        f"commands smaller than {_pm(f, 'width', 100.0, '%')} of full command do nothing, and "
        "larger ones lose as much"
    )


def _saturation(f: Finding, v: Vehicle) -> str:
    return f"commands beyond {_pm(f, 'limit', 100.0, '%')} of full command bring no more thrust"


def _inflow_loss(f: Finding, v: Vehicle) -> str:
    loss = _pm(f, "per_speed", 100.0, "%")
    return f"the thrusters lose {loss} of their thrust per m/s of speed along them"


def _velocity_lever_arm(f: Finding, v: Vehicle) -> str:
    return (
        f"the logged velocity is that of a point {_place(f, _FROM_ORIGIN)} the body origin, not of the origin"
    )


def _velocity_scale(f: Finding, v: Vehicle) -> str:
    factor = _value(f, "factor")
    wrong = f"{percent(abs(factor - 1))} too {'large' if factor >= 1 else 'small'}"
    return f"the logged velocity is {_pm(f, 'factor')} times the true one: {wrong}"


def _velocity_misalignment(f: Finding, v: Vehicle) -> str:
    yaw = f.parameters["yaw"]
    degrees = plus_minus(math.degrees(abs(yaw.value)), math.degrees(yaw.std))
    logged, sensor = ("starboard", "port") if yaw.value >= 0 else ("port", "starboard")
    return (
        f"the logged velocity is turned by {degrees}° to {logged}: the velocity sensor sits turned "
        f"by as much to {sensor}"
    )


def _velocity_in_earth_axes(f: Finding, v: Vehicle) -> str:
    fraction = f.parameters["fraction"]
    if fraction.value > 0.9:
        return (
            "the logged velocity is in earth axes (north, east, down) instead of body axes "
            f"(fraction {_pm(f, 'fraction')})"
        )
    part = _pm(f, "fraction", 100.0, "%")
    return f"{part} of the logged velocity is in earth axes (north, east, down), the rest in body axes"


def _gyro_bias(f: Finding, v: Vehicle) -> str:
    rates = ", ".join(
        f"{name} {plus_minus(math.degrees(p.value), math.degrees(p.std))} °/s"
        for name, p in f.parameters.items()
    )
    return f"the logged turning rates are the true ones plus a constant ({rates})"


def _compass_deviation(f: Finding, v: Vehicle) -> str:
    parts = [
        f"{plus_minus(math.degrees(f.parameters[name].value), math.degrees(f.parameters[name].std))}°{times}"
        for name, times in (("constant", ""), ("cos", " cos(psi)"), ("sin", " sin(psi)"))
    ]
    return f"the logged heading is the true one plus {' + '.join(parts)}"


def _sensor_delay(f: Finding, v: Vehicle) -> str:
    return f"the logged {f.target} comes {_pm(f, 'delay')} late"


def _exchanged_thrusters(f: Finding, v: Vehicle) -> str:
    first, _, second = str(f.target).partition("+")
    return f"the columns of `{first}` and `{second}` are exchanged: each holds the other's command"


def _unknown(f: Finding, v: Vehicle) -> str:
    text = f"a {_force(f.target or '')} acts on the vehicle that no known cause explains"
    if f.excess is None:
        return text
    e = f.excess
    return (
        f"{text}: {number(e.rms)} {e.unit} root mean square, at most {number(e.peak)} {e.unit}, from t = "
        f"{number(e.begin, 4)} to {number(e.end, 4)} s of `{e.log}`, {number(e.share, 2)} of the full thrust "
        f"in {e.strongest}"
    )


_SENTENCES: dict[str, Callable[[Finding, Vehicle], str]] = {
    "steady_current": _steady_current,
    "waves": _waves,
    "tether_drag": _tether_drag,
    "wind_push": _wind_push,
    "added_mass": _added_mass,
    "payload": _payload,
    "buoyancy": _buoyancy,
    "trim": _trim,
    "linear_damping": _linear_damping,
    "quadratic_damping": _quadratic_damping,
    "coupled_damping": _coupled_damping,
    "coupled_added_mass": _coupled_added_mass,
    "hull_lift": _hull_lift,
    "turning_lift": _turning_lift,
    "fluid_memory": _fluid_memory,
    "constant_wrench": _constant_wrench,
    "thruster_gain": _thruster_gain,
    "reverse_thrust": _reverse_thrust,
    "surface_gain": _surface_gain,
    "surface_offset": _surface_offset,
    "surface_stuck": _surface_stuck,
    "surface_lag": _surface_lag,
    "surface_rate": _surface_rate,
    "wake": _wake,
    "cross_flow_drag": _cross_flow_drag,
    "wind": _wind,
    "voltage": _voltage,
    "thrust_curve": _thrust_curve,
    "thruster_lag": _thruster_lag,
    "input_delay": _input_delay,
    "deadband": _deadband,
    "saturation": _saturation,
    "inflow_loss": _inflow_loss,
    "velocity_lever_arm": _velocity_lever_arm,
    "velocity_scale": _velocity_scale,
    "velocity_misalignment": _velocity_misalignment,
    "velocity_in_earth_axes": _velocity_in_earth_axes,
    "gyro_bias": _gyro_bias,
    "compass_deviation": _compass_deviation,
    "sensor_delay": _sensor_delay,
    "exchanged_thrusters": _exchanged_thrusters,
    "unknown": _unknown,
}


def what(finding: Finding, vehicle: Vehicle, clock: float = 0.0) -> str:
    """The finding in one sentence, with its numbers and since when it holds.

    - `clock`: what the clock of the log in which it begins shows at that log's start [s].
    """
    told = _SENTENCES.get(finding.effect)
    # Without a sentence of its own: an effect that a user has added to the catalogue.
    text = told(finding, vehicle) if told else f"{title(finding.label)} ({_listed(finding)})"
    if finding.since is not None:
        text += f", since {moment(finding.since, clock)}"
        text += f" of `{finding.since_log}`" if finding.since_log else ""
    return sentence(text)
