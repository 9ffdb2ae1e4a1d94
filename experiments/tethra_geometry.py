"""Tethra's mass from simple elements: as the thesis prints it, and corrected (thesis, sec. 5.1 and 5.2).

    python -m experiments.tethra_geometry --out DIR [--seeds N] [--quick]

The listing that the thesis prints (BuildTetraModel, TetraParams) has four defects that its numbers contain.
They can be switched on here, and only here, to show that they give (5.14) and (5.15) to every printed digit.
With all of them off, the package's own elements give the same as the listing. From those the vehicle file
`tethra_geometry.toml` is written, of which the package has a copy.

What the elements' rounding leaves open is found by drawing every printed number again within half a unit of
its last digit, `--seeds` times.
"""

import dataclasses
import tomllib
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

import jax
import matplotlib

matplotlib.use("Agg")
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.spatial
import typer
from jaxtyping import Float
from matplotlib.patches import Rectangle
from rich.console import Console

import jaxmarine as jm
from experiments._study import save_figure, study, write_results
from jaxmarine.physics import Assembly, Cylinder, Element, compose, rotation, skew
from jaxmarine.vehicle_file import VehicleFile, read_vehicle_file, write_vehicle_file

TETHRA = Path(__file__).parent / "tethra"
ELEMENTS, HERE = TETHRA / "elements.toml", TETHRA / "geometry"
PLACE = ("length", "x", "y", "z", "phi", "theta", "psi")  # in the rows of the file
# What the thesis prints: the total mass with three end plates, (5.14), (5.15).
PRINTED_MASS = "231.37"
PRINTED_M = 231.0  # in (5.18)
PRINTED_COG = ("-0.0052", "0.0000", "-0.2269")
PRINTED_INERTIA = (
    ("51.6798", "-0.0816", "0.5526"),
    ("-0.0816", "49.7434", "0.0000"),
    ("0.5526", "0.0000", "52.6979"),
)
HEADER = """\
# Tethra, an open-frame remotely operated vehicle, built from simple elements.
# Source: PhD thesis of van de Ven (2006), listing BuildTetraModel with its defects mended and the fourth
# end plate of table 5.2; linear and quadratic damping (5.24). Origin in the plane of the horizontal
# thrusters. Written by `python -m experiments.tethra_geometry`.
# Assumed: no added mass (the thesis has none), 120 N, the noise; thrusters where the listing has them.
"""


# --- elements ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Tube:
    """A cylinder of the listing: radii, length, centre from `o` [m], masses [kg], attitude [degrees]."""

    group: str
    length: float
    outer: float
    inner: float
    wall: float
    contents: float
    centre: Float[np.ndarray, "3"]
    attitude: Float[np.ndarray, "3"]


class Rounded:
    """Numbers as printed; with `rng`: drawn within half a unit of their last digit.

    Numbers that are printed alike for the same thing are the same number, so that twins on either side stay
    twins. Zeros and right angles are not rounded: they are planes of symmetry and axes.
    """

    def __init__(self, rng: np.random.Generator | None):
        self._rng = rng
        self._drawn: dict[tuple[str, str, Decimal], float] = {}

    def __call__(self, group: str, what: str, printed: Decimal | int) -> float:
        size = Decimal(abs(printed))
        if self._rng is None or size in (0, 90):
            return float(printed)
        if (group, what, size) not in self._drawn:
            half = 0.5 * 10.0 ** int(size.as_tuple().exponent)
            self._drawn[group, what, size] = float(size) + self._rng.uniform(-half, half)
        return float(np.copysign(self._drawn[group, what, size], float(printed)))


def tubes(rng: np.random.Generator | None = None) -> list[Tube]:
    """All elements of the vehicle, see `Rounded`; the last end plate is the one that the listing lacks."""
    # Decimals keep the digits that are printed.
    data = tomllib.loads(ELEMENTS.read_text(encoding="utf-8"), parse_float=Decimal)
    origin, number = np.array(data["origin"], float), Rounded(rng)
    out = []
    for group in data["group"]:
        name = group["name"]
        own = {key: number(name, key, group[key]) for key in group if key not in ("name", "places")}
        outer = own["radius"]
        inner = 0.0 if group["wall"] == group["radius"] else outer - own["wall"]
        for place in group["places"]:
            length, *values = (number(name, what, value) for what, value in zip(PLACE, place, strict=True))
            filling = own.get("contents_density", 0.0) * np.pi * inner**2 * length
            out.append(
                Tube(
                    name,
                    length,
                    outer,
                    inner,
                    own["wall_density"] * np.pi * (outer**2 - inner**2) * length,
                    own.get("contents", filling),
                    np.array(values[:3]) - origin,
                    np.array(values[3:]),
                )
            )
    return out


def without_fourth_plate(all_tubes: list[Tube]) -> list[Tube]:
    last = max(i for i, tube in enumerate(all_tubes) if tube.group == "end plate")
    return all_tubes[:last] + all_tubes[last + 1 :]


def fixed_axes(degrees: Float[np.ndarray, "3"]) -> jax.Array:
    """Attitude that turns about fixed axes, z first: Rx(phi) Ry(theta) Rz(psi)."""
    half = np.deg2rad(degrees) / 2
    about = [jnp.zeros(4).at[0].set(np.cos(a)).at[i + 1].set(np.sin(a)) for i, a in enumerate(half)]
    return compose(about[0], compose(about[1], about[2]))


def element(tube: Tube) -> Element:
    """The tube as an element of the package."""
    hull = Cylinder(tube.length, tube.outer)
    place = {"position": tube.centre, "attitude": fixed_axes(tube.attitude)}
    if tube.inner in (0.0, tube.outer):  # all wall, or all contents: a solid
        return Element(hull, None, mass=tube.wall + tube.contents, contents=0.0, **place)
    return Element(hull, Cylinder(tube.length, tube.inner), mass=tube.wall, contents=tube.contents, **place)


# --- the listing ---------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Defects:
    """What is wrong in the listing.

    - `missing_plate`: the front lower end plate is not there.
    - `degrees_as_radians`: attitudes in degrees go into cos and sin as they are.
    - `swapped_masses`: wall and contents are exchanged in the inertia of a cylinder.
    - `transposed_rotation`: the matrix into an element's axes is used as the one out of them.
    """

    missing_plate: bool = False
    degrees_as_radians: bool = False
    swapped_masses: bool = False
    transposed_rotation: bool = False


AS_PRINTED = Defects(True, True, True, True)


@dataclasses.dataclass(frozen=True)
class Mass:
    """Mass and displaced mass [kg], centres from `o` [m], inertia about the centre of gravity [kg m²]."""

    mass: float
    displaced: float
    cog: Float[np.ndarray, "3"]
    cob: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]


def listing(all_tubes: list[Tube], defects: Defects, density: float) -> Mass:
    """TetraParams of the thesis, written again in NumPy, with the defects that are switched on."""
    parts = without_fourth_plate(all_tubes) if defects.missing_plate else all_tubes
    mass = np.array([t.wall + t.contents for t in parts])
    volume = np.array([np.pi * t.outer**2 * t.length for t in parts])
    centres = np.array([t.centre for t in parts])
    cog, cob = mass @ centres / mass.sum(), volume @ centres / volume.sum()
    inertia = np.zeros((3, 3))
    for tube, m in zip(parts, mass, strict=True):
        turn = _turn(tube.attitude, defects)
        r = cog - tube.centre
        inertia += turn @ np.diag(_cylinder(tube, defects)) @ turn.T
        inertia -= m * (np.outer(r, r) - r @ r * np.eye(3))
    return Mass(mass.sum(), volume.sum() * density, cog, cob, inertia)


def _cylinder(tube: Tube, defects: Defects) -> Float[np.ndarray, "3"]:
    """CylinderInertia: about x, y, z through its centre."""
    wall, contents = tube.wall, tube.contents
    if defects.swapped_masses:
        wall, contents = contents, wall
    inside, both = tube.inner**2, tube.inner**2 + tube.outer**2
    along = 0.5 * contents * inside + 0.5 * both * wall
    long = tube.length**2 / 12
    across = (long + 0.25 * inside) * contents + (long + 0.25 * both) * wall
    return np.array([along, across, across])


def _turn(attitude: Float[np.ndarray, "3"], defects: Defects) -> Float[np.ndarray, "3 3"]:
    """InertiaRotate: out of an element's axes. Its matrix is that of the opposite angles, transposed."""
    angles = attitude if defects.degrees_as_radians else np.deg2rad(attitude)
    (cf, ct, cp), (sf, st, sp) = np.cos(angles), np.sin(angles) * (1 if defects.transposed_rotation else -1)
    return np.array(
        [
            [cp * ct, sp * ct, -st],
            [-sp * cf + cp * st * sf, cp * cf + sf * st * sp, ct * sf],
            [sp * sf + cp * cf * st, -cp * sf + st * sp * cf, ct * cf],
        ]
    )


def own(parts: list[Tube], density: float) -> tuple[Mass, Assembly]:
    """The same from the package's elements."""
    craft = Assembly(tuple(element(tube) for tube in parts))
    numbers = [np.asarray(a) for a in (craft.cog, craft.cob, craft.inertia_at_cog)]
    return Mass(float(craft.mass), float(craft.volume) * density, *numbers), craft


# --- the vehicle file ----------------------------------------------------------------------------


def vehicle_file(craft: Assembly, all_tubes: list[Tube]) -> VehicleFile:
    """Mass, centres and buoyancy of the elements; everything else as in `tethra.toml`."""
    base = read_vehicle_file(jm.packaged_vehicle("tethra"))
    bodies = [tube.centre for tube in all_tubes if tube.group == "thruster"]
    thrusters = [
        {**thruster.model_dump(), "position": rounded(centre)}
        for thruster, centre in zip(base.thruster, bodies, strict=True)
    ]
    environment = base.environment
    return VehicleFile.model_validate(
        {
            **base.model_dump(by_alias=True),
            "name": "tethra_geometry",
            "body": {
                "mass": rounded(craft.mass),
                "inertia": rounded(craft.inertia),
                "cog": rounded(craft.cog),
                "cob": rounded(craft.cob),
                "buoyancy": rounded(craft.volume * environment.density * environment.gravity),
            },
            "thruster": thrusters,
        }
    )


def rounded(values: Any) -> Any:
    """To six decimals, far below what the elements are known to, so that the file is readable; no -0.0."""
    return (np.round(np.asarray(values, float), 6) + 0.0).tolist()


def write_vehicle(file: VehicleFile, path: Path) -> None:
    write_vehicle_file(file, path)
    path.write_text(HEADER + path.read_text(encoding="utf-8"), encoding="utf-8")


# --- what is written -----------------------------------------------------------------------------


def digits(mass: Mass) -> dict[str, Any]:
    """With as many digits as the thesis prints."""

    def four(values) -> Any:
        return [four(v) for v in values] if np.ndim(values) else f"{np.round(values, 4) + 0.0:.4f}"

    return {"mass": f"{mass.mass:.2f}", "cog": four(mass.cog), "inertia": four(mass.inertia)}


def as_numbers(mass: Mass) -> dict[str, Any]:
    return {
        "mass_kg": mass.mass,
        "displaced_kg": mass.displaced,
        "cog_m": mass.cog.tolist(),
        "cob_m": mass.cob.tolist(),
        "inertia_at_cog_kg_m2": mass.inertia.tolist(),
    }


def by_rounding(draws: int, density: float) -> Mass:
    """Standard deviation of everything over draws of the numbers of the file, all four plates there."""
    rng = np.random.default_rng(0)
    drawn = [dataclasses.astuple(listing(tubes(rng), Defects(), density)) for _ in range(draws)]
    return Mass(*(np.std(values, axis=0) for values in zip(*drawn, strict=True)))


def calculated(draws: int) -> tuple[dict[str, Any], Assembly, list[Tube]]:
    """All numbers under plain names, the craft with four plates, and its tubes."""
    all_tubes = tubes()
    density = read_vehicle_file(jm.packaged_vehicle("tethra")).environment.density
    printed = listing(all_tubes, AS_PRINTED, density)
    three, _ = own(without_fourth_plate(all_tubes), density)
    four, craft = own(all_tubes, density)
    shown = digits(printed)
    thesis = {
        "mass": PRINTED_MASS,
        "cog": list(PRINTED_COG),
        "inertia": [list(row) for row in PRINTED_INERTIA],
    }
    arm = np.asarray(skew(jnp.array([float(x) for x in PRINTED_COG])))
    about_o = np.array(PRINTED_INERTIA, float) - PRINTED_M * arm @ arm
    turned = listing(all_tubes, Defects(transposed_rotation=True), density).inertia - four.inertia
    results = {
        "printed": thesis,
        "as_printed": as_numbers(printed),
        "as_printed_matches_every_digit": shown == thesis,
        "one_defect_mended": {
            field.name: as_numbers(
                listing(all_tubes, dataclasses.replace(AS_PRINTED, **{field.name: False}), density)
            )
            for field in dataclasses.fields(Defects)
        },
        "transposed_rotation_alone_changes_inertia_by_kg_m2": float(np.abs(turned).max()),
        "corrected_3_plates": as_numbers(three),
        "corrected_4_plates": as_numbers(four),
        "std_by_rounding": as_numbers(by_rounding(draws, density)),
        "draws": draws,
        "inertia_about_o_4_plates_kg_m2": np.asarray(craft.inertia).tolist(),
        "inertia_about_o_of_the_printed_numbers_kg_m2": about_o.tolist(),
        "net_buoyancy_N": {
            "as_printed": (printed.displaced - printed.mass) * 9.81,
            "corrected_4_plates": (four.displaced - four.mass) * 9.81,
        },
    }
    return results, craft, all_tubes


COLUMNS = {
    "as_printed": "listing as printed",
    "corrected_3_plates": "corrected, 3 plates",
    "corrected_4_plates": "corrected, 4 plates",
    "std_by_rounding": "its standard deviation by rounding",
}
ENTRIES = {"I_xx": (0, 0), "I_yy": (1, 1), "I_zz": (2, 2), "I_xy": (0, 1), "I_xz": (0, 2), "I_yz": (1, 2)}


def markdown(results: dict[str, Any]) -> str:
    """The thesis' numbers beside ours, and what each defect changes."""
    thesis = results["printed"]
    given = {"mass (kg)": thesis["mass"], "displaced mass (kg)": "–"}
    given |= {f"{axis}_g (m)": value for axis, value in zip("xyz", thesis["cog"], strict=True)}
    given |= {f"{axis}_b (m)": "–" for axis in "xyz"}
    given |= {f"{name} (kg m²)": thesis["inertia"][i][j] for name, (i, j) in ENTRIES.items()}
    columns = [_column(results[key]) for key in COLUMNS]
    lines = [
        "Inertia is about the centre of gravity, centres are from `o`.",
        "",
        "| | thesis | " + " | ".join(COLUMNS.values()) + " |",
        "|---|---" + "|---" * len(COLUMNS) + "|",
    ]
    lines += [
        f"| {name} | {value} | " + " | ".join(column[i] for column in columns) + " |"
        for i, (name, value) in enumerate(given.items())
    ]
    whole = results["as_printed_matches_every_digit"]
    lines += ["", f"The listing as printed gives every printed digit: {'yes' if whole else 'no'}."]
    lines += ["", "As printed, with one defect mended:", ""]
    lines += ["| mended | mass (kg) | " + " | ".join(f"{name} (kg m²)" for name in ENTRIES) + " |"]
    lines += ["|---|---" + "|---" * len(ENTRIES) + "|"]
    rows = {"nothing": results["as_printed"], **results["one_defect_mended"]}
    lines += [
        f"| {name.replace('_', ' ')} | {row['mass_kg']:.2f} | "
        + " | ".join(_plain(row["inertia_at_cog_kg_m2"][i][j]) for i, j in ENTRIES.values())
        + " |"
        for name, row in rows.items()
    ]
    about = {
        "thesis, (5.18)": np.diag([52.0, 50.0, 53.0]),
        "(5.14) moved to `o`": results["inertia_about_o_of_the_printed_numbers_kg_m2"],
        "corrected, 4 plates": results["inertia_about_o_4_plates_kg_m2"],
    }
    lines += ["", "Inertia about `o`, the lower right block of M_RB:", ""]
    lines += ["| | " + " | ".join(f"{name} (kg m²)" for name in ENTRIES) + " |"]
    lines += ["|---" + "|---" * len(ENTRIES) + "|"]
    lines += [
        f"| {name} | "
        + " | ".join(f"{np.round(np.asarray(matrix)[i, j], 2) + 0.0:.2f}" for i, j in ENTRIES.values())
        + " |"
        for name, matrix in about.items()
    ]
    return "\n".join(lines) + "\n"


def _column(one: dict[str, Any]) -> list[str]:
    inertia = [one["inertia_at_cog_kg_m2"][i][j] for i, j in ENTRIES.values()]
    masses = [f"{one['mass_kg']:.2f}", f"{one['displaced_kg']:.2f}"]
    return masses + [_plain(x) for x in (*one["cog_m"], *one["cob_m"], *inertia)]


def _plain(value: float) -> str:
    return f"{np.round(value, 4) + 0.0:.4f}"


COLOURS = {
    "frame": "0.45",
    "lower float": "tab:orange",
    "upper float": "tab:olive",
    "hull": "tab:blue",
    "end plate": "tab:cyan",
    "thruster": "tab:red",
}


def figure(all_tubes: list[Tube], mass: Mass, folder: Path) -> None:
    """The elements from the side, from behind and from above (as figure 5.3), with the centres."""
    views = {"from the side": (0, 2), "from behind": (1, 2), "from above": (0, 1)}
    names = ("x, ahead (m)", "y, starboard (m)", "z, down (m)")
    sheet, axes = plt.subplots(
        2, 2, figsize=(10, 7.4), gridspec_kw={"width_ratios": [1.7, 1.2]}, layout="constrained"
    )
    places = (axes[0, 0], axes[0, 1], axes[1, 0])
    for ax, (title, (i, j)) in zip(places, views.items(), strict=True):
        for tube in all_tubes:
            points = _outline(tube)[:, (i, j)]
            corners = points[scipy.spatial.ConvexHull(points).vertices]
            colour = COLOURS[tube.group]
            ax.fill(*corners.T, facecolor=colour, edgecolor=colour, alpha=0.35, lw=0.8)
        for centre, marker, colour in (
            (np.zeros(3), "+", "k"),
            (mass.cog, "o", "k"),
            (mass.cob, "^", "tab:purple"),
        ):
            ax.plot(centre[i], centre[j], marker, color=colour, ms=8, mew=1.6)
        ax.set(title=title, xlabel=names[i], ylabel=names[j], aspect="equal")
        ax.invert_yaxis() if j == 2 else None
        ax.grid(alpha=0.3)
    handles: list[Any] = [Rectangle((0, 0), 1, 1, color=c, alpha=0.5) for c in COLOURS.values()]
    for marker, colour in (("+", "k"), ("o", "k"), ("^", "tab:purple")):
        handles += plt.plot([], [], marker, color=colour, ms=8, mew=1.6)
    labels = [*COLOURS, "origin o", "centre of gravity", "centre of buoyancy"]
    axes[1, 1].axis("off")
    axes[1, 1].legend(handles, labels, loc="center left", frameon=False)
    save_figure(sheet, folder / "elements")


def _outline(tube: Tube) -> Float[np.ndarray, "points 3"]:
    """Points on the rims of both ends."""
    angle = np.linspace(0.0, 2 * np.pi, 25)
    rim = np.stack([np.zeros_like(angle), tube.outer * np.cos(angle), tube.outer * np.sin(angle)], axis=1)
    half = np.array([tube.length / 2, 0.0, 0.0])
    ends = np.concatenate([rim - half, rim + half])
    return ends @ np.asarray(rotation(fixed_axes(tube.attitude))).T + tube.centre


def main(
    out: Annotated[Path, typer.Option("--out", help="Folder for numbers, tables, figures, vehicle file.")],
    seeds: Annotated[int, typer.Option(min=2, help="Draws of the elements within their rounding.")] = 1000,
    quick: Annotated[bool, typer.Option("--quick", help="Twenty draws.")] = False,
) -> None:
    """Tethra's mass from simple elements: as printed, and corrected."""
    with study(out, quick):
        results, craft, all_tubes = calculated(20 if quick else seeds)
        text = markdown(results)
        write_results(out, results, text)
        write_vehicle(vehicle_file(craft, all_tubes), out / "tethra_geometry.toml")
        numbers = results["corrected_4_plates"]
        mass = Mass(0.0, 0.0, np.array(numbers["cog_m"]), np.array(numbers["cob_m"]), np.zeros((3, 3)))
        figure(all_tubes, mass, out)
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    typer.run(main)
