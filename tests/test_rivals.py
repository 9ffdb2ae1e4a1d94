"""The study of rivals: its sample, its grading, and that each method sees what is plainly there."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import rivals
from experiments.blind.cases import make_case
from experiments.blind.plant import Effect

# As in test_diagnosis, so that a vehicle's programs are compiled once.
TRAIN, TEST = 120.0, 60.0
CURRENT = Effect("steady_current", None, {"north": 0.05, "east": -0.03})
DRAG = Effect("quadratic_damping", "sway", {"value": 15.0})
NAME = ["steady_current", None]


def hiding(effect: Effect, folder: Path) -> rivals.Case:
    """A boat whose file does not know of an effect."""
    make_case(folder, "cybership2", [effect], 7, duration_train=TRAIN, duration_test=TEST)
    return rivals.opened(folder)


@pytest.fixture(scope="module")
def boat(tmp_path_factory) -> rivals.Case:
    return hiding(CURRENT, tmp_path_factory.mktemp("cases") / "single_00_0")


def test_the_sample_has_the_shares_of_the_matrix_and_nothing_too_weak(tmp_path):
    def written(kind: str, number: int, severity: float, content: dict) -> None:
        folder = tmp_path / f"{kind}_{number}"
        folder.mkdir()
        content = {"options": {"severity": severity}} | content
        (folder / "answer.json").write_text(json.dumps(content))

    for i in range(10):
        written("null", i, 1.0, {"findings": []})
        written("single", i, 3.0 if i else 1.1, {"findings": [{}]})
        written("pair", i, 3.0, {"findings": [{}, {}]})
        written("outside", i, 3.0, {"unknown": ["sway"]})
        written("misfit", i, 3.0, {"findings": [{}], "options": {"severity": 3.0, "misfit": True}})
    names = [path.name for path in rivals.sampled(tmp_path, 24, 1)]
    kinds = [name.partition("_")[0] for name in names]
    counts = {"null": 6, "single": 8, "pair": 4, "outside": 3, "misfit": 3}
    assert {kind: kinds.count(kind) for kind in counts} == counts
    assert "single_0" not in names
    assert names == [path.name for path in rivals.sampled(tmp_path, 24, 1)]
    assert names != [path.name for path in rivals.sampled(tmp_path, 24, 2)]


def test_columns_of_the_regression_are_what_the_hidden_effect_adds(boat):
    bench = boat.bench()
    missed, added, of = rivals.library(bench)
    labels = np.array([suspect.label for suspect in bench.layout.suspects])[of]
    values = np.array(list(CURRENT.parameters.values()))
    rest = missed - added[:, labels == "steady_current"] @ values / rivals.STEP
    # Noise alone is left, and a little of what is not linear in the current.
    assert missed.std() > 2.0
    assert rest.std() == pytest.approx(1.0, abs=0.2)
    assert not {"gyro_bias", "velocity_scale"} & set(labels)


def test_sparse_regression_names_a_plain_cause_first(boat):
    pytest.importorskip("pysindy")
    row = rivals.row(boat, "sparse", 1)
    assert row["first"] and row["found"][0] == NAME


@pytest.mark.slow
def test_the_worst_channel_is_graded_by_axis(boat):
    found = rivals.worst_channel(boat, 1)["findings"]
    assert [f["effect"] for f in found] == ["axis"]
    hidden = [{"accept": [["thruster_gain", "bow"]]}]
    case = rivals.Case("", boat.vehicle, boat.train, boat.test, {"findings": hidden, "options": {}})
    # The bow thruster pushes sideways and turns; it does not drive ahead.
    right = {axis: rivals.by_axis(case, rivals.said([("axis", axis)]))["first"] for axis in boat.vehicle.dof}
    assert right == {"surge": False, "sway": True, "yaw": True}
    # A current has no axis of its own.
    assert rivals.by_axis(boat, rivals.said([("axis", "surge")]))["first"] is None


@pytest.mark.slow
@pytest.mark.parametrize("key", ["ours", "bic", "score", "bank", "augmented"])
def test_a_plain_cause_is_named_and_buys_something(boat, key):
    row = rivals.row(boat, key, 1)
    assert row["first"] and row["found"][0] == NAME
    assert row["ratio"] < 0.7


@pytest.mark.slow
def test_networks_predict_what_they_cannot_name(tmp_path):
    # Drag is a function of the velocity; a current, which comes from where the boat heads, is not.
    row = rivals.row(hiding(DRAG, tmp_path / "single_00_0"), "black_box", 1)
    assert row["first"] is None and row["found"] == []
    assert row["ratio"] < 0.9


def test_the_table_has_a_line_for_each_method():
    row = {"kind": "single", "first": True, "whole": False, "named": True, "wrong": 1, "ratio": 0.5}
    nothing = {"kind": "null", "first": True, "whole": True, "named": False, "wrong": 0, "ratio": 1.0}
    found = {
        key: rivals.summary([row | {"seconds": 2.0}, nothing | {"seconds": 4.0}]) for key in rivals.METHODS
    }
    text = rivals.table(found)
    assert text.count("\n") == 2 + len(rivals.METHODS)
    assert (
        "| 1 of 1 (21 to 100 %) | 0 of 1 (0 to 79 %) | – | – | 0 of 1 (0 to 79 %) | 1 | 3.0 | 0.750 |" in text
    )


def test_a_rival_is_compared_log_by_log_by_whole_answers():
    def rows(key: str, right: list[bool]) -> list[dict]:
        return [
            {
                "method": key,
                "case": f"{i}",
                "kind": "outside" if i == 0 else "single",
                "first": one,
                "whole": whole,
            }
            for i, one in enumerate(right)
            # What is outside is right where it is said to be unknown, whatever it is said to depend on.
            for whole in [one and i > 0]
        ]

    keys = [key for key in rivals.METHODS if key not in ("black_box", "worst_channel")]
    told = [row for key in keys for row in rows(key, [key == "ours"] * 8)]
    found = rivals.claims(told)
    assert [claim["claim"] for claim in found] == [
        f"right more often than {rivals.METHODS[key].title}" for key in keys if key != "ours"
    ]
    assert all((claim["won"], claim["lost"], claim["verdict"]) == (8, 0, "holds") for claim in found)


@pytest.mark.parametrize("name", ["results.json", "without_filters.json"])
def test_the_page_has_the_numbers_of_the_kept_run(name):
    kept = json.loads((rivals.HERE / name).read_text())
    rows = kept["rows"]
    assert {key: rivals.summary([r for r in rows if r["method"] == key]) for key in kept["methods"]} == (
        kept["methods"]
    )
    assert rivals.claims(rows) == kept["claims"]
    assert rivals.told(kept).strip() in (rivals.HERE.parent / "README.md").read_text()
