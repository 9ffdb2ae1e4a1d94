"""FMI 3.0 co-simulation: an FMU with the vehicle as CasADi functions, and Python code that steps them."""

import json
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from .._files import written_whole
from ..vehicle import Vehicle
from .casadi import described, functions
from .casadi import lost as lost

NEEDS = ("casadi", "pythonfmu3")
# FMUs are named by what they are told in C, where a name is letters, digits and underscores.
_FOREIGN = re.compile(r"\W|^(?=\d)", re.ASCII)


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes the FMU; where it runs, Python with numpy and casadi must be on the path, jaxmarine need not.

    Inputs are the commands by their names and `X Y Z K M N`, held over each communication step; outputs
    `x y z phi theta psi u v w p q r`; parameters the same with `_start`.
    """
    from pythonfmu3 import FmuBuilder

    model, made = functions(vehicle)
    told = described(vehicle, model, notes) | {"identifier": _FOREIGN.sub("_", vehicle.name)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        slave = folder / "marine_vehicle.py"
        shutil.copyfile(Path(__file__).with_name("_slave.py"), slave)
        (folder / "model.json").write_text(json.dumps(told, ensure_ascii=False), encoding="utf-8")
        beside = [folder / "model.json"]
        for one in ("start", "step", "shown"):
            beside.append(folder / f"{one}.casadi")
            beside[-1].write_text(made[one].serialize(), encoding="utf-8")
        # What it imports is there in Python, not in a tool of its own.
        built = FmuBuilder.build_FMU(slave, folder / "out", beside, needsExecutionTool=False)
        with written_whole(path) as whole:
            shutil.copyfile(built, whole)
