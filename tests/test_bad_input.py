"""What cannot be used is refused in one sentence that says what, where and what to do."""

import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from jaxmarine._errors import InputError
from jaxmarine.logs import read_log, write_log
from jaxmarine.vehicle_file import read_vehicle_file

from .test_logs import PLANAR, planar_table
from .test_vehicle_file import EFFECTS, MINIMAL, THRUSTERS


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        act()
    message = str(caught.value)
    assert "\n" not in message and message.endswith((".", "?", ")")), message
    assert "Traceback" not in message and "pydantic" not in message
    return message


# --- logs: the table -------------------------------------------------------------------------


def with_cell(column: str, row: int, value: object) -> pd.DataFrame:
    table = planar_table().astype({column: object})
    table.loc[row, column] = value
    return table


def without(*columns: str) -> pd.DataFrame:
    return planar_table().drop(columns=list(columns))


BAD_TABLES = {
    "no time": (without("t"), "has no column `t`"),
    "time empty": (with_cell("t", 4, None), "`t` is empty in data row 5"),
    "time repeated": (with_cell("t", 1, 0.0), "is 0.0 s in data row 2, after 0.0 s"),
    "time back": (with_cell("t", 4, 0.05), "is 0.05 s in data row 5, after 0.3"),
    "time as text": (
        with_cell("t", 2, "12:30:05"),
        "column `t` holds '12:30:05' in data row 3, which is not a number",
    ),
    "text in a cell": (with_cell("u", 3, "fast"), "column `u` holds 'fast' in data row 4"),
    "truth in a cell": (planar_table().assign(psi=True), "column `psi` holds 'True'"),
    "decimal comma": (with_cell("u", 3, "0,5"), "`u` holds '0,5' in data row 4"),
    "infinite": (with_cell("v", 6, np.inf), "column `v` is infinite in data row 7"),
    "absurd": (with_cell("v", 6, 1e38), "column `v` is 1e+38 in data row 7"),
    "command too large": (
        with_cell("port", 7, 1.01),
        "command `port` is 1.01 in data row 8 (t = 0.7 s), outside [-1, 1]",
    ),
    "command too small": (with_cell("star", 0, -1.3), "`star` is -1.3 in data row 1"),
    "command infinite": (with_cell("star", 0, -np.inf), "`star` is infinite in data row 1"),
    "no command": (without("star"), "lacks `star`; a log needs one command column per thruster"),
    "no drive at all": (without("port", "star"), "lacks `port`, `star`"),
    "half a wrench": (without("port").assign(X=0.0, Y=0.0), "lacks `port`"),
    "commands empty": (planar_table().assign(port=np.nan), "`port` has no value in any row"),
    "no motion": (without("x", "u"), "needs position with attitude (`x`, `y`, `psi`) or velocity"),
    "motion empty": (
        without("x", "y", "psi").assign(v=np.nan),
        "column `v` has no value in any row",
    ),
    "too few rows": (planar_table(9), "has 9 rows, but a log needs at least 10"),
    "one row": (planar_table(1), "has 1 row, but"),
    "no rows": (planar_table(0), "no rows"),
}


@pytest.mark.parametrize("name", ["bad.csv", "bad.csv.gz"])
@pytest.mark.parametrize("table,fragment", BAD_TABLES.values(), ids=BAD_TABLES)
def test_a_bad_table_is_refused(tmp_path, table, fragment, name):
    table.to_csv(tmp_path / name, index=False)
    message = refusal(lambda: read_log(tmp_path / name, PLANAR))
    assert fragment in message
    assert name in message


@pytest.mark.parametrize(
    "table,fragment",
    [
        (planar_table().assign(t=pd.Timestamp("2024-01-01")), "column `t` holds '2024-01-01"),
        (planar_table().assign(u="fast"), "column `u` holds 'fast' in data row 1"),
        (planar_table().assign(u=True), "column `u` holds 'True' in data row 1"),
        (planar_table(0), "has 0 rows"),
        (pd.DataFrame(), "is empty"),
    ],
)
def test_a_bad_parquet_table_is_refused(tmp_path, table, fragment):
    table.to_parquet(tmp_path / "bad.parquet")
    assert fragment in refusal(lambda: read_log(tmp_path / "bad.parquet", PLANAR))


# --- logs: the file --------------------------------------------------------------------------

GOOD = planar_table().to_csv(index=False)
HEADER, FIRST, *REST = GOOD.splitlines()

BAD_FILES = {
    "empty": ("bad.csv", b"", "is empty"),
    "blank": ("bad.csv", b"\n\n", "has"),
    "header only": ("bad.csv", HEADER.encode(), "no rows"),
    "duplicate column": (
        "bad.csv",
        GOOD.replace("t,x,", "t,u,", 1).encode(),
        "2 columns named `u`",
    ),
    "not text": ("bad.csv", b"\xff\xfe\x00t,\x80\x81\n1,2\n", "is not UTF-8 text"),
    "semicolons": ("bad.csv", GOOD.replace(",", ";").encode(), "write commas between columns"),
    "row too long": ("bad.csv", "\n".join([HEADER, FIRST, FIRST + ",1", *REST]).encode(), "line 3"),
    "rows too long": (
        "bad.csv",
        "\n".join([HEADER, *(line + ",1" for line in [FIRST, *REST])]).encode(),
        "names 9 columns, but its rows have 10 cells",
    ),
    "rows too short": (
        "bad.csv",
        "\n".join([HEADER + ",du", FIRST, *REST]).encode(),
        "names 10 columns, but its rows have 9 cells",
    ),
    "no gzip": ("bad.csv.gz", GOOD.encode(), "cannot be read as a .csv.gz file"),
    "half a gzip": ("bad.csv.gz", b"\x1f\x8b\x08\x00\x00", "cannot be read as a .csv.gz file"),
    "no parquet": ("bad.parquet", GOOD.encode(), "cannot be read as a .parquet file"),
    "other format": ("bad.xls", b"", "does not end in .csv, .csv.gz, .parquet"),
}


@pytest.mark.parametrize("name,content,fragment", BAD_FILES.values(), ids=BAD_FILES)
def test_a_bad_log_file_is_refused(tmp_path, name, content, fragment):
    (tmp_path / name).write_bytes(content)
    assert fragment in refusal(lambda: read_log(tmp_path / name, PLANAR))


def test_a_log_that_is_not_there_or_no_file_is_refused(tmp_path):
    missing = tmp_path / "nowhere.csv"
    assert "no such file" in refusal(lambda: read_log(missing, PLANAR))
    (tmp_path / "folder.csv").mkdir()
    assert "is a folder" in refusal(lambda: read_log(tmp_path / "folder.csv", PLANAR))
    assert "cannot be read" in refusal(lambda: read_log("x" * 5000 + ".csv", PLANAR))
    assert "cannot be read" in refusal(lambda: read_log("null\0byte.csv", PLANAR))


def test_a_vehicle_without_thrusters_needs_the_wrench(tmp_path):
    bare = types.SimpleNamespace(dof=("surge",), command_names=(), command_limits=np.ones(0))
    planar_table().to_csv(tmp_path / "run.csv", index=False)
    message = refusal(lambda: read_log(tmp_path / "run.csv", bare))
    assert "lacks `X`; the vehicle has no thruster" in message


def test_a_log_cannot_be_written_to_an_unknown_format_or_folder(tmp_path):
    planar_table().to_csv(tmp_path / "run.csv", index=False)
    log = read_log(tmp_path / "run.csv", PLANAR)
    assert "does not end in" in refusal(lambda: write_log(log, tmp_path / "run.txt"))
    assert "cannot be written" in refusal(lambda: write_log(log, tmp_path / "no" / "run.csv"))


# --- logs: the column map --------------------------------------------------------------------

BAD_MAPS = {
    "no such file": (None, "no such file"),
    "no table": ("", "`columns` is missing"),
    "unknown table": ("[columns]\n[coloumns]", "`coloumns` is an unknown key; did you mean"),
    "unknown contract name": ('[columns]\nsurge = "u"', "gives `surge`, which is no column"),
    "unknown file name": ('[columns]\nx = "spead"', "has no column `spead`"),
    "near file name": ('[columns]\nx = "porrt"', "did you mean `port`?"),
    "no source": ("[columns]\nx = {scale = 2.0}", "`columns.x.from` is missing"),
    "unknown key": (
        '[columns]\nx = {from = "x", scal = 2}',
        "`columns.x.scal` is an unknown key; did you mean `scale`?",
    ),
    "text scale": ('[columns]\nx = {from = "x", scale = "2"}', "`columns.x.scale` is '2', but"),
    "zero scale": ('[columns]\nx = {from = "x", scale = 0.0}', "must not be zero"),
    "infinite offset": ('[columns]\nx = {from = "x", offset = inf}', "`columns.x.offset` is inf"),
    "number as source": ("[columns]\nx = 3", "`columns.x` is 3"),
    "beyond the range": ('[columns]\nport = {from = "port", scale = 99.0}', "(`port`"),
}


@pytest.mark.parametrize("text,fragment", BAD_MAPS.values(), ids=BAD_MAPS)
def test_a_bad_column_map_is_refused(tmp_path, text, fragment):
    planar_table().to_csv(tmp_path / "run.csv", index=False)
    if text is not None:
        (tmp_path / "map.toml").write_text(text)
    message = refusal(lambda: read_log(tmp_path / "run.csv", PLANAR, tmp_path / "map.toml"))
    assert fragment.strip("(") in message


# --- vehicle files ---------------------------------------------------------------------------

WHOLE = MINIMAL + "\n[sensors]\nposition = 0.01\n" + THRUSTERS + EFFECTS
INERTIA = "[[5.0, 0.0, -0.5], [0.0, 6.0, 0.0], [-0.5, 0.0, 7.0]]"
SIX = "[10.0, 20.0, 30.0, 40.0, 50.0, 60.0]"

BAD_VEHICLES = {
    "unknown key": ("mass = 2.0", "mas = 2.0", "`body.mas` is an unknown key; did you mean"),
    "extra key": (
        "mass = 2.0",
        "mass = 2.0\nmas = 1",
        "`body.mas` is an unknown key; did you mean",
    ),
    "extra table": ("[sensors]", "[sensor]", "`sensor` is an unknown key; did you mean `sensors`?"),
    "unknown sensor": ("position = 0.01", "sonar = 0.01", "known are position, attitude"),
    "schema 2": ("schema = 1", "schema = 2", "`schema` is 2, but only 1 is known"),
    "schema text": ("schema = 1", 'schema = "1"', "`schema` is '1', but must be 1"),
    "no schema": ("schema = 1", "", "`schema` is missing"),
    "no body": ("[body]", "[boody]", "`boody` is an unknown key; did you mean `body`?"),
    "number name": ('name = "brick"', "name = 3", "`name` is 3, but must be"),
    "bad dof": ('name = "brick"', 'name = "b"\ndof = ["surge", "yawn"]', "did you mean `yaw`?"),
    "no dof": ('name = "brick"', 'name = "b"\ndof = []', "at least one"),
    "dof twice": ('name = "brick"', 'name = "b"\ndof = ["yaw", "yaw"]', "once"),
    "no mass": ("mass = 2.0", "", "`body.mass` is missing; give a positive number [kg]"),
    "negative mass": ("mass = 2.0", "mass = -2.0", "`body.mass` is -2.0, but must be a positive"),
    "zero mass": ("mass = 2.0", "mass = 0", "`body.mass` is 0.0, but must be a positive"),
    "mass as text": ("mass = 2.0", 'mass = "2"', "`body.mass` must be a number, but is '2'"),
    "mass as truth": ("mass = 2.0", "mass = true", "`body.mass` must be a number, but is True"),
    "mass infinite": ("mass = 2.0", "mass = inf", "`body.mass` must be a finite number"),
    "mass nan": ("mass = 2.0", "mass = nan", "`body.mass` must be a finite number"),
    "mass beyond all": ("mass = 2.0", f"mass = 1{'0' * 400}", "`body.mass` must be a finite"),
    "mass absurd": ("mass = 2.0", "mass = 1e200", "`body.mass` must be in SI units, where no vehicle has"),
    "unending digits": ("mass = 2.0", f"mass = 1{'0' * 5000}", "too many digits"),
    "no inertia": (f"inertia = {INERTIA}", "", "`body` lacks `inertia`"),
    "inertia not positive": ("[0.0, 6.0, 0.0]", "[0.0, -6.0, 0.0]", "must be positive definite"),
    "inertia products": (
        INERTIA,
        INERTIA.replace("-0.5", "-50.0"),
        "`body.inertia` must be positive definite",
    ),
    "inertia not symmetric": (
        "[-0.5, 0.0, 7.0]",
        "[0.5, 0.0, 7.0]",
        "`body.inertia` must be symmetric, but entry (1, 3) is -0.5 and entry (3, 1) is 0.5",
    ),
    "inertia shape": (
        INERTIA,
        "[[1.0, 2.0], [3.0, 4.0]]",
        "must be 3 rows of 3 numbers, but its 2 rows",
    ),
    "inertia diagonal": (INERTIA, "[5.0, 6.0, 7.0]", "`body.inertia` must be 3 rows of 3 numbers"),
    "inertia about cog": (
        "cog = [0.1, 0.2, 0.3]",
        "cog = [0.0, 0.0, 9.0]",
        "must be positive definite on the free degrees",
    ),
    "added mass negative": ("[1, 2, 3, 4, 5, 6]", "[1, 2, 3, 4, 5, -60]", "positive definite on"),
    "mass matrix not symmetric": (
        "[added_mass]",
        f"mass_matrix = {(np.eye(6) + np.eye(6, k=1)).tolist()}\n[added_mass]",
        "`body.mass_matrix` must be symmetric, but entry (1, 2) is 1",
    ),
    "cog short": (
        "cog = [0.1, 0.2, 0.3]",
        "cog = [0.1, 0.2]",
        "must be 3 numbers [x, y, z], but has 2",
    ),
    "cog missing": ("cog = [0.1, 0.2, 0.3]", "", "`body.cog` is missing; give [x, y, z]"),
    "matrix shape": (SIX, "[1.0, 2.0, 3.0]", "`damping.linear` must be 6 rows of 6 numbers, or 6"),
    "matrix ragged": (SIX, "[[1.0], [2.0, 3.0]]", "its 2 rows have the lengths 1, 2"),
    "matrix number": (SIX, "5.0", "`damping.linear` must be 6 rows of 6"),
    "matrix text": (
        SIX,
        '[1, 2, 3, 4, 5, "6"]',
        "`damping.linear` holds an entry that must be a number",
    ),
    "weight negative": ("[added_mass]", "weight = -1\n[added_mass]", "`body.weight` is -1, but"),
    "gravity": ("[body]", "[environment]\ngravity = 0.0\n[body]", "`environment.gravity` is 0.0"),
    "thruster twice": ('name = "bow"', 'name = "stern"', "has the name `stern` more than once"),
    "thruster named t": ('name = "bow"', 'name = "t"', "`thruster[1].name` is `t`, which names"),
    "thruster named X": ('name = "bow"', 'name = "X"', "names something else in logs"),
    "thruster named all": ('name = "bow"', 'name = "all"', "names something else"),
    "thruster no name": ('name = "bow"', 'name = ""', "must be a name without spaces"),
    "thruster table": ("[[thruster]]", "[thruster]", "is not valid TOML"),
    "direction zero": ("[0.0, 3.0, 4.0]", "[0.0, 0.0, 0.0]", "`thruster[1].direction` must not be"),
    "max thrust": ("max_thrust = 80.0", "max_thrust = -80.0", "`thruster[2].max_thrust` is -80.0"),
    "lag": ("lag = 0.2", "lag = -0.2", "`thruster[2].lag` is -0.2, but must be a number not below"),
    "delay": ("delay = 0.1", "delay = -0.1", "`thruster[2].delay`"),
    "deadband": ("deadband = 0.05", "deadband = -0.1", "`thruster[2].deadband`"),
    "saturation": ("saturation = 0.8", "saturation = 0", "`thruster[2].saturation` is 0"),
    "thruster key": (
        "lag = 0.2",
        "lagg = 0.2",
        "`thruster[2].lagg` is an unknown key; did you mean",
    ),
    "sensor zero": ("position = 0.01", "position = 0.0", "`sensors.position` is 0.0, but must be"),
    "effect without name": ('effect = "thruster_gain"', "", "`effect[1].effect` is missing"),
    "effect text": ("factor = 0.71", 'factor = "x"', "`effect[1]` has a key `factor` that must be"),
    "effect nan": ("factor = 0.71", "factor = nan", "must be a finite number"),
    "effect since": ("since = 120", 'since = "noon"', "`effect[1].since` must be a number"),
    "effect log alone": ("since = 120\n", "", "has `since_log` without `since`"),
    "effect parameters": ("factor = 0.71", "parameters = 3", "write each parameter as a key"),
    "arrays elsewhere": ('"brick.npz"', '"../brick.npz"', "must be a plain file name"),
    "arrays with backslash": ('"brick.npz"', r'"a\\b.npz"', "must be a plain file name"),
    "inputs": ('["u", "psi"]', "[1, 2]", "`effect[2].inputs[1]` is 1, but must be"),
    "syntax": ("mass = 2.0", "mass = = 2.0", "is not valid TOML"),
    "key twice": ("mass = 2.0", "mass = 2.0\nmass = 3.0", "is not valid TOML"),
}


@pytest.mark.parametrize("old,new,fragment", BAD_VEHICLES.values(), ids=BAD_VEHICLES)
def test_a_bad_vehicle_file_is_refused(tmp_path, old, new, fragment):
    assert old in WHOLE
    path = tmp_path / "bad.toml"
    path.write_text(WHOLE.replace(old, new, 1))
    message = refusal(lambda: read_vehicle_file(path))
    assert fragment in message
    assert str(path) in message


def test_the_whole_file_that_is_spoilt_above_is_good(tmp_path):
    (tmp_path / "good.toml").write_text(WHOLE)
    assert read_vehicle_file(tmp_path / "good.toml").name == "brick"


def test_several_problems_are_counted(tmp_path):
    (tmp_path / "bad.toml").write_text(WHOLE.replace("mass = 2.0", "mas = 2.0"))
    message = refusal(lambda: read_vehicle_file(tmp_path / "bad.toml"))
    assert message.endswith("(1 other problem.)")


@pytest.mark.parametrize(
    "content,fragment",
    [
        (b"", "`schema` is missing"),
        (b"\x80\x81", "is not UTF-8 text"),
        (b"a = " + b"[" * 10_000, "is not usable TOML"),
        (b"# " + b"x" * 10_000_001, "has 10 MB, but such a file has at most 10 MB"),
    ],
)
def test_a_file_that_is_no_vehicle_is_refused(tmp_path: Path, content, fragment):
    (tmp_path / "bad.toml").write_bytes(content)
    assert fragment in refusal(lambda: read_vehicle_file(tmp_path / "bad.toml"))


def test_a_vehicle_file_that_is_not_there_or_no_file_is_refused(tmp_path):
    assert "no such file" in refusal(lambda: read_vehicle_file(tmp_path / "none.toml"))
    assert "is a folder" in refusal(lambda: read_vehicle_file(tmp_path))
