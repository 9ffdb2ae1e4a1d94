"""What the repository says of itself in several places is the same in all."""

import re
import tomllib

import yaml

from jaxmarine import CATALOGUE, __version__

from .conftest import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_that_of_the_readme():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    entry = (ROOT / "README.md").read_text().partition("@software{")[2].partition("```")[0]
    told = {key: value for key, value in re.findall(r"(\w+) += \{(.*)\},\n", entry)}
    assert citation["title"] == re.sub("[{}]", "", told["title"])
    assert citation["authors"] == [{"name": told["author"].strip("{}")}]
    assert citation["version"] == told["version"] == PROJECT["version"] == __version__
    assert citation["license"] == PROJECT["license"] and citation["keywords"] == PROJECT["keywords"]


def test_the_changelog_begins_with_this_version():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert re.findall(r"^## (\S+)", text, re.MULTILINE)[0] == __version__
    assert f"{len(CATALOGUE)} kinds of causes" in " ".join(text.split())


def test_a_commit_is_checked_as_make_test_does():
    (hooks,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    commands = [hook["entry"].removeprefix(".venv/bin/") for hook in hooks["hooks"]]
    recipe = re.search(r"^test: \$\(STAMP\)\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert recipe is not None
    assert [line.removeprefix("\t$(BIN)/") for line in recipe[1].splitlines()][:-1] == commands
