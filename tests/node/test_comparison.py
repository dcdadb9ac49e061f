"""The demo's picture: every column in its place, class colours kept, and what the colours mean."""

from pathlib import Path

import numpy as np
import pytest
from wire_messages import CLASSES, numbers

from gcd_node.demo import demo_weights, moments
from gcd_node.errors import NodeError
from gcd_node.pictures.comparison import Moment, comparison, hatched, legend
from gcd_node.pictures.files import Image
from gcd_node.wire.class_colours import paint

HEIGHT, WIDTH = 24, 36
HEADINGS = ("input", "view", "classes")


def flat(level: int) -> Image:
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def moment(*, mapped: bool = True) -> Moment:
    painted = paint(numbers(1, 1, HEIGHT, WIDTH)[0], CLASSES)
    return Moment(source=flat(50), view=flat(120), classes=painted if mapped else None)


def colours_of(picture: Image) -> set[tuple[int, ...]]:
    return {tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()}


def test_input_view_and_class_map_stand_side_by_side_under_headings_and_over_a_legend() -> None:
    picture = comparison([moment(), moment()], CLASSES, HEADINGS)
    factor = 9  # the smallest whole one that makes 320 pixels of 36
    high, wide, line = factor * HEIGHT, factor * WIDTH, 22
    rows = 2 * (high + 4)
    assert picture.shape == (line + rows + len(legend(CLASSES, 3 * wide + 8)), 3 * wide + 8, 3)
    for top in (line, line + high + 4):
        row = picture[top : top + high]
        assert (row[:, :wide] == 50).all()
        assert (row[:, wide + 4 : 2 * wide + 4] == 120).all()
        assert np.array_equal(row[::factor, 2 * wide + 8 :: factor], moment().columns[2])
    assert (picture[:line] < 100).any()  # something is written there
    assert {each.colour for each in CLASSES} <= colours_of(picture[line + rows :])


def test_without_class_maps_there_are_two_columns_and_no_legend() -> None:
    picture = comparison([moment(mapped=False)], (), HEADINGS[:2])
    assert picture.shape == (22 + 9 * HEIGHT + 4, 2 * 9 * WIDTH + 4, 3)


def test_large_pictures_keep_their_size() -> None:
    large = Moment(source=np.zeros((256, 384, 3), np.uint8), view=np.zeros((256, 384, 3), np.uint8))
    assert comparison([large], (), HEADINGS[:2]).shape[1] == 2 * 384 + 4


def test_hatching_touches_painted_pixels_alone_and_leaves_most_of_them() -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8)
    seen = np.random.default_rng(1).integers(0, 3, (2, HEIGHT, WIDTH), np.uint8)
    changed = (hatched(pictures, seen) != pictures).any(axis=-1)
    assert not changed[seen > 0].any()
    assert 0.2 < changed[seen == 0].mean() < 0.5
    assert np.array_equal(hatched(pictures[0], seen[0]), hatched(pictures, seen)[0])


def test_hatching_is_diagonal_and_continuous() -> None:
    lines = hatched(flat(0), np.zeros((HEIGHT, WIDTH), np.uint8)).any(axis=-1)
    assert np.array_equal(lines[1:, :-1], lines[:-1, 1:])


@pytest.mark.parametrize("width", [80, 150, 1000])
def test_a_legend_takes_as_many_lines_as_it_needs_and_drops_no_class(width: int) -> None:
    picture = legend(CLASSES, width)
    assert picture.shape[1] == width
    assert len(picture) == 22 * {80: 3, 150: 2, 1000: 1}[width]
    for each in CLASSES:
        assert (picture == each.colour).all(axis=-1).sum() >= 14 * 14  # its whole swatch


def test_frames_of_windows_are_put_together_in_order() -> None:
    pictures = {window: [flat(10 * window + i) for i in range(2)] for window in (5, 2)}
    shown = moments(pictures, pictures, {})
    assert [int(each.view[0, 0, 0]) for window in shown for each in window] == [20, 21, 50, 51]
    assert all(each.classes is None for window in shown for each in window)


def test_windows_whose_class_map_did_not_arrive_are_left_out() -> None:
    pictures = {window: [flat(window)] for window in (1, 2, 3)}
    shown = moments(pictures, pictures, {2: [flat(9)]})
    assert [(int(each.source[0, 0, 0]), len(each.columns)) for window in shown for each in window] == [(2, 3)]


def test_a_window_that_was_saved_by_half_is_left_out() -> None:
    pictures = {window: [flat(window), flat(window)] for window in (1, 2)}
    shown = moments(pictures, pictures | {1: [flat(1)]}, {})
    assert [int(each.source[0, 0, 0]) for window in shown for each in window] == [2, 2]


@pytest.mark.parametrize("maps", [{}, {1: [flat(9)]}])
def test_a_demo_in_which_nothing_arrived_says_so(maps: dict[int, list[Image]]) -> None:
    with pytest.raises(NodeError, match="no whole window arrived"):
        moments({}, {}, maps)


def test_the_demo_runs_the_trained_weights_that_ship() -> None:
    assert demo_weights() == "package:driving-small"


def test_without_trained_weights_the_demo_runs_random_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gcd_node.demo.files", lambda _: tmp_path)
    assert demo_weights() == "random:driving"
