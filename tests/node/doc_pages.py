"""Reads the pages: their blocks, links and commands."""

import re
import shlex
import types
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import typer

from gcd_node.cli.main import COMMANDS, new_app
from gcd_node.config import parse_config
from gcd_node.errors import ConfigError
from gcd_node.verbs import VERBS
from gcd_train.cli.main import app as train_app

ROOT = Path(__file__).parent.parent.parent
PAGES = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "launch/README.md", "tools/README.md", "client/README.md")
]
PAGES += sorted((ROOT / "docs").glob("*.md"))
LINKED = [*PAGES, *sorted((ROOT / "docs" / "log").glob("*.md")), *sorted((ROOT / "model").rglob("weights/*.md"))]
"""The log keeps commands that are gone; its links are checked."""
SHELL = ("", "sh", "bash", "console")
WHOLE = ("source.kind=synthetic", "model.weights=random:driving", "view.topdown.kind=fixed")
"""What a launch file cannot do without, as changes."""
SOURCES_AND_KEYS = {
    "synthetic": (),
    "mcap": ("path=x",),
    "file": ("path=x",),
    "folder": ("path=x", "fps=5"),
    "v4l2": (),
    "oak": (),
    "push": (),
    "rtsp": ("url=x",),
}
"""Every kind of source, with the keys that it cannot do without."""


class Block(NamedTuple):
    """A fenced block. language, mark: the words behind the fence, such as `toml fragment`."""

    page: str
    line: int
    language: str
    mark: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def read_blocks(page: str, text: str) -> Iterator[Block]:
    for found in re.finditer(r"^```([^\n`]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        language, _, mark = found[1].strip().partition(" ")
        yield Block(page, text.count("\n", 0, found.start()) + 1, language, mark, found[2])


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


BLOCKS = [block for page in PAGES for block in read_blocks(name_of(page), page.read_text())]


def without_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def headings(page: Path) -> set[str]:
    """Anchors as GitHub makes them."""
    found = re.findall(r"^#+ (.+)$", without_blocks(page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in found}


def dead_links(page: Path, text: str) -> list[str]:
    dead: list[str] = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_blocks(text)):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = page if not file else (page.parent / file).resolve()
        if not target.exists() or (anchor and anchor not in headings(target)):
            dead.append(f"{page.name}: {link}")
    return dead


def pages_named_in_code() -> dict[str, Path]:
    """Every page of docs that a message, docstring or comment names, with a file that names it."""
    suffixes = {".py", ".toml", ".sh", ".cpp", ".yaml", ".service", ".xml"}
    folders = ("gcd_node", "client", "model", "train", "launch", "tools", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in suffixes]
    return {found: path for path in files for found in re.findall(r"docs/[\w/-]+\.md", path.read_text())}


@cache
def programs() -> dict[str, Any]:
    return {"gcd-node": typer.main.get_command(new_app(COMMANDS)), "gcd-train": typer.main.get_command(train_app)}


def said_commands(text: str) -> Iterator[list[str]]:
    """Calls of our programs in a shell block, each as its words; comments, pipes and prompts are taken off."""
    for line in text.replace("\\\n", " ").splitlines():
        for call in re.split(r"\s(?:\\?\||&&|;|>|&)(?:\s|$)", re.sub(r"(?:^|\s)#.*", "", line).strip(" $")):
            words = shlex.split(call)
            while words and "=" in words[0]:
                words = words[1:]
            if words and Path(words[0]).name in programs():
                yield [Path(words[0]).name, *words[1:]]


def quoted_commands(text: str) -> Iterator[list[str]]:
    """The same in running text, between backticks."""
    for quoted in re.findall(r"`((?:gcd-node|gcd-train)(?: [^`]*)?)`", without_blocks(text)):
        yield from said_commands(quoted.replace("...", " "))


def mistakes(words: list[str]) -> list[str]:
    """What a call names that the program does not know."""
    command, rest, wrong = programs()[words[0]], words[1:], list[str]()
    while rest:
        word = rest.pop(0)
        if word.startswith("-") and word != "-":
            option = _option(command, word.partition("=")[0])
            if option is None:
                wrong.append(word)
            elif not option.is_flag and "=" not in word:
                values, rest = rest[: option.nargs], rest[option.nargs :]
                wrong += _wrong_change(values) if "--set" in option.opts else []
        elif hasattr(command, "commands"):
            if word not in command.commands:
                return [word]
            command = command.commands[word]
        elif command.name == "ctl" and word.islower() and "=" not in word and word not in VERBS:
            wrong.append(word)
    return wrong


def _option(command: Any, word: str) -> Any:
    if word == "--help":
        return types.SimpleNamespace(is_flag=True, opts=[word])
    return next((each for each in command.params if word in (*each.opts, *each.secondary_opts)), None)


def _wrong_change(values: list[str]) -> list[str]:
    """A change of a key that no launch file has."""
    for kind, needed in SOURCES_AND_KEYS.items():
        source = [f"source.{each}" for each in (f"kind={kind}", *needed)]
        try:
            parse_config(b"", "here", [*source, *WHOLE[1:], *values])
        except ConfigError as error:
            if "unknown key" in str(error):
                continue
        return []
    return values


def wrong_commands(page: str, text: str) -> list[str]:
    shell = [block.text for block in read_blocks(page, text) if block.language in SHELL]
    calls = [*quoted_commands(text), *(call for each in shell for call in said_commands(each))]
    return [f"{page}: {' '.join(words)}: {wrong}" for words in calls if (wrong := mistakes(words))]
