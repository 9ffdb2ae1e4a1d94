"""The experiment of tables 6.1 to 6.7: its small version, how its claims are decided, what it found."""

import dataclasses
import json

import numpy as np
import pytest

from experiments import tethra_tables
from experiments._study import decided
from experiments.thesis import plant

from .conftest import ROOT


def test_quick_run_writes_tables_and_goes_on_where_it_was(tmp_path):
    tethra_tables.main(tmp_path, seeds=1, quick=True)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [
        name for name in ("results.md", "errors.png", "errors.svg") if not (tmp_path / name).exists()
    ] == []
    # A minute of collisions is enough for whole windows, once those with contact are left out.
    bars = {(b["method"], b["what"]): b for b in results["bars"]}
    assert bars["trajectory, rejecting", "M diagonal"]["met"]
    parts = {path: path.read_text() for path in (tmp_path / "parts").iterdir()}
    tethra_tables.main(tmp_path, seeds=1, quick=True)
    assert {path: path.read_text() for path in (tmp_path / "parts").iterdir()} == parts
    # What the tables say is what the matrices are, by (6.3): 231 kg, 52, 50 and 53 kg m² are printed.
    true = np.array([231.0, 231, 231, 52, 50, 53])
    for text in parts.values():
        one = json.loads(text)
        for method, found in one["matrices"].items():
            if found["M"] is not None:
                off = 100 * np.abs(np.diag(found["M"]) / true - 1).max()
                assert one["errors"][method]["M"]["diagonal"] == pytest.approx(off)
                assert results["tables"][one["case"]][method]["M"]["diagonal"][0] == pytest.approx(off)


def test_a_second_operator_goes_on_where_the_first_ended():
    vehicle = plant.tethra()
    case = tethra_tables.Case("-", 3.0, "text")
    one, two = (
        tethra_tables.data_of(vehicle, dataclasses.replace(case, operators=count), 4) for count in (1, 2)
    )
    assert len(two.nu) == 2 * len(one.nu) == 60
    for name in "nu", "nu_dot", "force":
        np.testing.assert_allclose(getattr(two, name)[:30], getattr(one, name), rtol=0, atol=1e-9)
    assert np.abs(np.diff(two.nu, axis=0)).max() < 0.3  # no jump between them


def parts(errors: np.ndarray) -> list[dict]:
    """Twelve dives whose methods have these errors of M and D_l: [dives, first and second of a claim]."""
    (case, better, matrix), (_, worse, _) = tethra_tables.CLAIMS[0][1:3]
    return [
        {
            "case": case,
            "seed": seed,
            "errors": {
                name: {matrix: {"diagonal": float(x)}} for name, x in zip((better, worse), pair, strict=True)
            },
        }
        for seed, pair in enumerate(errors)
    ]


def test_claims_are_decided_by_their_pairs():
    rng = np.random.default_rng(0)
    dive = np.exp(rng.normal(size=12))  # easy and hard dives, which both methods feel
    ahead = np.stack([dive, np.linspace(1.15, 1.25, 12) * dive], axis=1)  # no two alike: ties take a second
    (won,) = tethra_tables.claims(parts(ahead))
    # All of twelve one way: 2 / 2^12. Unpaired, a fifth is nothing beside a scatter of e.
    assert (won["verdict"], won["wins"], won["dives"]) == ("holds", 12, 12)
    assert won["p"] == pytest.approx(2 / 2**12)
    (lost,) = tethra_tables.claims(parts(ahead[:, ::-1]))
    assert lost["verdict"] == "refuted" and lost["wins"] == 0
    mixed = ahead.copy()
    mixed[::2] = mixed[::2, ::-1]
    (open_,) = tethra_tables.claims(parts(mixed))
    assert open_["verdict"] == "undecided"
    (few,) = tethra_tables.claims(parts(ahead[:5]))
    assert few["verdict"] == "undecided"  # 2 / 2^5 at best
    # One that has diverged counts as the worse.
    ahead[3, 1] = np.inf
    assert tethra_tables.claims(parts(ahead))[0]["wins"] == 12


def test_claims_of_one_family_are_corrected_after_holm():
    """Of m claims the least p counts m times, the next m - 1 times, and none less than the one before."""
    rng = np.random.default_rng(1)
    pairs = {
        f"claim {k}": [(float(x), 1.0) for x in np.exp(rng.normal(-push, 1.0, size=12))]
        for k, push in enumerate((1.5, 1.0, 0.7, 0.1))
    }
    found = decided(pairs)
    p = np.array([one["p"] for one in found])
    order = np.argsort(p)
    by_hand = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    assert [found[k]["p_holm"] for k in order] == pytest.approx(by_hand)
    assert {one["verdict"] for one in found} == {"holds", "undecided"}


def test_the_page_says_what_was_found():
    found = json.loads((tethra_tables.HERE / "results.json").read_text())
    page = (ROOT / "experiments" / "README.md").read_text()
    assert {one["dives"] for one in found["claims"]} == {12}
    assert len(found["claims"]) == len(tethra_tables.CLAIMS) and len(found["rounding"]) == 12
    assert tethra_tables.claim_table(found["claims"]) in page and tethra_tables.overview(found) in page
    assert all(bar["met"] for bar in found["bars"])
