"""Depth from elsewhere: as somebody measured it, or of a network of the user's, against planes."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gcd_model import CameraMount
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import Image
from gcd_node.sources.depth import OnnxDepth, clean_depth

MOUNT = CameraMount(height_m=1.4, tilt_deg=8.0, hfov_deg=80.0)


def network(
    path: Path,
    takes: Sequence[Any] = (1, 3, "high", "wide"),
    gives: Sequence[Any] = (1, "high", "wide"),
    *,
    channels: Sequence[int] = (1,),
    outputs: int = 1,
) -> Path:
    """An ONNX file whose depth is the mean of the colours: whatever a picture says. channels: the axes that the mean
    is of."""
    onnx = pytest.importorskip("onnx", reason="needs the extra `onnx`")
    pytest.importorskip("onnxruntime", reason="needs the extra `onnx`")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    keep, axes = int(len(gives) == 4), onnx.numpy_helper.from_array(np.array(channels, np.int64), "axes")
    names = [f"depth{i}" for i in range(outputs)]
    graph = helper.make_graph(
        [helper.make_node("ReduceMean", ["picture", "axes"], [name], keepdims=keep) for name in names],
        "depth",
        [helper.make_tensor_value_info("picture", kind, takes)],
        [helper.make_tensor_value_info(name, kind, gives) for name in names],
        [axes],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9), path)
    return path


def ground_inverse(width: int = 240, height: int = 160) -> NDArray[np.float64]:
    """1 / m of the ground below `MOUNT`, [H, W]; 0 above the horizon."""
    focal, tilt = width / 2 / math.tan(math.radians(40)), math.radians(8)
    v = (np.arange(height) + 0.5 - height / 2) / focal
    rows = (v * math.cos(tilt) + math.sin(tilt)) / 1.4
    return np.repeat(np.maximum(rows, 0)[:, None], width, axis=1)


def grey(values: NDArray[np.float64]) -> Image:
    """A picture that `network` turns into these values, 0 to 1."""
    return np.repeat(np.rint(values * 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(
    ("gives", "sides"), [((1, "high", "wide"), ("high", "wide")), ((1, 1, "high", "wide"), (70, 98))]
)
def test_a_metric_network_is_taken_at_its_word(tmp_path: Path, gives: Any, sides: Any) -> None:
    path = network(tmp_path / "net.onnx", (1, 3, *sides), (*gives[:-2], *sides))
    depth = OnnxDepth(path, kind="metric")(np.full((160, 240, 3), 255, np.uint8))
    white = np.mean((1 - np.array([0.485, 0.456, 0.406])) / [0.229, 0.224, 0.225])
    assert depth.shape == (160, 240)
    assert depth == pytest.approx(float(white), rel=1e-5)


@pytest.mark.parametrize(("a", "b"), [(1.6, -0.1), (0.9, 0.0)])
def test_the_ground_gives_relative_depth_its_scale_and_shift(tmp_path: Path, a: float, b: float) -> None:
    inverse = ground_inverse()
    inverse[60:150, 40:100] = 0.5  # somebody stands there
    y = (inverse - b) / a
    assert y.max() <= 1
    assert y.min() >= 0
    depth = OnnxDepth(network(tmp_path / "net.onnx"), kind="inverse", scale=MOUNT)(grey(y))
    near = inverse > 0.1
    assert np.mean(np.abs(depth[near] * inverse[near] - 1) < 0.03) > 0.97  # the rest are the edges of who stands there


@pytest.mark.parametrize("tilt_deg", [-60.0, 8.0, 89.0])
def test_without_ground_that_gives_a_scale_there_is_no_depth(tmp_path: Path, tilt_deg: float) -> None:
    mount = CameraMount(height_m=1.4, tilt_deg=tilt_deg, hfov_deg=20.0)
    net = OnnxDepth(network(tmp_path / "net.onnx"), kind="inverse", scale=mount)
    with pytest.raises(DepthError) as raised:
        net(grey(np.full((160, 240), 0.5)))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "other",
    [{"takes": (1, 1, "high", "wide")}, {"gives": (1, 3, 1, "wide"), "channels": (2,)}, {"outputs": 2}],
    ids=["grey", "colours out", "two outputs"],
)
def test_a_network_of_another_signature_is_refused_by_what_it_has(tmp_path: Path, other: dict[str, Any]) -> None:
    path = network(tmp_path / "net.onnx", **other)
    with pytest.raises(ConfigError) as raised:
        OnnxDepth(path, kind="metric")
    assert "\n" not in str(raised.value)


def test_what_is_no_network_or_lacks_a_scale_is_refused(tmp_path: Path) -> None:
    path = network(tmp_path / "net.onnx", (1, 3, 70, 98), (1, 70, 98))
    (tmp_path / "damaged.onnx").write_bytes(path.read_bytes()[:40])
    bad: list[tuple[Path, dict[str, Any]]] = [
        (tmp_path / "missing.onnx", {"kind": "metric"}),
        (tmp_path / "damaged.onnx", {"kind": "metric"}),
        (path, {"kind": "inverse"}),
    ]
    for file, options in bad:
        with pytest.raises(ConfigError):
            OnnxDepth(file, **options)


def test_millimetres_become_metres_and_what_is_no_distance_a_hole_in_the_pictures_size() -> None:
    cleaned = clean_depth(np.array([[1250, 0, 65535]], np.uint16), (1, 3))
    assert cleaned == pytest.approx(np.array([[1.25, 0.0, 0.0]]))
    depth = np.array([[1.5, np.nan, np.inf], [-np.inf, -2.0, 5.0]], np.float16)
    cleaned = clean_depth(depth, (4, 6))
    assert (cleaned.dtype, cleaned.shape, set(np.unique(cleaned))) == (np.float32, (4, 6), {0.0, 1.5, 5.0})


@pytest.mark.parametrize(
    "depth",
    [
        np.ones((4, 8), np.float32),
        np.ones((4, 6, 3), np.float32),
        np.ones((0, 6), np.float32),
        np.ones((4, 6), np.uint8),
    ],
    ids=["wider", "colours", "empty", "u8"],
)
def test_depth_of_another_shape_or_type_is_refused(depth: NDArray[Any]) -> None:
    with pytest.raises(DepthError) as raised:
        clean_depth(depth, (4, 6))
    assert "\n" not in str(raised.value)
    assert raised.value.exit_code == 65
