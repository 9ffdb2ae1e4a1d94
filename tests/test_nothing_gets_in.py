"""Files are data: no code in them is run, none fills the memory, no text becomes markup, nothing is sent."""

import ast
import functools
import gzip
import io
import pickle
import socket
import sys
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet
import pytest

import jaxmarine as jm
from jaxmarine.logs import _table, read_columns, read_log
from jaxmarine.logs._sources import _matlab
from jaxmarine.reports import write_report
from jaxmarine.vehicle_file import read_vehicle_file

from . import recordings as made
from .test_bad_input import refusal
from .test_logs import PLANAR, planar_table
from .test_report import EVIL, diagnosis, read
from .test_report import quick_pictures as quick_pictures
from .test_vehicle_file import MINIMAL, THRUSTERS

PACKAGE = Path(jm.__file__).parent
TERABYTE = 10**12


# --- no code from files ----------------------------------------------------------------------


@functools.cache
def sources() -> dict[str, ast.Module]:
    return {
        str(path.relative_to(PACKAGE)): ast.parse(path.read_text("utf-8")) for path in PACKAGE.rglob("*.py")
    }


def imported(tree: ast.Module) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(str(node.module))
    return {name.partition(".")[0] for name in names}


def called(tree: ast.Module) -> list[tuple[str, dict[str, str]]]:
    """What is called, without what it is called on, and its keywords."""
    calls = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func).rpartition(".")[2]
            calls.append((name, {str(k.arg): ast.unparse(k.value) for k in node.keywords}))
    return calls


def test_no_module_can_unpickle_or_run_what_it_reads():
    pickles = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    for name, tree in sources().items():
        # Compiled programs in the user's own cache are code anyway; whose are run, tests/test_kept.py says.
        assert name == "_kept.py" or not imported(tree) & pickles, name
        for function, keywords in called(tree):
            assert function not in {"eval", "exec", "read_pickle", "to_pickle", "fromfile"}, name
            if function in ("load", "savez", "savez_compressed", "save"):
                assert keywords.get("allow_pickle") == "False", f"{name}: {function}"


class Bomb:
    """What runs code when it is unpickled."""

    def __reduce__(self):
        return (exec, ("import sys; sys.unpickled = True",))


LEARNED = """
[[effect]]
effect = "unknown"
target = "surge"
arrays = "arrays.npz"
inputs = ["u"]
"""


def packed(**files: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(f"{name}.npy", content)
    return stream.getvalue()


def pickled_array() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array([Bomb()], dtype=object), allow_pickle=True)
    return stream.getvalue()


def array_that_claims(count: int) -> bytes:
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue()


BAD_ARRAYS = {
    "a pickled array": (packed(a=pickled_array()), "allow_pickle=False"),
    "a pickle": (pickle.dumps(Bomb()), "not a zip file"),
    "an array of a terabyte": (packed(a=array_that_claims(TERABYTE)), "is no file of arrays"),
    "zeros that unpack to much": (packed(a=bytes(110_000_000)), "claims 110 MB when unpacked"),
    "cut off": (packed(a=bytes(1000))[:-30], "is no file of arrays"),
    "damaged": (packed(a=bytes(1000)).replace(b"\x63\x60", b"\xff\xff", 1), "is no file of arrays"),
}


@pytest.mark.parametrize("content,fragment", BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_arrays_beside_a_vehicle_are_numbers_or_refused(tmp_path, content, fragment):
    (tmp_path / "v.toml").write_text(MINIMAL + LEARNED)
    (tmp_path / "arrays.npz").write_bytes(content)
    assert fragment in refusal(lambda: jm.load_vehicle(tmp_path / "v.toml"))
    assert not hasattr(sys, "unpickled")


# --- a terabyte ------------------------------------------------------------------------------


def sparse(path: Path, begin: bytes = b"") -> Path:
    """A file that says it has a terabyte and takes no room on the disk."""
    with path.open("wb") as file:
        file.write(begin)
        file.truncate(TERABYTE)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "log.csv",
        "log.csv.gz",
        "log.parquet",
        "log.mat",
        "log.bin",
        "log.tlog",
        "log.bag",
        "log.db3",
        "log.mcap",
    ],
)
def test_a_log_of_a_terabyte_is_refused_before_it_is_read(tmp_path, name):
    message = refusal(lambda: read_log(sparse(tmp_path / name), PLANAR))
    assert name in message
    if not name.endswith(
        (".bag", ".db3", ".mcap")
    ):  # which are known by their first bytes, and read in parts
        assert "has 1000000 MB" in message


def test_tables_of_a_terabyte_are_refused_before_they_are_read(tmp_path):
    for act in (read_vehicle_file, read_columns):
        assert "has 1000000 MB" in refusal(lambda: act(sparse(tmp_path / "big.toml", b"schema = 1\n")))  # noqa: B023
    (tmp_path / "v.toml").write_text(MINIMAL + LEARNED)
    sparse(tmp_path / "arrays.npz")
    assert "has 1000000 MB" in refusal(lambda: jm.load_vehicle(tmp_path / "v.toml"))


def test_what_unpacks_to_more_than_a_log_is_refused(tmp_path, monkeypatch):
    table = planar_table()
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(table.to_csv(index=False).encode()))
    many = pd.DataFrame({"t": np.arange(100_000.0), "u": np.zeros(100_000)})
    many.to_parquet(tmp_path / "log.parquet")
    read_log(tmp_path / "log.csv.gz", PLANAR)
    for module in (_table, _matlab):
        monkeypatch.setattr(module, "MOST_BYTES", 1000)
    assert "more than 0 MB when unpacked" in refusal(lambda: read_log(tmp_path / "log.csv.gz", PLANAR))
    assert "claims 100000 rows of 2 columns" in refusal(lambda: read_log(tmp_path / "log.parquet", PLANAR))


def test_matlab_variables_have_one_bound_together(tmp_path, monkeypatch):
    import scipy.io

    scipy.io.savemat(tmp_path / "run.mat", made.matlab(), do_compression=True)
    columns = _matlab.read_matlab(tmp_path / "run.mat")
    size = sum(8 * len(one) for one in columns.values())
    monkeypatch.setattr(_matlab, "MOST_BYTES", size // 2)
    assert "too long" in refusal(lambda: _matlab.read_matlab(tmp_path / "run.mat"))


# --- a thousand levels -----------------------------------------------------------------------

DEEP = {
    "lists": "mass = " + "[" * 1000 + "]" * 1000,
    "lists within the parser's reach": "mass = " + "[" * 100 + "]" * 100,
    "tables": "mass = " + "{a = " * 1000 + "1" + "}" * 1000,
    "a key": "mass" + ".a" * 1000 + " = 1",
    "a key of quoted parts": "mass" + ' . "a b"' * 1000 + " = 1",
    "a header": "[x" + ".a" * 1000 + "]",
    "a hundred thousand": "mass" + ".a" * 100_000 + " = 1",
}


@pytest.mark.parametrize("text", DEEP.values(), ids=DEEP)
@pytest.mark.parametrize("act", [read_vehicle_file, read_columns])
def test_tables_that_nest_a_thousand_levels_are_refused(tmp_path, act, text):
    (tmp_path / "deep.toml").write_text("[body]\n" + text)
    assert "nested too deeply" in refusal(lambda: act(tmp_path / "deep.toml"))


def test_what_is_long_but_not_deep_is_read(tmp_path):
    (tmp_path / "long.toml").write_text(MINIMAL + "#" + " 0.5 a.b.c" * 10_000 + "\n")
    assert read_vehicle_file(tmp_path / "long.toml").name == "brick"


def test_notes_in_a_parquet_file_that_nest_are_refused(tmp_path):
    table = pyarrow.Table.from_pandas(planar_table())
    for notes in (b"[" * 100_000, b'{"a":' * 1000):
        pyarrow.parquet.write_table(
            table.replace_schema_metadata({b"pandas": notes}), tmp_path / "log.parquet"
        )
        refusal(lambda: read_log(tmp_path / "log.parquet", PLANAR))


# --- the page --------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_pictures")
def test_a_vehicle_file_that_names_it_script_gives_a_page_without_that_script(tmp_path):
    (tmp_path / "v.toml").write_text(MINIMAL.replace('"brick"', f"'{EVIL}'") + THRUSTERS)
    craft = jm.load_vehicle(tmp_path / "v.toml")
    assert craft.name == EVIL
    page = write_report(diagnosis(vehicle=craft), tmp_path / "report")
    assert EVIL not in page.read_text("utf-8")
    assert f"Diagnosis of {EVIL}" in read(page).text
    assert read(page).scripts == [""]


# --- the network -----------------------------------------------------------------------------

NETWORK = {"socket", "ssl", "http", "urllib", "urllib3", "requests", "httpx", "aiohttp", "ftplib", "smtplib"}


# What serves a page to this machine alone (tests/test_pool.py, tests/test_watched_sources.py), by a module of
# `http` that asks for nothing.
SERVES = {"_local.py"}


def test_no_module_imports_what_reaches_the_network():
    for name, tree in sources().items():
        assert imported(tree) & NETWORK == ({"http"} if name in SERVES else set()), name
    for name in SERVES:
        assert "http.client" not in (PACKAGE / name).read_text()


def test_the_tests_run_without_a_network():
    with pytest.raises(AssertionError, match="network"):
        socket.create_connection(("localhost", 9))
    with socket.socket() as one, pytest.raises(AssertionError, match="network"):
        one.connect(("127.0.0.1", 9))


def test_an_address_is_a_file_that_is_not_there():
    for act in (lambda path: read_log(path, PLANAR), read_vehicle_file, read_columns):
        assert "no such file" in refusal(lambda: act("https://example.org/file.csv"))  # noqa: B023
