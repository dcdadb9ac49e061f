"""Grids of a node: which are refused, what is sent of a window, and how it is recorded."""

import numpy as np
import pytest
from fakes import FakeSource, run
from test_live_model import INFO, LAUNCH, TRAITS, config
from wire_messages import cells, grid

from gcd_client.images import layers
from gcd_client.protocol import GridMessage, decode, encode
from gcd_model import load_synthesizer
from gcd_node.config import parse_config
from gcd_node.errors import ConfigError
from gcd_node.ros_messages import data_messages
from gcd_node.sources.log_reader import ros2_types
from gcd_node.stream_context import prepare_stream

GRID = "[grid.around]\nextent_m = [-2.0, 6.0, -3.0, 3.0]\n"


@pytest.mark.parametrize(
    "lines",
    [
        *(f"extent_m = {extent}" for extent in ("[0.0, 10.0, 0.0]", "[5.0, 0.0, 0.0, 5.0]", "[0.0, 0.6, 0.0, 5.0]")),
        *(f"extent_m = [0.0, {far}, 0.0, 1.0]" for far in ("300.0", "1e300", "nan", "inf")),
        "extent_m = [180.0, 200.0, -5.0, 5.0]\ncell_m = 0.05",
        *("extent_m = [-100.0, 100.0, -5.0, 5.0]\ncell_m = 0.1", "cell_m = 0.01", "seconds = -1", "size = 3"),
    ],
)
def test_a_grid_that_cannot_be_made_is_refused_at_the_door(lines: str) -> None:
    with pytest.raises(ConfigError):
        config("[grid.around]\n" + lines)


def test_a_grid_without_the_ground_is_refused() -> None:
    prepare_stream(config(GRID), TRAITS, INFO)
    without = LAUNCH.replace("height_m = 1.2\ntilt_deg = 10.0", "elevation_deg = 5.0") + GRID
    with pytest.raises(ConfigError):
        prepare_stream(parse_config(without.encode(), "test"), TRAITS, INFO)


def test_every_window_has_a_grid_before_its_views_and_it_ends_with_them() -> None:
    box = run(config(GRID + "[grid.far]"), load_synthesizer("random:live"), FakeSource(4))
    grids = [each for each in box.views if each.topic == "grid/around"]
    assert [each.header.window_id for each in grids] == [0, 1, 2, 3]
    assert [each.topic for each in box.views[:3]] == ["grid/around", "grid/far", "view/topdown/win"]
    first = decode(encode(grids[0]))
    assert isinstance(first, GridMessage)
    header, view = first.header, box.views[2].header
    assert (header.shape, header.cell_m, header.origin_m, header.frame_id) == ((12, 16), 0.5, (-2.0, -3.0), "base_link")
    assert (header.t_capture_ns, header.src, header.cfg_digest) == (view.t_capture_ns, view.src, view.cfg_digest)
    assert not header.synthetic
    assert (layers(first).occupancy[layers(first).visibility == 0] == -1).all()
    assert {each.topic for each in box.ends} >= {"grid/around", "grid/far"}
    meta = next(fields for topic, fields in box.notes if topic == "meta")
    assert meta["grids"] == ["around", "far"]


def test_a_recording_holds_the_occupancy_where_ros_expects_it() -> None:
    message = grid()
    (made,) = data_messages(message, config(GRID))
    assert (made.topic, made.fields.__msgtype__) == ("/grid/around", "nav_msgs/msg/OccupancyGrid")
    assert (made.fields.info.width, made.fields.info.height, made.fields.info.origin.position.y) == (3, 2, 2.0)
    assert np.array_equal(made.fields.data, cells().occupancy.ravel())
    ros2_types().serialize_cdr(made.fields, made.fields.__msgtype__)
