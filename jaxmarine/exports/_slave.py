"""What runs inside an FMU: this file is copied into it, and knows nothing of jaxmarine."""

import json
import math
from pathlib import Path

import casadi
from pythonfmu3 import (
    DefaultExperiment,
    Float64,
    Fmi3Causality,
    Fmi3Slave,
    Fmi3StepResult,
    Fmi3Variability,
    Unit,
)

# Where the vehicle begins: position [m] NED, roll, pitch, yaw [rad], body velocities [m/s, rad/s].
_PARTS = {"position": 3, "attitude": 3, "velocity": 6}
# The control wrench at `o` beside the commands, body axes [N, N m].
_WRENCH = {"X": "N", "Y": "N", "Z": "N", "K": "N m", "M": "N m", "N": "N m"}
# Units by powers of the SI's own; a share has none.
_UNITS = {
    "m": {"m": 1},
    "s": {"s": 1},
    "rad": {"rad": 1},
    "m/s": {"m": 1, "s": -1},
    "rad/s": {"rad": 1, "s": -1},
    "rev/s": {"rad": 1, "s": -1, "factor": 2.0 * math.pi},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N m": {"kg": 1, "m": 2, "s": -2},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
}


class MarineVehicle(Fmi3Slave):
    """Inputs: commands and wrench, held over each step; outputs: position, attitude, velocity."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        folder = Path(str(self.resources))
        told = json.loads((folder / "model.json").read_text(encoding="utf-8"))
        self._functions = {
            name: casadi.Function.deserialize((folder / f"{name}.casadi").read_text(encoding="utf-8"))
            for name in ("start", "step", "shown")
        }
        self._longest = told["longest_step"]
        self._inputs = dict.fromkeys((*told["command"], *_WRENCH), 0.0)
        self._commands = tuple(told["command"])
        self._begin = dict.fromkeys((f"{name}_start" for name in told["shown"]), 0.0)
        self._state = None
        self.modelName = told["identifier"]
        self.description = " ".join([told["vehicle"] + ".", *told["notes"]])
        self.default_experiment = DefaultExperiment(start_time=0.0, step_size=told["longest_step"])

        units = {**_WRENCH, **{name: unit for name, unit in told["units"].items() if unit in _UNITS}}
        self._unit = {**units, **{f"{name}_start": units[name] for name in told["shown"]}, "time": "s"}
        self.register_units([Unit(name, **_UNITS[name]) for name in dict.fromkeys(self._unit.values())])

        self.time = 0.0
        causality, variability = Fmi3Causality, Fmi3Variability
        self.register_variable(
            Float64(
                "time",
                causality=causality.independent,
                variability=variability.continuous,
                unit=self._unit["time"],
            )
        )
        for name in self._begin:
            self._register(name, self._begin, causality.parameter, variability.fixed)
        for name in self._inputs:
            self._register(name, self._inputs, causality.input, variability.continuous)
        for k, name in enumerate(told["shown"]):
            self.register_variable(
                Float64(
                    name,
                    causality=causality.output,
                    variability=variability.continuous,
                    unit=self._unit[name],
                    getter=lambda k=k: self._shown()[k],
                )
            )

    def _register(self, name, values, causality, variability):
        self.register_variable(
            Float64(
                name,
                causality=causality,
                variability=variability,
                unit=self._unit.get(name),
                getter=lambda: values[name],
                setter=lambda value: values.__setitem__(name, value),
            )
        )

    def _command(self):
        return [self._inputs[name] for name in self._commands]

    def _begun(self):
        """The first state: the commands have acted long."""
        values, parts = list(self._begin.values()), []
        for size in _PARTS.values():
            parts.append(values[:size])
            values = values[size:]
        return self._functions["start"](*parts, self._command())

    def _shown(self):
        state = self._begun() if self._state is None else self._state
        return [float(one) for one in self._functions["shown"](state).full().ravel()]

    def do_step(self, current_time, step_size):
        state = self._begun() if self._state is None else self._state
        command, wrench = self._command(), [self._inputs[name] for name in _WRENCH]
        # A step that is one by more than rounding is cut in equal parts.
        count = max(1, math.ceil(step_size / self._longest - 1e-9))
        part = step_size / count
        for k in range(count):
            state = self._functions["step"](state, command, wrench, current_time + k * part, part)
        self._state = state
        self.time = current_time + step_size
        return Fmi3StepResult()
