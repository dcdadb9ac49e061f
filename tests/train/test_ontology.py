"""Class palettes read from the data set: there and back, duplicates, what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scenes4d import BOX, GROUND, SKY, ontology

from gcd_train.data.dataset4d import VOID, Ontology, OntologyItem, read_ontology
from gcd_train.data.files import FileFault
from gcd_train.errors import DataError

COLOUR = st.tuples(*[st.integers(0, 255)] * 3)


def made(colours: dict[int, tuple[int, int, int]]) -> Ontology:
    return Ontology(tuple(OntologyItem(id=i, name=f"class {i}", colour=colour) for i, colour in colours.items()))


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.integers(0, 255), COLOUR, min_size=1, max_size=60))
def test_ids_survive_colouring_but_for_those_that_share_a_colour(colours: dict[int, tuple[int, int, int]]) -> None:
    known = made(colours)
    ids = np.array(sorted(colours), np.uint8)
    np.testing.assert_array_equal(known.decode(known.encode(ids)), known.merge(ids))
    apart = [i for i in ids.tolist() if not any(i in group for group in known.duplicates)]
    np.testing.assert_array_equal(known.merge(np.array(apart, np.uint8)), apart)


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.integers(0, 255), COLOUR, min_size=1, max_size=20), st.lists(COLOUR, min_size=1, max_size=9))
def test_decoding_finds_the_nearest_colour(
    colours: dict[int, tuple[int, int, int]], asked: list[tuple[int, int, int]]
) -> None:
    known = made(colours)
    found = known.decode(np.array(asked, np.uint8))
    for colour, number in zip(asked, found.tolist(), strict=True):
        distances = {i: sum((a - b) ** 2 for a, b in zip(colour, c, strict=True)) for i, c in colours.items()}
        assert number == min(distances, key=lambda i: (distances[i], i))


def test_unlisted_ids_are_black_and_without_a_place() -> None:
    known = made({5: (10, 20, 30), 9: (1, 1, 1)})
    assert known.encode(np.array([6], np.uint8)).tolist() == [[0, 0, 0]]
    assert known.places[[5, 9, 6]].tolist() == [0, 1, VOID]
    assert [kind.name for kind in known.classes] == ["class 5", "class 9"]


@pytest.mark.parametrize(
    "items",
    [
        (),
        (OntologyItem(id=1, name="a", colour=(0, 0, 0)), OntologyItem(id=1, name="b", colour=(1, 0, 0))),
        (OntologyItem(id=256, name="a", colour=(0, 0, 0)),),
        (OntologyItem(id=1, name="a", colour=(0, 0, 256)),),
    ],
)
def test_an_impossible_ontology_is_refused(items: tuple[OntologyItem, ...]) -> None:
    with pytest.raises(DataError):
        Ontology(items)


def test_an_ontology_is_read_from_the_scene(tmp_path: Path) -> None:
    (tmp_path / "aa.json").write_text('{"other": 1}')
    (tmp_path / "bb.json").write_text(json.dumps(ontology()))
    assert [item.id for item in read_ontology(tmp_path).items] == [BOX, GROUND, SKY, 255]
    (tmp_path / "bb.json").unlink()
    with pytest.raises(FileFault, match=r"aa\.json is no ontology"):
        read_ontology(tmp_path)


def test_a_twice_listed_id_is_named_with_its_file(tmp_path: Path) -> None:
    told = {"items": [{"id": 1, "name": name, "color": {"r": 1, "g": 2, "b": 3}} for name in "ab"]}
    (tmp_path / "o.json").write_text(json.dumps(told))
    with pytest.raises(
        FileFault, match=r"o\.json is no usable ontology: an ontology has each id once, got \[1\] twice"
    ):
        read_ontology(tmp_path)
