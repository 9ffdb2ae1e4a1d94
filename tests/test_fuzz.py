"""Files spoilt at random: the command line ends with 0, or with 2 and a sentence, and never writes half."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

import jaxmarine as jm
from jaxmarine.examples import operator, recorded

from .shell import exit_code

# What turns up in files that went through editors, spreadsheets, loggers and hands.
NUMBERS = [
    *b"nan NaN inf -inf 1e999 -1e308 1e-320 0 -0.0 -1 1e12 1e-9 0.5 3.7 -2.5 40.0 1e5 1e-4".split(),
    *(b"9" * 400, b"true", b"12:30:05", b'"1"', b"0,5", b"[1.0, 2.0]", b"0x1F", b"1_000"),
]
TOKENS = [
    *(b"", b",", b";", b"\t", b"\n", b"\r\n", b"\x00", b"\xff\xfe", b'"', b"'''", b"[[", b"]]", b"=", b"#"),
    *(b"<script>alert(1)</script>", b"../../etc/passwd", b"{{ 7 * 7 }}", b"[" * 3000, b"\xf0\x9f\x9a\xa2"),
]
NUMBER = re.compile(rb"(?<![\w.])-?\d+\.?\d*(?:[eE][-+]?\d+)?")
FILES = ("ship.toml", "run.csv", "run.parquet", "foreign.csv", "map.toml")

PLACE = st.floats(0.0, 1.0, exclude_max=True)
NUMBER_EDIT = st.tuples(st.just("number"), PLACE, st.just(0), st.sampled_from(NUMBERS))
BYTES_EDIT = st.tuples(
    st.just("bytes"), PLACE, st.integers(0, 60), st.one_of(st.sampled_from(TOKENS), st.binary(max_size=8))
)
CUT = st.tuples(st.just("cut"), PLACE, st.just(0), st.just(b""))
EDITS = st.lists(st.one_of(NUMBER_EDIT, NUMBER_EDIT, NUMBER_EDIT, BYTES_EDIT, CUT), min_size=1, max_size=2)


def spoilt(data: bytes, edits: list[tuple[str, float, int, bytes]]) -> bytes:
    """The bytes with numbers replaced, stretches replaced, or the end cut off."""
    for kind, place, width, token in edits:
        at, end = int(place * len(data)), len(data)
        if kind == "number" and (found := list(NUMBER.finditer(data))):
            at, end = found[int(place * len(found))].span()
        elif kind == "bytes":
            end = at + width
        data = data[:at] + token + data[end:]
    return data


class Files(dict[str, bytes]):
    """Contents by name, too long to be printed with every example."""

    def __repr__(self) -> str:
        return f"Files({', '.join(self)})"


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Files:
    """A vehicle file with an effect, a log in two formats, and a foreign log with its map."""
    folder = tmp_path_factory.mktemp("good")
    craft = jm.load_vehicle(jm.packaged_vehicle("cybership2"))
    t = np.arange(0.0, 8.0, 0.2)
    log = recorded(craft, operator(3, t, seed=1), t, seed=2, name="run.csv")
    jm.save_vehicle(craft, folder / "ship.toml")
    with (folder / "ship.toml").open("a") as file:
        file.write('\n[[effect]]\neffect = "thruster_gain"\ntarget = "port"\nsince = 2.0\nfactor = 0.7\n')
    jm.write_log(log, folder / "run.csv")
    jm.write_log(log, folder / "run.parquet")
    table = pd.read_csv(folder / "run.csv").rename(columns={"u": "speed"})
    table.assign(speed=2.0 * table["speed"]).to_csv(folder / "foreign.csv", index=False)
    (folder / "map.toml").write_text('[columns]\nu = {from = "speed", scale = 0.5, offset = 0.0}\n')
    return Files({name: (folder / name).read_bytes() for name in FILES})


def ended(capfd, folder: Path, *words: str | Path) -> int:
    """Runs a command line in the folder; checks how it ended, and gives the exit code."""
    before = sorted(folder.rglob("*"))
    code = exit_code(*words)
    out, err = capfd.readouterr()
    assert code in (0, 2), err
    assert "Traceback" not in out + err
    if code == 2:
        assert len(err.strip().splitlines()) == 1, err
        assert sorted(folder.rglob("*")) == before
    else:
        assert not err
    return code


def simulated(capfd, folder: Path, good: Files, name: str, edits: list) -> None:
    """Spoils one file and simulates; what is written is finite."""
    for other, data in good.items():
        (folder / other).write_bytes(spoilt(data, edits) if other == name else data)
    log, words = "run.csv", []
    if name == "run.parquet":
        log = name
    elif name in ("foreign.csv", "map.toml"):
        log, words = "foreign.csv", ["--columns", folder / "map.toml"]
    out = folder / "out.csv"
    files = ["--vehicle", folder / "ship.toml", "--log", folder / log, "--out", out]
    code = ended(capfd, folder, "simulate", *files, *words)
    event(f"{name}: exit code {code}")
    if code == 0:
        assert np.isfinite(pd.read_csv(out).to_numpy()).all()


FIXTURES = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]


@settings(max_examples=50, suppress_health_check=FIXTURES)
@given(name=st.sampled_from(FILES), edits=EDITS)
def test_a_spoilt_file_is_used_or_refused_in_a_sentence(capfd, tmp_path_factory, good, name, edits):
    simulated(capfd, tmp_path_factory.mktemp("spoilt"), good, name, edits)


@pytest.mark.slow
@settings(max_examples=5000, suppress_health_check=FIXTURES)
@given(name=st.sampled_from(FILES), edits=EDITS)
def test_many_spoilt_files_are_used_or_refused_in_a_sentence(capfd, tmp_path_factory, good, name, edits):
    simulated(capfd, tmp_path_factory.mktemp("spoilt"), good, name, edits)
