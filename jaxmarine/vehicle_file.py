"""The vehicle file: what the user believes of a vehicle, checked, as plain numbers.

SI units and radians; body axes about the origin `o`. Damping and added mass carry the positive
sign.
"""

import functools
import os
import textwrap
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import pydantic
import tomli_w
from jaxtyping import Float
from pydantic import Field

from ._errors import InputError
from ._files import did_you_mean, read_toml, validated, written_whole
from ._tables import Number, Rows3, Rows6, Table, Triple, finite, unit_direction, usable_name
from ._types import DOFS, TABLE
from .actuators import KINDS, AbstractActuators, AbstractKind, AbstractMasses, Supply, Swivels

# Published inertia matrices are printed to a few digits.
_SYMMETRY = 1e-6
# Of a share of the command that acts as c|c|. Below, more command would bring less thrust before it is full;
# above, the lower half of all commands would push the wrong way.
_CURVED = (-1.0, 2.0)
_WIDEST_COMMENT = 108
_SHARE = "a positive number, a share of the value"

_Sort = TypeVar("_Sort", bound=AbstractKind)


class Environment(Table):
    """Water and gravity."""

    density: Number = Field(default=1025.0, gt=0, description="a positive number [kg/m³]")
    gravity: Number = Field(default=9.81, gt=0, description="a positive number [m/s²]")


class Body(Table):
    """The rigid body, about `o`."""

    mass: Number = Field(gt=0, description="a positive number [kg]")
    inertia: Rows3 | None = Field(
        default=None, description="3 rows of 3 numbers [kg m²], the inertia about `o`"
    )
    cog: Triple = Field(description="[x, y, z] of the centre of gravity from `o` [m]")
    cob: Triple = Field(description="[x, y, z] of the centre of buoyancy from `o` [m]")
    weight: Number | None = Field(
        default=None,
        ge=0,
        description="a number not below zero [N]; left out, mass * gravity",
    )
    buoyancy: Number | None = Field(
        default=None, ge=0, description="a number not below zero [N]; left out, the weight"
    )
    mass_matrix: Rows6 | None = Field(
        default=None,
        description="6 rows of 6 numbers, used as M_RB instead of what mass, inertia and cog give",
    )

    @pydantic.field_validator("inertia")
    @classmethod
    def _proper_inertia(cls, inertia: Rows3 | None) -> Rows3 | None:
        if inertia is not None:
            _check_symmetric(np.array(inertia))
        return inertia

    @pydantic.field_validator("mass_matrix")
    @classmethod
    def _proper_mass_matrix(cls, matrix: Rows6 | None) -> Rows6 | None:
        if matrix is not None:
            _check_symmetric(np.array(matrix))
        return matrix

    @pydantic.model_validator(mode="after")
    def _has_inertia(self) -> "Body":
        if self.inertia is None and self.mass_matrix is None:
            raise ValueError("lacks `inertia`; give 3 rows of 3 numbers [kg m²], the inertia about `o`.")
        return self


class AddedMass(Table):
    """Added mass M_A, positive sign."""

    matrix: Rows6 = Field(description="6 rows of 6 numbers (M_A), or 6 numbers for a diagonal")


class Damping(Table):
    """D_l on nu and D_q on |nu_j| nu_j, positive sign."""

    linear: Rows6 = Field(description="6 rows of 6 numbers (D_l), or 6 numbers for a diagonal")
    quadratic: Rows6 = Field(description="6 rows of 6 numbers (D_q), or 6 numbers for a diagonal")


class Thruster(Table):
    """One actuator with a command column of its name."""

    name: str = Field(description="the name of the thruster's command column, in quotes")
    position: Triple = Field(description="[x, y, z] from `o` [m]")
    direction: Triple = Field(description="[x, y, z], not zero: where positive thrust pushes")
    max_thrust: Number = Field(gt=0, description="a positive number, the thrust at command 1 [N]")
    max_thrust_reverse: Number | None = Field(
        default=None,
        gt=0,
        description="a positive number, the thrust at command -1 [N]; left out, max_thrust",
    )
    quadratic: Number = Field(
        default=0.0,
        ge=_CURVED[0],
        le=_CURVED[1],
        exclude_if=lambda quadratic: quadratic == 0.0,
        description=f"a number from {_CURVED[0]:g} to {_CURVED[1]:g}, share of the command that acts as c|c|",
    )
    advance_loss: Number = Field(
        default=0.0,
        exclude_if=lambda loss: loss == 0.0,
        description="a number, the thrust that 1 m/s of flow past it takes at command 1 [N s/m]",
    )
    deadband: Number = Field(default=0.0, ge=0, description="a number not below zero [command]")
    lag: Number = Field(default=0.0, ge=0, description="a number not below zero [s]")
    delay: Number = Field(default=0.0, ge=0, description="a number not below zero [s]")
    saturation: Number = Field(default=1.0, gt=0, description="a positive number [command]")
    swivel: Triple | None = Field(
        default=None, description="[x, y, z], not zero: the axis about which its direction turns"
    )
    nominal_voltage: Number | None = Field(
        default=None, gt=0, description="a positive number, the battery's at which it gives max_thrust [V]"
    )
    voltage_exponent: Number = Field(
        default=1.0, description="a number", exclude_if=lambda exponent: exponent == 1.0
    )

    _usable_name = pydantic.field_validator("name")(usable_name)
    _unit_direction = pydantic.field_validator("direction")(unit_direction)

    @pydantic.field_validator("swivel")
    @classmethod
    def _unit_axis(cls, swivel: Triple | None) -> tuple[float, ...] | None:
        return None if swivel is None else unit_direction(swivel)

    @pydantic.model_validator(mode="after")
    def _stands_still(self) -> "Thruster":
        if self.swivel is not None and self.advance_loss != 0.0:
            raise ValueError("has `swivel` and `advance_loss`, which is of fixed thrusters; leave out one.")
        return self


class _Sensors(Table):
    """Standard deviations of white noise; what is absent is estimated from the log."""

    def stated(self) -> dict[str, float]:
        """The kinds that are given, with their standard deviations in SI units."""
        return self.model_dump(exclude_none=True)


if TYPE_CHECKING:
    Sensors = _Sensors
else:
    # A key for each line of the table of sensors.
    Sensors = pydantic.create_model(
        "Sensors",
        __base__=_Sensors,
        **{
            one.kind: (
                Number | None,
                Field(default=None, gt=0, description=f"a positive number [{one.unit}]"),
            )
            for one in TABLE
        },
    )


class Prior(Table):
    """How far sections of the file may be off: one standard deviation, as a share of each number's value.

    0.4 is a factor of 1.5, 0.7 one of 2. Where a section has none, it is for the reader to say.
    """

    added_mass: Number | None = Field(default=None, gt=0, description=_SHARE)
    linear: Number | None = Field(default=None, gt=0, description=_SHARE)
    quadratic: Number | None = Field(default=None, gt=0, description=_SHARE)
    thrust: Number | None = Field(default=None, gt=0, description=_SHARE)
    propeller: Number | None = Field(default=None, gt=0, description=_SHARE)
    surface: Number | None = Field(default=None, gt=0, description=_SHARE)
    lift: Number | None = Field(default=None, gt=0, description=_SHARE)

    def stated(self) -> dict[str, float]:
        """The sections that have one."""
        return self.model_dump(exclude_none=True)


class EffectEntry(Table):
    """One change that a diagnosis has added; all other keys of its table are `parameters`."""

    effect: str = Field(min_length=1, description="the name of an effect, in quotes")
    target: str | None = Field(default=None, description="a name in quotes")
    since: Number | None = Field(default=None, description="a finite number [s]")
    since_log: str | None = Field(default=None, description="the file name of a log, in quotes")
    arrays: str | None = Field(default=None, description="the name of a file beside this one")
    inputs: tuple[str, ...] = Field(default=(), description="a list of signal names in quotes")
    parameters: dict[str, Number] = Field(default={}, description="numbers by name")

    @pydantic.model_validator(mode="before")
    @classmethod
    def _gather_parameters(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or isinstance(data.get("parameters"), Mapping):
            return data
        own = {key: value for key, value in data.items() if key in cls.model_fields}
        parameters = {key: value for key, value in data.items() if key not in own}
        if "parameters" in own:
            raise ValueError("has a key `parameters`; write each parameter as a key of its own.")
        for key, value in parameters.items():
            try:
                finite(value)
            except ValueError as error:
                raise ValueError(
                    f"has a key `{key}` that {error} Parameters are numbers; other keys are "
                    f"{', '.join(name for name in cls.model_fields if name != 'parameters')}."
                ) from error
        return own | {"parameters": parameters}

    @pydantic.field_validator("arrays")
    @classmethod
    def _plain_file_name(cls, arrays: str | None) -> str | None:
        if arrays is not None and (
            arrays in ("", ".", "..") or not arrays.isprintable() or set(arrays) & set("/\\:")
        ):
            raise ValueError(
                f"is {arrays!r:.60}, but must be a plain file name without folders; put the file "
                "beside this one."
            )
        return arrays

    @pydantic.model_validator(mode="after")
    def _since_has_a_time(self) -> "EffectEntry":
        if self.since_log is not None and self.since is None:
            raise ValueError("has `since_log` without `since`; give the time in that log [s].")
        return self


class AnyVehicleFile(Table):
    """The vehicle file as it stands, with 6-number diagonals written out.

    Actuators beside thrusters have tables `[[key]]` by their kind: see `file_model`.
    """

    kinds: ClassVar[tuple[type[AbstractKind], ...]] = ()

    schema_version: int = Field(alias="schema", strict=True, description="1")
    name: str = Field(min_length=1, description="the vehicle's name, in quotes")
    dof: tuple[str, ...] = Field(
        default=DOFS, description=f"a list of free degrees of freedom out of {', '.join(DOFS)}"
    )
    environment: Environment = Field(default=Environment(), description="a table [environment]")
    body: Body = Field(description="a table [body] with mass, inertia, cog and cob")
    added_mass: AddedMass = Field(description="a table [added_mass] with matrix")
    damping: Damping = Field(description="a table [damping] with linear and quadratic")
    thruster: tuple[Thruster, ...] = Field(default=(), description="tables [[thruster]]")
    sensors: Sensors = Field(default=Sensors(), description="a table [sensors]")
    prior: Prior = Field(default=Prior(), description="a table [prior]")
    effect: tuple[EffectEntry, ...] = Field(default=(), description="tables [[effect]]")

    @pydantic.field_validator("schema_version")
    @classmethod
    def _known_schema(cls, version: int) -> int:
        if version != 1:
            raise ValueError(f"is {version}, but only 1 is known; use a newer jaxmarine.")
        return version

    @pydantic.field_validator("dof")
    @classmethod
    def _known_dof(cls, dof: tuple[str, ...]) -> tuple[str, ...]:
        for name in dof:
            if name not in DOFS:
                raise ValueError(
                    f"holds {name!r:.60}, which is no degree of freedom; {did_you_mean(name, DOFS)}"
                )
        if not dof or len(set(dof)) < len(dof):
            raise ValueError(
                f"is {list(dof)}, but must name each free degree of freedom once, and at least one."
            )
        return tuple(name for name in DOFS if name in dof)

    @pydantic.field_validator("thruster")
    @classmethod
    def _names_once(cls, thruster: tuple[Thruster, ...]) -> tuple[Thruster, ...]:
        names = [one.name for one in thruster]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"has the name `{twice}` more than once; name each thruster its own.")
        return thruster

    @pydantic.model_validator(mode="after")
    def _actuators_apart(self) -> "AnyVehicleFile":
        several = [kind.key for kind in self.kinds if not kind.single]
        tables = [(key, one) for key in several for one in getattr(self, key)]
        names = list(self.thruster_names)
        for key, one in tables:
            if one.name in names:
                raise ValueError(
                    f"`{key}.name` is `{one.name}`, as another actuator's is; name each its own."
                )
            names.append(one.name)
        propellers = [one.name for key, one in tables if key == "propeller"]
        for key, one in tables:
            behind = getattr(one, "behind", None)
            if behind is not None and behind not in propellers:
                raise ValueError(
                    f"`{key}.behind` of `{one.name}` is `{behind}`, which is no propeller; "
                    + (did_you_mean(behind, propellers) if propellers else "add its table [[propeller]].")
                )
        return self

    @pydantic.model_validator(mode="after")
    def _goes_with_its_kinds(self) -> "AnyVehicleFile":
        names = list(self.drive_names)
        for one in self.masses:
            for name in one.columns:
                if name in names:
                    whose = "a thruster's" if name in self.thruster_names else "another actuator's"
                    raise ValueError(f"`{one.key}.name` is `{name}`, as {whose} is; choose another.")
            names += one.columns
        for kind in self.kinds:
            kind.check(self._tables_of(kind), self.body.mass)
        return self

    @pydantic.model_validator(mode="after")
    def _accelerates(self) -> "AnyVehicleFile":
        free = np.isin(DOFS, self.dof)
        if self.body.inertia is not None:
            inertia = np.array(self.body.inertia)
            turning = inertia[np.ix_(free[3:], free[3:])]
            # about a locked axis nobody need know the inertia, and zero stands for that
            if not _positive_definite(turning) or np.linalg.eigvalsh(inertia)[0] < -1e-12:
                raise ValueError(
                    "`body.inertia` must be positive definite, as that of any body is; check its "
                    "signs and products of inertia."
                )
        total = self.rigid_body_matrix + self.added_mass_matrix
        if not _positive_definite(((total + total.T) / 2)[np.ix_(free, free)]):
            raise ValueError(
                "The mass of body and added mass together must be positive definite on the free "
                "degrees of freedom, but is not; check the signs of `added_mass.matrix`, and that "
                "`body.inertia` is about `o`, not about the centre of gravity."
            )
        return self

    @property
    def thruster_names(self) -> tuple[str, ...]:
        """Names of the command columns, in the file's order."""
        return tuple(thruster.name for thruster in self.thruster)

    @property
    def actuators(self) -> tuple[AbstractActuators, ...]:
        """Those beside the thrusters, kind by kind."""
        out: list[AbstractActuators] = []
        if any(one.swivel is not None for one in self.thruster):
            out.append(Swivels.of(self.thruster))
        if any(one.nominal_voltage is not None for one in self.thruster):
            out.append(Supply.of(self.thruster))
        return *out, *self._made(AbstractActuators)

    @property
    def masses(self) -> tuple[AbstractMasses, ...]:
        """Those that move inside, kind by kind."""
        return self._made(AbstractMasses)

    def _tables_of(self, kind: type[AbstractKind]) -> tuple[Any, ...]:
        those = getattr(self, kind.key)
        if not kind.single:
            return those
        return () if those is None else (those,)

    def _made(self, sort: type[_Sort]) -> tuple[_Sort, ...]:
        """Those of the file's kinds that are of one sort."""
        tables = [(kind, self._tables_of(kind)) for kind in self.kinds if issubclass(kind, sort)]
        return tuple(kind.of(those) for kind, those in tables if those)

    @property
    def drive_names(self) -> tuple[str, ...]:
        """Names of the command columns of thrusters and, behind them, of other actuators."""
        return *self.thruster_names, *(name for one in self.actuators for name in one.columns)

    @property
    def command_names(self) -> tuple[str, ...]:
        """Names of all command columns: the thrusters, other actuators and, last, masses inside."""
        return *self.drive_names, *(name for one in self.masses for name in one.columns)

    @property
    def command_limits(self) -> Float[np.ndarray, " columns"]:
        """The largest |command| that a log may hold: a saturation above 1 widens [-1, 1]."""
        limits = [max(1.0, thruster.saturation) for thruster in self.thruster]
        limits += [limit for one in (*self.actuators, *self.masses) for limit in one.limits]
        return np.array(limits, float)

    @property
    def weight(self) -> float:
        """Weight [N]."""
        body = self.body
        return body.mass * self.environment.gravity if body.weight is None else body.weight

    @property
    def buoyancy(self) -> float:
        """Buoyancy of the whole vehicle [N]."""
        return self.weight if self.body.buoyancy is None else self.body.buoyancy

    @property
    def rigid_body_matrix(self) -> Float[np.ndarray, "6 6"]:
        """M_RB about `o` [kg, kg m, kg m²]."""
        if self.body.mass_matrix is not None:
            return np.array(self.body.mass_matrix)
        return rigid_body(self.body.mass, np.array(self.body.inertia), self.body.cog)

    @property
    def added_mass_matrix(self) -> Float[np.ndarray, "6 6"]:
        """M_A [kg, kg m, kg m²]."""
        return np.array(self.added_mass.matrix)

    @property
    def linear(self) -> Float[np.ndarray, "6 6"]:
        """D_l, the force on row i per velocity j."""
        return np.array(self.damping.linear)

    @property
    def quadratic(self) -> Float[np.ndarray, "6 6"]:
        """D_q, the force on row i per |nu_j| nu_j."""
        return np.array(self.damping.quadratic)


def rigid_body(
    mass: float, inertia: Float[np.ndarray, "3 3"], cog: Iterable[float]
) -> Float[np.ndarray, "6 6"]:
    """M_RB about `o` of a mass [kg] and an inertia [kg m²]: [[m I, -m S(cog)], [m S(cog), inertia]]."""
    x, y, z = cog
    moment = mass * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[mass * np.eye(3), -moment], [moment, inertia]])


@functools.cache
def file_model(kinds: tuple[type[AbstractKind], ...]) -> type["AnyVehicleFile"]:
    """The vehicle file with tables of these kinds of actuators."""
    fields: dict[str, Any] = {
        kind.key: (kind.table | None, Field(default=None, description=f"a table [{kind.key}]"))
        if kind.single
        else (tuple[kind.table, ...], Field(default=(), description=f"tables [[{kind.key}]]"))
        for kind in kinds
    }
    model = pydantic.create_model("VehicleFile", __base__=AnyVehicleFile, **fields)
    model.kinds = kinds
    return model


if TYPE_CHECKING:
    VehicleFile = AnyVehicleFile
else:
    VehicleFile = file_model(KINDS)


CheckEffect = Callable[[EffectEntry, AnyVehicleFile], None]


def read_vehicle_file(
    path: str | os.PathLike[str],
    check_effect: CheckEffect | None = None,
    kinds: tuple[type[AbstractKind], ...] = KINDS,
) -> AnyVehicleFile:
    """Read and check a vehicle file; raises `InputError` with one sentence.

    - `check_effect` raises a `ValueError` for an effect that it does not know; its message continues
      a sentence that begins with the entry, such as "names no known effect".
    - `kinds`: of actuators, beside thrusters, that may have tables.
    """
    file = validated(file_model(kinds), read_toml(path), str(path))
    for number, entry in enumerate(file.effect, start=1):
        try:
            if check_effect is not None:
                check_effect(entry, file)
        except ValueError as error:
            raise InputError(f"{path}: `effect[{number}]` {error}") from error
    return file


def write_vehicle_file(
    file: AnyVehicleFile,
    path: str | os.PathLike[str],
    head: Iterable[str] = (),
    notes: Mapping[str, Iterable[str]] = MappingProxyType({}),
) -> None:
    """Write the file as TOML, whole or not at all; every number keeps all its digits.

    - `head`: comments before the first key.
    - `notes`: comments before a table, or before the first of several, by its key.
    """
    with written_whole(path) as beside:
        Path(beside).write_text(_comments(head) + _toml(file, notes), encoding="utf-8")


def _comments(lines: Iterable[str]) -> str:
    wrap = textwrap.TextWrapper(_WIDEST_COMMENT, break_long_words=False, break_on_hyphens=False).wrap
    return "".join(f"# {part}\n" for line in lines for part in wrap(line))


def _toml(file: AnyVehicleFile, notes: Mapping[str, Iterable[str]]) -> str:
    data = file.model_dump(by_alias=True, exclude_none=True)
    tables = {key: value for key, value in data.items() if isinstance(value, dict) and value}
    keys = ("thruster", *(kind.key for kind in file.kinds if not kind.single))
    entries = [(key, entry) for key in keys for entry in data[key]]
    for entry in data["effect"]:
        parameters = entry.pop("parameters")
        inputs = entry.pop("inputs")
        entries.append(("effect", entry | ({"inputs": inputs} if inputs else {}) | parameters))
    top = {key: value for key, value in data.items() if key in ("schema", "name", "dof")}
    parts = ["".join(map(_line, top.items()))]
    parts += [
        _comments(notes.get(key, ())) + f"[{key}]\n" + "".join(map(_line, table.items()))
        for key, table in tables.items()
    ]
    said = set()
    for key, entry in entries:
        told = () if key in said else notes.get(key, ())
        parts.append(_comments(told) + f"[[{key}]]\n" + "".join(map(_line, entry.items())))
        said.add(key)
    return "\n".join(parts)


def _line(item: tuple[str, Any]) -> str:
    """One key with its value; a matrix stands in rows, as people read it."""
    key, value = item
    if isinstance(value, dict):
        # tomli_w would give it a head of its own, which ends the table that it belongs to
        inside = ", ".join(_line(one).strip() for one in value.items())
        return f"{key} = {{{inside}}}\n"
    if not isinstance(value, tuple):
        return tomli_w.dumps({key: value})
    if value and isinstance(value[0], tuple):
        rows = "".join(f"    {_list(row)},\n" for row in value)
        return f"{key} = [\n{rows}]\n"
    return f"{key} = {_list(value)}\n"


def _list(values: Iterable[float | str]) -> str:
    # tomli_w would give every entry a line of its own
    entries = (tomli_w.dumps({"x": value}).removeprefix("x = ").strip() for value in values)
    return f"[{', '.join(entries)}]"


def _check_symmetric(matrix: np.ndarray) -> None:
    if np.max(np.abs(matrix - matrix.T)) > _SYMMETRY * np.max(np.abs(matrix)):
        row, column = np.unravel_index(np.argmax(np.abs(matrix - matrix.T)), matrix.shape)
        raise ValueError(
            f"must be symmetric, but entry ({row + 1}, {column + 1}) is {matrix[row, column]:g} "
            f"and entry ({column + 1}, {row + 1}) is {matrix[column, row]:g}."
        )


def _positive_definite(matrix: np.ndarray) -> bool:
    # scaled to a unit diagonal, as masses and inertias differ by orders of magnitude
    diagonal = np.diag(matrix)
    if np.any(diagonal <= 0):
        return False
    if not len(diagonal):
        return True
    scale = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0] > 1e-12)
