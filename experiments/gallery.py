"""Five worked cases, with what the command line really printed, as pages of the documentation.

Each case makes its logs, runs the commands that its page shows, and keeps what they printed, what was found
and one picture. `results.json` holds it all; the pages are written from that.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import jinja2
import typer
from jaxtyping import Array, Float
from PIL import Image

from experiments._study import ScalarEffect, study
from experiments.worked.bag import bag_of
from jaxmarine.effects import CATALOGUE, Motion
from jaxmarine.examples import hidden
from jaxmarine.logs import write_log
from jaxmarine.vehicle import Vehicle
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle

HERE = Path(__file__).parent / "worked"


class Foil(ScalarEffect):
    """Lift of a plate under the hull: a force up, by the square of the speed ahead. Neutral: 0."""

    name = "foil"
    units = {"lift": "N s²/m²"}

    lift: Float[Array, ""]

    def __call__(self, motion: Motion) -> Float[Array, "6"]:
        return jnp.zeros(6).at[2].set(-self.lift * motion.nu_r[0] ** 2)


def packaged(craft: str, folder: Path) -> Vehicle:
    """A packaged craft, whose file is copied into the folder."""
    shutil.copy(packaged_vehicle(craft), folder / "vehicle.toml")
    return load_vehicle(packaged_vehicle(craft))


def bags_of_a_boat(folder: Path) -> None:
    """Two bags of a boat whose starboard thruster is worn astern."""
    boat = packaged("blueboat", folder)
    for log in hidden(boat, "reverse_thrust", "starboard", {"factor": 0.5}, seed=2):
        bag_of(log, folder / log.name.replace("csv", "mcap"))
    shutil.copy(HERE / "boat_map.toml", folder / "map.toml")


def logs_with_a_foil(folder: Path) -> None:
    """Logs of an ROV with a force that the catalogue does not have."""
    rov = packaged("tethra", folder)
    for log in hidden(rov, "foil", None, {"lift": 40.0}, catalogue=(*CATALOGUE, Foil)):
        write_log(log, folder / log.name)


# Lines that tell how far a command has come, which each machine tells in its own time.
_PROGRESS = re.compile(r"^.* \.\.\.( \d+ % done.*)?\n", re.MULTILINE)
# How the files of a case are made, where its commands do not make them.
MAKE: dict[str, Callable[[Path], None]] = {"boat": bags_of_a_boat, "unknown": logs_with_a_foil}
CASES: list[dict[str, Any]] = tomllib.loads((HERE / "cases.toml").read_text(encoding="utf-8"))["case"]


def run(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Makes the files of a case, runs its commands in the folder, and gives what they printed and found."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if case["name"] in MAKE:
        MAKE[case["name"]](folder)
    plain = {"PYTHONPATH": str(HERE.parents[1]), "COLUMNS": "100", "NO_COLOR": "1"}
    printed = []
    for step in case["steps"]:
        command = [sys.executable, "-m", "jaxmarine", *step["command"].split()]
        done = subprocess.run(
            command, cwd=folder, env={**os.environ, **plain}, stdout=subprocess.PIPE, text=True, check=True
        )
        printed.append(_PROGRESS.sub("", done.stdout).strip())
    told = json.loads((folder / "report" / "diagnosis.json").read_text(encoding="utf-8"))
    return {
        "printed": printed,
        "verdict": told["verdict"],
        "findings": {
            f["effect"] + (f":{f['target']}" if f["target"] else ""): {
                name: one["value"] for name, one in f["parameters"].items()
            }
            for f in told["findings"]
        },
        "depends_on": told["residual_after"]["depends_on"],
        "ratio": told["gain"]["ratio"],
    }


def page(case: dict[str, Any], found: dict[str, Any]) -> str:
    """The case as a page of the documentation."""
    template = jinja2.Template((HERE / "page.md.j2").read_text(encoding="utf-8"), trim_blocks=True)
    told = case["told"].replace("{map}", (HERE / "boat_map.toml").read_text(encoding="utf-8").strip())
    steps = [step | {"printed": out} for step, out in zip(case["steps"], found["printed"], strict=True)]
    return template.render(case=case | {"told": told}, steps=steps).strip() + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for files, reports and pages of the cases.")],
    only: Annotated[str, typer.Option(help="The name of one case.")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="The ROV alone.")] = False,
) -> None:
    """Runs the cases and writes their pages."""
    only = only or ("rov" if quick else "")
    wanted = [case for case in CASES if only in ("", case["name"])]
    if not wanted:
        raise typer.BadParameter(f"`{only}` is none of {', '.join(case['name'] for case in CASES)}.")
    results = {}
    with study(out, quick):
        for case in wanted:
            name = case["name"]
            found = results[name] = run(case, out / name)
            with Image.open(out / name / "report" / "figures" / f"{case['figure']}.png") as figure:
                figure.thumbnail((1080, 1080))
                few = figure.convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE, colors=32)
                few.save(out / f"{name}.png", optimize=True)
            (out / f"{name}.md").write_text(page(case, found), encoding="utf-8")
            print(f"{name}: {found['verdict']}, {found['findings']}", flush=True)
    (out / "results.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
