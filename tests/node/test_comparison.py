"""The demo's picture: every column in its place, class colours kept, and what the colours mean."""

import numpy as np
import pytest
from wire_messages import CLASSES, numbers

from gcd_client.images import paint
from gcd_model import hatched
from gcd_node.demo import HEADINGS, moments
from gcd_node.errors import NodeError
from gcd_node.frame import Image
from gcd_node.pictures.comparison import Moment, comparison, legend

HEIGHT, WIDTH = 24, 36


def flat(level: int) -> Image:
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def moment() -> Moment:
    painted = paint(numbers(1, 1, HEIGHT, WIDTH)[0], CLASSES)
    return Moment(source=flat(50), view=flat(120), seen=flat(90), classes=painted)


def colours_of(picture: Image) -> set[tuple[int, ...]]:
    return {tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()}


def test_the_four_pictures_stand_side_by_side_under_headings_and_over_a_legend() -> None:
    picture = comparison([moment(), moment()], CLASSES, HEADINGS)
    factor = 9  # the smallest whole one that makes 320 pixels of 36
    high, wide, line = factor * HEIGHT, factor * WIDTH, 22
    rows, whole = 2 * (high + 4), 4 * wide + 12
    assert picture.shape == (line + rows + len(legend(CLASSES, whole)), whole, 3)
    for top in (line, line + high + 4):
        row = picture[top : top + high]
        for column, level in enumerate((50, 120, 90)):
            assert (row[:, column * (wide + 4) : column * (wide + 4) + wide] == level).all()
        assert np.array_equal(row[::factor, 3 * (wide + 4) :: factor], moment().classes)
    assert (picture[:line] < 100).any()  # something is written there
    assert {each.colour for each in CLASSES} <= colours_of(picture[line + rows :])


def test_large_pictures_keep_their_size() -> None:
    large = np.zeros((256, 384, 3), np.uint8)
    shown = Moment(source=large, view=large, seen=large, classes=large)
    assert comparison([shown], CLASSES, HEADINGS).shape[1] == 4 * 384 + 12


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


SEEN = np.full((HEIGHT, WIDTH), 2, np.uint8)


def test_frames_of_windows_are_put_together_in_order() -> None:
    pictures = {window: [flat(10 * window + i) for i in range(2)] for window in (5, 2)}
    shown = moments(pictures, pictures, {key: [SEEN, SEEN] for key in (5, 2)}, pictures)
    assert [int(each.view[0, 0, 0]) for window in shown for each in window] == [20, 21, 50, 51]


def test_what_was_never_seen_is_hatched() -> None:
    picture = {1: [flat(50)]}
    ((shown,),) = moments(picture, picture, {1: [0 * SEEN]}, picture)
    assert np.array_equal(shown.seen, hatched(flat(50), 0 * SEEN))


def test_windows_that_did_not_arrive_whole_are_left_out() -> None:
    pictures = {window: [flat(window)] for window in (1, 2, 3)}
    seen = {window: [SEEN] for window in (1, 2, 3)}
    assert [int(each.source[0, 0, 0]) for (each,) in moments(pictures, pictures, seen, {2: [flat(9)]})] == [2]
    assert [int(each.source[0, 0, 0]) for (each,) in moments(pictures, pictures, {3: [SEEN]}, pictures)] == [3]
    assert [int(each.source[0, 0, 0]) for (each,) in moments(pictures, {1: []} | {2: pictures[2]}, seen, pictures)] == [
        2
    ]


def test_a_demo_in_which_nothing_arrived_says_so() -> None:
    with pytest.raises(NodeError, match="no whole window arrived"):
        moments({}, {}, {}, {})
