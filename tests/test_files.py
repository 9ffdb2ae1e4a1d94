"""Files are written whole or not at all, even where the writer is killed."""

import random
import subprocess
import sys
import time

FILES = ("page", "figures/one.png", "figures/two.png", "data.json")
# Writes versions 1, 2, 3, ... of all files, each a megabyte of its number, and says so when one is done.
WRITER = f"""
import pathlib, itertools
from jaxmarine._files import write_together
folder = pathlib.Path("report")
(folder / "figures").mkdir(parents=True)
for version in itertools.count(1):
    write_together(folder, {{name: b"%08d" % version * 131072 for name in {FILES}}})
    print(version, flush=True)
"""
KILLS = 10


def test_a_killed_run_leaves_whole_files_of_which_the_page_is_the_oldest(tmp_path):
    rng = random.Random(0)
    for k in range(KILLS):
        folder = tmp_path / str(k)
        folder.mkdir()
        writer = subprocess.Popen([sys.executable, "-c", WRITER], cwd=folder, stdout=subprocess.PIPE)
        assert writer.stdout is not None
        writer.stdout.readline()
        # About as long as a version takes to write.
        time.sleep(rng.uniform(0.0, 0.02))
        writer.kill()
        writer.communicate()
        contents = {name: (folder / "report" / name).read_bytes() for name in FILES}
        versions = {name: int(content[:8]) for name, content in contents.items()}
        assert all(contents[name] == b"%08d" % version * 131072 for name, version in versions.items())
        page, others = versions.pop("page"), set(versions.values())
        assert page >= 1 and others <= {page, page + 1}
