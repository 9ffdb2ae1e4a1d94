"""What mkdocs does besides for the site: pages that lie outside of docs/, links, and the catalogue's table.

Links in the pages are those of the repository, so that they also work where it is browsed; here they become
those of the site. What is no page of it, as a source file, is named without a link.
"""

import inspect
import posixpath
import re
from collections.abc import Iterable
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from jaxmarine.effects import CATALOGUE, AbstractEffect, Craft
from jaxmarine.vehicle_io import load_vehicle

ROOT = Path(__file__).resolve().parent.parent
# The stage in which effects of a module act.
STAGES = {
    "_drive": "command and thruster",
    "_actuator": "actuator",
    "_water": "water",
    "_load": "inertia",
    "_wrench": "wrench",
    "_sensor": "sensor",
}
# What the extension `arithmatex` makes of $...$, and of $$...$$.
_FORMULA = re.compile(
    r'<(?:span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</(?:span|div)>', re.DOTALL
)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


def outside() -> dict[str, str]:
    """Pages that lie elsewhere in the repository: their paths there, and in the site."""
    studies = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "experiments").rglob("README.md"))
    top = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
    return top | {path: path for path in studies if "/out/" not in path}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for path, uri in outside().items():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    del config
    uri = page.file.src_uri
    at = {site: path for path, site in outside().items()}.get(uri, f"docs/{uri}")
    text = in_site(markdown, at, uri, files.src_uris)
    for mark, make in MADE.items():
        if mark in text:
            text = text.replace(mark, make())
    return text


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas as MathML, which browsers draw without a script."""
    del page, config, files
    return _FORMULA.sub(lambda found: mathml(unescape(found[1] or found[2]), bool(found[2])), html)


def mathml(formula: str, alone: bool) -> str:
    return convert(formula.strip(), display="block" if alone else "inline")


def in_site(markdown: str, at: str, uri: str, known: Iterable[str]) -> str:
    """The text of a page `at` a path of the repository, with links as its `uri` in the site needs them."""

    def link(match: re.Match[str]) -> str:
        picture, words, target = match.groups()
        path, _, anchor = target.partition("#")
        if not path or "://" in path:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(at), path))
        site = outside().get(path, path.removeprefix("docs/"))
        if site not in known:
            return words
        to = posixpath.relpath(site, posixpath.dirname(uri) or ".")
        return f"{picture}[{words}]({to}{'#' + anchor if anchor else ''})"

    # Code stays as it is.
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else _LINK.sub(link, part) for part in parts)


def table() -> str:
    """The catalogue in the order in which effects act."""
    crafts = [load_vehicle(path) for path in sorted((ROOT / "jaxmarine" / "vehicles").glob("*.toml"))]
    head = ["| stage | effect | target | parameters | easily confused with |", "| --- " * 5 + "|"]
    return "\n".join([*head, *(row(effect, crafts) for effect in CATALOGUE)])


def row(effect: type[AbstractEffect], crafts: list) -> str:
    """One effect in the table."""
    others = ", ".join(f"`{name}`" for name in effect.confused_with)
    cells = (
        stage(effect),
        f"[`{effect.name}`](#{effect.name})",
        targets(effect, crafts),
        numbers(effect),
        others,
    )
    return "| " + " | ".join(cells) + " |"


def entries() -> str:
    """What each effect says of itself."""
    return "\n".join(entry(effect) for effect in CATALOGUE)


def entry(effect: type[AbstractEffect]) -> str:
    """One effect in words: what it does, where it shows, and what to look at on the boat."""
    told = inspect.cleandoc(effect.__doc__ or "")
    said = (("Shows best in", effect.shown_by), ("To look at", effect.advice))
    lines = [f"*{title}:* {words}." for title, words in said if words]
    return "\n\n".join([f"### `{effect.name}` {{ #{effect.name} }}", told, *lines, ""])


def stage(effect: type[AbstractEffect]) -> str:
    return STAGES[effect.__module__.rpartition(".")[2]]


def numbers(effect: type[AbstractEffect]) -> str:
    """Its parameters; those of one unit, side by side, share it."""
    out: list[tuple[list[str], str]] = []
    for name, unit in effect.units.items():
        if out and out[-1][1] == unit:
            out[-1][0].append(f"`{name}`")
        else:
            out.append(([f"`{name}`"], unit))
    return ", ".join(f"{', '.join(names)} [{unit}]" for names, unit in out)


def targets(effect: type[AbstractEffect], crafts: Iterable[Craft]) -> str:
    """What it may accuse on the packaged craft, by kinds."""
    kinds: dict[str, None] = {}
    for craft in crafts:
        for suspect in effect.suspects(craft):
            if suspect.target is not None:
                kinds[kind(suspect.target, craft)] = None
    return " or ".join(kinds)


def kind(target: str, craft: Craft) -> str:
    """The kind of thing that a target names on a craft."""
    for sign in ("<-", "+"):
        if sign in target:
            one, other = (kind(part, craft).strip("`") for part in target.split(sign))
            return f"`{one}{sign}{other}`"
    if target in craft.dof:
        return "`<dof>`"
    if target in craft.thruster_names:
        return "thruster"
    for those in craft.actuators:
        if target in those.names:
            return those.key
    return f"`{target}`"


# What stands in the place of these marks.
MADE = {"<!-- catalogue: table -->": table, "<!-- catalogue: entries -->": entries}
