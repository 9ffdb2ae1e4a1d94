"""Mass properties of elements against quadrature and limits; Tethra's against the thesis."""

import dataclasses
import json

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmarine as jm
from experiments import tethra_geometry as tethra
from jaxmarine.physics import AbstractSolid, Assembly, Box, Cylinder, Element, Sphere

from .conftest import ROOT

# Gauss-Legendre with 6 points integrates polynomials to degree 11 exactly; the integrands have at most 5.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)
ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)  # exact for cosines to the 7th multiple


def quaternion(turn: Rotation) -> np.ndarray:
    return turn.as_quat(scalar_first=True)


def between(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    return (low + high) / 2 + (high - low) / 2 * NODES, (high - low) / 2 * WEIGHTS


def points(solid: AbstractSolid) -> tuple[np.ndarray, np.ndarray]:
    """Points in a solid, and the volume that each stands for."""
    if isinstance(solid, Box):
        axes = [between(-float(a) / 2, float(a) / 2) for a in solid.size]
        grid = np.meshgrid(*(x for x, _ in axes), indexing="ij")
        volume = np.einsum("i,j,k->ijk", *(w for _, w in axes))
    elif isinstance(solid, Cylinder):
        (x, wx), (r, wr) = between(*(np.array([-0.5, 0.5]) * solid.length)), between(0, float(solid.radius))
        along, out, angle = np.meshgrid(x, r, ANGLES, indexing="ij")
        grid = [along, out * np.cos(angle), out * np.sin(angle)]
        volume = np.einsum("i,j,k->ijk", wx, wr * r, np.full(len(ANGLES), 2 * np.pi / len(ANGLES)))
    else:
        assert isinstance(solid, Sphere)
        (c, wc), (r, wr) = between(-1, 1), between(0, float(solid.radius))
        cos, out, angle = np.meshgrid(c, r, ANGLES, indexing="ij")
        sin = np.sqrt(1 - cos**2)
        grid = [out * cos, out * sin * np.cos(angle), out * sin * np.sin(angle)]
        volume = np.einsum("i,j,k->ijk", wc, wr * r**2, np.full(len(ANGLES), 2 * np.pi / len(ANGLES)))
    return np.stack([g.ravel() for g in grid], axis=1), volume.ravel()


def quadrature(elements: list[Element]) -> dict[str, np.ndarray]:
    """Sums over points of all elements; a cavity takes away wall and adds contents."""
    mass, place, volume, centre = [], [], [], []
    for e in elements:
        turn = Rotation.from_quat(np.asarray(e.attitude), scalar_first=True)
        inside, own = points(e.hull)
        volume.append(own)
        centre.append(turn.apply(inside) + np.asarray(e.position))
        hole, less = points(e.cavity) if e.cavity is not None else (np.zeros((0, 3)), np.zeros(0))
        wall = float(e.mass) / (own.sum() - less.sum())
        filling = float(e.contents) / less.sum() if len(less) else 0.0
        mass += [wall * own, (filling - wall) * less]
        place += [centre[-1], turn.apply(hole) + np.asarray(e.position)]
    m, r, v, c = map(np.concatenate, (mass, place, volume, centre))
    return {
        "mass": m.sum(),
        "volume": v.sum(),
        "cog": m @ r / m.sum(),
        "cob": v @ c / v.sum(),
        "inertia": np.einsum("i,ij,ij->", m, r, r) * np.eye(3) - np.einsum("i,ij,ik->jk", m, r, r),
    }


def agree(craft: Assembly, expected: dict[str, np.ndarray]) -> None:
    for name, value in expected.items():
        # Both are sums of some thousand products: rounding.
        np.testing.assert_allclose(getattr(craft, name), value, rtol=1e-12, atol=1e-13, err_msg=name)


TURNED = quaternion(Rotation.from_rotvec([1, 2, 3]))
ROD = Element(Cylinder(1.3, 0.2), None, 3.0, 0.0, [0.3, -0.2, 0.5], TURNED)
TUBE = Element(Cylinder(0.8, 0.3), Cylinder(0.8, 0.2), 2.0, 5.0, [-0.4, 0.1, 0.2], [0.6, 0.0, 0.8, 0.0])
CHEST = Element(Box([0.5, 0.3, 0.2]), Box([0.4, 0.25, 0.1]), 4.0, 1.0, [0.1, 0.9, 0.0], [0.5, 0.5, -0.5, 0.5])
BLOCK = Element(Box([0.2, 0.7, 0.4]), None, 1.5, 0.0, [0.0, 0.0, -0.6], [0.8, 0.0, 0.0, 0.6])
FLOAT = Element(Sphere(0.25), Sphere(0.24), 0.7, 0.1, [0.2, 0.2, -0.9], [1.0, 0.0, 0.0, 0.0])
BALL = Element(Sphere(0.1), None, 2.5, 0.0, [-0.7, 0.0, 0.3], [1.0, 0.0, 0.0, 0.0])
ALL = {"rod": ROD, "tube": TUBE, "chest": CHEST, "block": BLOCK, "float": FLOAT, "ball": BALL}


@pytest.mark.parametrize("one", ALL.values(), ids=ALL)
def test_an_element_is_the_integral_over_its_solids(one):
    agree(Assembly((one,)), quadrature([one]))


def test_a_craft_is_the_integral_over_all_its_elements():
    craft = Assembly(tuple(ALL.values()))
    agree(craft, quadrature(list(ALL.values())))
    # About its centre of gravity: the same integral with the craft moved there.
    moved = [dataclasses.replace(e, position=e.position - craft.cog) for e in ALL.values()]
    np.testing.assert_allclose(craft.inertia_at_cog, quadrature(moved)["inertia"], atol=1e-12)


def test_the_rigid_body_matrix_has_the_kinetic_energy_of_the_points():
    craft = Assembly(tuple(ALL.values()))
    nu = np.array([0.3, -0.2, 0.5, 0.7, -1.1, 0.4])
    energy = 0.0
    for e in ALL.values():
        for solid, density in (
            (e.hull, float(e.mass) / (e.hull.volume - (e.cavity.volume if e.cavity else 0.0))),
            (e.cavity, None),
        ):
            if solid is None:
                continue
            if density is None:
                wall = float(e.mass) / (e.hull.volume - solid.volume)
                density = float(e.contents) / solid.volume - wall
            inside, volume = points(solid)
            turn = Rotation.from_quat(np.asarray(e.attitude), scalar_first=True)
            velocity = nu[:3] + np.cross(nu[3:], turn.apply(inside) + np.asarray(e.position))
            energy += 0.5 * float(density) * volume @ (velocity**2).sum(1)
    assert 0.5 * nu @ craft.matrix @ nu == pytest.approx(energy, rel=1e-12)


THIN = 1e-6  # of the radius: what is left is of this order


@pytest.mark.parametrize(
    "hull,cavity,expected",
    [
        (Cylinder(1.2, 0.3), Cylinder(1.2, 0.3 * (1 - THIN)), [0.09, 0.045 + 0.12, 0.045 + 0.12]),
        (Sphere(0.3), Sphere(0.3 * (1 - THIN)), [0.06] * 3),
        # Six faces of a cube, by hand: two at the ends (1/12 + 1/4), two beside (1/6 + 1/4, twice).
        (Box([1.0, 1.0, 1.0]), Box([1 - THIN] * 3), [5 / 18] * 3),
    ],
    ids=["tube: M R², M R²/2 + M h²/12", "sphere: 2/3 M R²", "cube"],
)
def test_a_thin_wall_has_the_inertia_of_its_surface(hull, cavity, expected):
    shell = Element(hull, cavity, 1.0, 0.0, np.zeros(3), [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(shell.gyration, expected, rtol=2 * THIN)


def test_small_bodies_are_point_masses_on_parallel_axes():
    """(5.10), with points whose inertia is written out by components."""
    places = np.array([[1.0, 2.0, -0.5], [-0.3, 0.4, 0.8], [0.0, -1.0, 0.2]])
    masses = [2.0, 3.0, 1.5]
    craft = Assembly(
        tuple(
            Element(Sphere(1e-8), None, m, 0.0, p, [1.0, 0.0, 0.0, 0.0])
            for m, p in zip(masses, places, strict=True)
        )
    )
    expected = np.zeros((3, 3))
    for m, (x, y, z) in zip(masses, places, strict=True):
        expected += m * np.array(
            [
                [y * y + z * z, -x * y, -x * z],
                [-x * y, x * x + z * z, -y * z],
                [-x * z, -y * z, x * x + y * y],
            ]
        )
    np.testing.assert_allclose(craft.inertia, expected, atol=1e-13)


@hypothesis.given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6))
@hypothesis.settings(max_examples=15)
def test_turning_and_moving_the_whole_craft_changes_nothing_in_it(numbers):
    turn, shift = Rotation.from_rotvec(numbers[:3]), np.array(numbers[3:])
    craft = Assembly((ROD, CHEST, FLOAT))

    def elsewhere(e: Element) -> Element:
        attitude = turn * Rotation.from_quat(np.asarray(e.attitude), scalar_first=True)
        place = jnp.asarray(turn.apply(np.array(e.position)) + shift)
        return dataclasses.replace(e, position=place, attitude=jnp.asarray(quaternion(attitude)))

    other = Assembly(tuple(map(elsewhere, craft.elements)))
    q = turn.as_matrix()
    np.testing.assert_allclose(other.mass, craft.mass, rtol=1e-14)
    np.testing.assert_allclose(other.cog, turn.apply(np.array(craft.cog)) + shift, atol=1e-13)
    np.testing.assert_allclose(other.cob, turn.apply(np.array(craft.cob)) + shift, atol=1e-13)
    # Differences of inertias about `o`, which are up to some hundred kg m².
    np.testing.assert_allclose(other.inertia_at_cog, q @ craft.inertia_at_cog @ q.T, atol=1e-11)


def test_a_row_of_equal_elements_is_one_vmapped_element():
    places = jnp.arange(12.0).reshape(4, 3)
    row = jax.vmap(lambda p: dataclasses.replace(TUBE, position=p).inertia)(places)
    alone = [dataclasses.replace(TUBE, position=p).inertia for p in places]
    np.testing.assert_allclose(row, np.array(alone), rtol=1e-12)


# --- Tethra --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The case study, run as from the command line: its numbers and its folder."""
    folder = tmp_path_factory.mktemp("tethra")
    tethra.main(folder, quick=True)
    return json.loads((folder / "results.json").read_text()), folder


def test_the_listing_with_its_defects_gives_every_printed_digit(study):
    results, folder = study
    printed = results["as_printed"]
    assert f"{printed['mass_kg']:.2f}" == "231.37"
    assert np.array_equal(
        np.round(printed["inertia_at_cog_kg_m2"], 4),
        [[51.6798, -0.0816, 0.5526], [-0.0816, 49.7434, 0.0], [0.5526, 0.0, 52.6979]],
    )
    assert np.array_equal(np.round(printed["cog_m"], 4), [-0.0052, 0.0, -0.2269])
    assert results["as_printed_matches_every_digit"]
    assert results["net_buoyancy_N"]["as_printed"] == pytest.approx(124.8, abs=0.05)
    assert not any(
        np.array_equal(np.round(one["inertia_at_cog_kg_m2"], 4), np.round(printed["inertia_at_cog_kg_m2"], 4))
        for one in results["one_defect_mended"].values()
    ), "each defect shows in the digits"
    for name in ("results.json", "results.md", "elements.png", "elements.svg"):
        assert (folder / name).stat().st_size > 1000


def test_the_corrected_craft_has_the_numbers_of_an_independent_calculation(study):
    """Printed beside the thesis' errata: made by other code from the same listing."""
    results, _ = study
    three, four = results["corrected_3_plates"], results["corrected_4_plates"]
    inertia = [[51.601, 0.0, 0.512], [0.0, 49.661, 0.0], [0.512, 0.0, 52.487]]
    np.testing.assert_allclose(three["inertia_at_cog_kg_m2"], inertia, atol=6e-4)
    np.testing.assert_allclose(four["inertia_at_cog_kg_m2"], np.diag([52.549, 50.870, 52.841]), atol=6e-4)
    assert four["mass_kg"] == pytest.approx(236.18, abs=5e-3)
    assert four["displaced_kg"] == pytest.approx(244.72, abs=5e-3)
    np.testing.assert_allclose(four["cog_m"], [0.0, 0.0, -0.2182], atol=5e-5)
    assert results["transposed_rotation_alone_changes_inertia_by_kg_m2"] < 1e-3
    about_o = results["inertia_about_o_of_the_printed_numbers_kg_m2"]
    np.testing.assert_allclose(np.diag(about_o), [63.57, 61.64, 52.70], atol=6e-3)


def test_the_page_says_what_was_calculated():
    kept = json.loads((tethra.HERE / "results.json").read_text())
    assert kept["draws"] == 1000
    assert tethra.markdown(kept) in (ROOT / "experiments" / "README.md").read_text()


def test_the_kept_numbers_are_still_what_is_calculated(study):
    kept = json.loads((tethra.HERE / "results.json").read_text())
    # Only the deviations hang on how often is drawn.
    now = study[0] | {"std_by_rounding": kept["std_by_rounding"]}
    assert tethra.markdown(now) == tethra.markdown(kept)


def test_numbers_are_drawn_within_their_rounding_and_twins_stay_twins(study):
    printed, drawn = tethra.tubes(), tethra.tubes(np.random.default_rng(3))
    # Frame F1 is [0.50, 0.78, -0.249, -0.956, -5, 0, 90], its mirror image F2.
    off = drawn[0].centre - printed[0].centre
    assert 0 < abs(off[0]) < 5e-3 and 0 < abs(off[1]) < 5e-4 and 0 < abs(off[2]) < 5e-4
    assert 0 < abs(drawn[0].attitude[0] + 5) < 0.5 and list(drawn[0].attitude[1:]) == [0, 90]
    np.testing.assert_array_equal(drawn[1].centre, drawn[0].centre * [1, -1, 1])
    assert all(a.inner == 0 for a, b in zip(drawn, printed, strict=True) if b.inner == 0)
    # So the craft stays symmetric, but for braces at 60.4 and 119.6 degrees, which are drawn apart.
    std = study[0]["std_by_rounding"]
    assert study[0]["draws"] == 20
    inertia = np.array(std["inertia_at_cog_kg_m2"])
    assert np.abs(inertia - np.diag(np.diag(inertia))).max() < 1e-3
    assert np.diag(inertia).min() > 0.3 and np.diag(inertia).max() < 3.0
    assert 2.0 < std["mass_kg"] < 7.0


@pytest.mark.parametrize("plates", [3, 4])
def test_the_mended_listing_and_the_elements_are_the_same_craft(plates):
    all_tubes = tethra.tubes()
    parts = all_tubes if plates == 4 else tethra.without_fourth_plate(all_tubes)
    ours, craft = tethra.own(parts, 1025.0)
    other = tethra.listing(all_tubes, tethra.Defects(missing_plate=plates == 3), 1025.0)
    for name in ("mass", "displaced", "cog", "cob", "inertia"):
        np.testing.assert_allclose(getattr(ours, name), getattr(other, name), rtol=1e-12, atol=1e-12)
    agree(craft, quadrature([tethra.element(tube) for tube in parts]))


def test_the_ends_of_tubes_meet_their_neighbours():
    """What the attitudes of table 5.2 mean: ends in y and z from the listing's origin."""
    ends = {}
    for i, tube in enumerate(tethra.tubes()[:32], start=1):
        turn = np.asarray(jm.physics.rotation(tethra.fixed_axes(tube.attitude)))
        half = turn[:, 0] * tube.length / 2
        both = np.array([tube.centre - half, tube.centre + half])[:, 1:] + [0.0, -0.43]
        ends[i] = both[np.argsort(np.abs(both[:, 0]))]
    # Lengths and angles of the table are rounded: within half a tube's diameter.
    np.testing.assert_allclose(ends[21], [[0.47, 0.0], [0.534, -0.456]], atol=6e-3)
    np.testing.assert_allclose(ends[2], [[0.0, -0.978], [0.498, -0.934]], atol=6e-3)
    np.testing.assert_allclose(ends[23][1], ends[21][1], atol=6e-3)


def test_the_packaged_file_is_the_one_that_the_script_writes(study):
    _, folder = study
    written = (folder / "tethra_geometry.toml").read_text()
    assert written == jm.packaged_vehicle("tethra_geometry").read_text()
    vehicle = jm.load_vehicle(folder / "tethra_geometry.toml")
    all_tubes = tethra.tubes()
    # Rounded to six decimals, lever arms times 236 kg.
    np.testing.assert_allclose(vehicle.body.matrix, tethra.own(all_tubes, 1025.0)[1].matrix, atol=2e-4)
    base = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    for of in (lambda v: v.damping.linear, lambda v: v.damping.quadratic, lambda v: v.added_mass):
        assert np.array_equal(of(vehicle), of(base))
    centres = [tube.centre for tube in all_tubes if tube.group == "thruster"]
    np.testing.assert_allclose(vehicle.thrusters.position, centres, atol=1e-12)
