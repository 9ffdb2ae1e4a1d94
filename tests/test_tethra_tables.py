"""The experiment of tables 6.1 to 6.7: its small version, and that a run which was cut goes on."""

import json

from experiments import tethra_tables


def test_quick_run_writes_tables_and_goes_on_where_it_was(tmp_path):
    tethra_tables.main(tmp_path, seeds=1, quick=True)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [
        name for name in ("results.md", "errors.png", "errors.svg") if not (tmp_path / name).exists()
    ] == []
    # A minute of collisions is enough for whole windows, once those with contact are left out.
    bars = {(b["method"], b["what"]): b for b in results["bars"]}
    assert bars["trajectory, rejecting", "M diagonal"]["met"]
    assert not bars["two-stage LS", "M diagonal"]["met"]
    parts = {path: path.read_text() for path in (tmp_path / "parts").iterdir()}
    tethra_tables.main(tmp_path, seeds=1, quick=True)
    assert {path: path.read_text() for path in (tmp_path / "parts").iterdir()} == parts
