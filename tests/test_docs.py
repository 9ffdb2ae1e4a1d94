"""The pages lead where they say, and become a site without a warning and without a network."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config
from typer.core import TyperGroup
from typer.main import get_command

import jaxmarine as jm
from docs import hooks
from jaxmarine import CATALOGUE
from jaxmarine.cli import app

from .conftest import ROOT

PAGES = sorted(
    [*hooks.outside(), *(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))]
)
# The README is a door: who wants more goes through it.
MOST_BYTES = 9000


def prose(name: str) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```$", "", (ROOT / name).read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", prose(page.relative_to(ROOT).as_posix()), re.MULTILINE)
    return {re.sub(r"[^a-z0-9 -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(name)):
        path, _, anchor = link.partition("#")
        if "://" in path:
            continue
        page = (ROOT / name).parent / path if path else ROOT / name
        assert page.exists(), link
        if anchor:
            assert anchor in anchors(page.resolve()), link


@pytest.mark.parametrize("name", PAGES)
def test_examples_of_files_are_files(name):
    for text in re.findall(r"^```toml\n(.*?)^```$", (ROOT / name).read_text(), re.MULTILINE | re.DOTALL):
        tomllib.loads(text)


def test_commands_that_pages_show_are_those_of_the_command_line():
    """Each call of `jaxmarine` in a shell block: a command that there is, with options that it has."""
    known = get_command(app)
    assert isinstance(known, TyperGroup)
    seen = set()
    for name in PAGES:
        for text in re.findall(r"^```sh\n(.*?)^```$", (ROOT / name).read_text(), re.MULTILINE | re.DOTALL):
            for line in text.replace("\\\n", " ").splitlines():
                for words in re.split(r"[|;]|&&", line.partition(" #")[0]):
                    program, *rest = shlex.split(words) or [""]
                    if Path(program).name != "jaxmarine":
                        continue
                    command = known.commands[rest[0]]
                    options = {
                        one for param in command.params for one in (*param.opts, *param.secondary_opts)
                    }
                    asked = {word.partition("=")[0] for word in rest[1:] if re.match(r"--?[a-z]", word)}
                    assert asked <= {*options, "--help"}, (name, line)
                    seen.add(rest[0])
    # All of them are shown somewhere.
    assert seen == {*known.commands}


def test_what_one_imports_stands_on_the_page_of_the_api():
    page = (ROOT / "docs" / "api.md").read_text()
    called = [name for name in dir(jm) if name[0] != "_" and callable(getattr(jm, name))]
    assert len(called) > 30 and [name for name in called if f"::: jaxmarine.{name}\n" not in page] == []


def test_the_readme_is_short_and_pictures_are_small():
    assert (ROOT / "README.md").stat().st_size <= MOST_BYTES
    assert sum(path.stat().st_size for path in (ROOT / "docs").rglob("*.png")) < 500_000


def test_links_of_the_repository_become_those_of_the_site():
    known = {
        "index.md",
        "trust.md",
        "maps/a.toml",
        "experiments/README.md",
        "experiments/usv/README.md",
        "a.png",
    }

    def told(text: str, at: str, uri: str) -> str:
        return hooks.in_site(text, at, uri, known)

    assert told("[t](docs/trust.md#limits)", "README.md", "index.md") == "[t](trust.md#limits)"
    assert told("[r](../README.md)", "docs/trust.md", "trust.md") == "[r](index.md)"
    assert told("[m](maps/a.toml)", "docs/trust.md", "trust.md") == "[m](maps/a.toml)"
    usv = "experiments/usv/README.md"
    assert told("![p](../../docs/a.png)", usv, usv) == "![p](../../a.png)"
    assert told("[e](../README.md#x)", usv, usv) == "[e](../README.md#x)"
    # No page of the site, another site, and code.
    assert told("[`s`](../jaxmarine/cli.py), so", "docs/trust.md", "trust.md") == "`s`, so"
    assert told("[e](https://example.org)", usv, usv) == "[e](https://example.org)"
    assert told("```\n[a](b.py)\n```\n", usv, usv) == "```\n[a](b.py)\n```\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, as `make docs` builds it: a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    config = load_config(str(ROOT / "mkdocs.yml"), strict=True, site_dir=str(folder))
    config.plugins.on_startup(command="build", dirty=False)
    build(config)
    return folder


def test_every_page_is_in_the_site_and_in_its_search(site):
    index = json.loads((site / "search" / "search_index.json").read_text())
    found = {entry["location"].partition("#")[0] for entry in index["docs"]}
    pages = {path.relative_to(site).as_posix() for path in site.rglob("*.html")} - {"404.html"}
    assert found == pages and len(pages) == len(PAGES)
    # A page that is opened from a folder may load scripts, but no data.
    assert (site / "search" / "search_index.js").read_text().startswith("var __index = ")


def test_the_catalogue_is_in_the_site(site):
    page = (site / "catalogue.html").read_text()
    for effect in CATALOGUE:
        assert f'id="{effect.name}"' in page and f'href="#{effect.name}"' in page


def test_the_site_loads_nothing_from_elsewhere(site):
    loading = re.compile(
        r"<(?:script|img|iframe|source)[^>]*\ssrc=\"?(?:https?:)?//|<link[^>]*\shref=\"?(?:https?:)?//"
    )
    for page in site.rglob("*.html"):
        assert not loading.search(page.read_text()), page.name
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(\"?(?:https?:)?//|@import", sheet.read_text()), sheet.name
