"""Small text files are read within limits, and refused with what is wrong with them."""

import os
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from gcd_model.errors import FileError
from gcd_model.small_files import MOST_DEPTH, decode_json, decode_toml, printable, read_small


class Facts(msgspec.Struct, forbid_unknown_fields=True):
    name: str = ""
    count: int = 0
    share: float = 0.0


class Open(msgspec.Struct):
    name: str = ""


def test_a_text_file_is_read_whole(tmp_path: Path) -> None:
    (tmp_path / "a").write_text('a = "größe"\n')
    assert read_small(tmp_path / "a") == 'a = "größe"\n'
    assert decode_toml(read_small(tmp_path / "a", 14)) == {"a": "größe"}


PLACES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "endless": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "not UTF-8": lambda path: path.write_bytes(b"caf\xe9"),
    "too large": lambda path: path.write_bytes(bytes(17)),
}


@pytest.mark.parametrize("place", PLACES)
def test_what_is_no_small_text_is_refused(tmp_path: Path, place: str) -> None:
    PLACES[place](tmp_path / "a")
    for name in (tmp_path / "a", "a\0b", "a" * 5000):  # no file has such names
        with pytest.raises(FileError):
            read_small(name, 16)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b'{"name": "\xff"}',
        b'{"count": NaN}',
        b'{"share": Infinity}',
        b'{"share": 1e999}',
        b'{"count": 18446744073709551616}',
        b'{"count": ' + b"9" * 5000 + b"}",
        b'{"share": -' + b"9" * 5000 + b"}",
        b'{"name": "a\\u0000b"}',
        b'{"other": 1}',
        b'{"count": ' + b"[" * 100_000,
    ],
)
def test_json_beyond_its_limits_is_refused(text: bytes) -> None:
    with pytest.raises(FileError):
        decode_json(text, Facts)


def test_what_a_reader_passes_over_is_held_to_the_limits_too() -> None:
    assert decode_json('{"name": "x", "more": [1, {}]}', Open) == Open(name="x")
    for more in ("[" * 100_000 + "]" * 100_000, "9" * 20, '"\\u0000"'):
        with pytest.raises(FileError):
            decode_json(f'{{"more": {more}}}', Open)


def test_digits_in_names_and_fractions_are_no_long_integers() -> None:
    digest = "0123456789" * 6
    assert decode_json(f'{{"name": "{digest}", "share": 0.{digest}}}', Facts).name == digest


@pytest.mark.parametrize(
    "text",
    [
        b"a = ",
        b'a = "\xff"',
        b"a = nan",
        b"a = [-inf]",
        b"a = " + b"9" * 20,
        b"a = " + b"9" * 5000,
        b'a = "\\u0000"',
        b'"\\u0000" = 1',
        b"a = " + b"[" * 100_000,
        b"a = " + b"[" * (MOST_DEPTH + 1) + b"]" * (MOST_DEPTH + 1),
        b".".join([b"a"] * 100) + b" = 1",
        b".".join([b"a"] * 100_000) + b" = 1",
        "\u2028.".join(['"a"'] * 1000).encode() + b" = 1",
        b"#" * 300_000,
    ],
)
def test_toml_beyond_its_limits_is_refused(text: bytes) -> None:
    with pytest.raises(FileError):
        decode_toml(text)


def test_a_name_is_shown_on_one_line_without_what_terminals_obey() -> None:
    assert printable("größe\n\x1b[2J\u202e") == r"größe\n\x1b[2J\u202e"
    shown = printable("a" * 1000 + "b" * 1000, 100)
    assert len(shown) <= 101
    assert shown.startswith("aaa")
    assert shown.endswith("bbb")
