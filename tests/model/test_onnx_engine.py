"""Graphs of one clip each, run one after the other, give what the networks give in one batch; and what is refused."""

from pathlib import Path

import pytest
import torch
from msgspec import structs
from small_models import TINY, random_clip, relative_error, tiny_synthesizer
from torch import Tensor

from gcd_model.clip import RenderOptions
from gcd_model.errors import DeviceMemoryError, ModelError, OptionError
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import empty_networks
from gcd_model.onnx_engine import CPU_PROVIDER, OnnxEngine, Providers, Sessions
from gcd_model.onnx_graphs import graphs
from gcd_model.onnx_manifest import GraphName
from gcd_model.synthesizer import Synthesizer

TENSORRT = "TensorrtExecutionProvider"


class TorchGraphs:
    """The graphs before they are exported, held to the sizes they would have."""

    def __init__(self, synthesizer: Synthesizer) -> None:
        self.graphs = {graph.name: graph for graph in graphs(synthesizer.networks)}
        self.runs: list[GraphName] = []

    def run(self, name: GraphName, *inputs: Tensor) -> tuple[Tensor, ...]:
        graph = self.graphs[name]
        self.runs.append(name)
        assert [each.shape for each in inputs] == [each.shape for each in graph.inputs.values()], name
        made = graph.module(*inputs)
        return made if isinstance(made, tuple) else (made,)


def engined(synthesizer: Synthesizer) -> tuple[Synthesizer, TorchGraphs]:
    """The same model, clip by clip."""
    found, config = TorchGraphs(synthesizer), synthesizer.traits.config
    return Synthesizer(empty_networks(config), synthesizer.traits, OnnxEngine(found, config)), found


def test_views_samples_and_branches_are_runs_of_one_graph() -> None:
    torched = tiny_synthesizer()
    ours, found = engined(torched)
    paths = [torched.traits.plan_view(SphericalDelta(azimuth_deg=angle)) for angle in (10.0, -20.0)]
    options = RenderOptions(seed=1, steps=2, guidance=(1.0, 2.0), guidance_interval=(0.0, 1.0), samples=2)
    features, expected_features = (each.encode(random_clip()) for each in (ours, torched))
    assert relative_error(features.latents, expected_features.latents) < 1e-5
    for view, expected in zip(
        ours.render(features, paths, options), torched.render(expected_features, paths, options), strict=True
    ):
        assert relative_error(view.latents, expected.latents) < 1e-5
        assert relative_error(view.video, expected.video) < 1e-5
    assert found.runs.count("step") == 4 + 8, "2 views of 2 samples, without guidance at the first level, with it then"
    assert found.runs.count("image_encoder") == found.runs.count("condition_encoder") == TINY.frames
    assert found.runs.count("decoder") == 4


def test_another_size_than_the_exports_is_refused() -> None:
    ours, _ = engined(tiny_synthesizer())
    clip = random_clip(structs.replace(TINY, height=64))
    with pytest.raises(OptionError, match=r"takes frames of 32x64 alone, got 64x64; export it again with --height"):
        ours.encode(clip)


# --- onnxruntime ---------------------------------------------------------------------------------------------------


def one_graph(tmp_path: Path, operator: str = "Add") -> dict[GraphName, Path]:
    """A file with one operator of two inputs [2]."""
    onnx = pytest.importorskip("onnx", reason="needs the extra `onnx`")
    pytest.importorskip("onnxruntime", reason="needs the extra `onnx`")
    names = ("first", "second", "sum")
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [2]) for name in names]
    nodes = [onnx.helper.make_node(operator, ["first", "second"], ["sum"])]
    graph = onnx.helper.make_graph(nodes, "one", values[:2], values[2:])
    opset = [onnx.helper.make_opsetid("", 20)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=9), tmp_path / "decoder.onnx")
    return {"decoder": tmp_path / "decoder.onnx"}


def test_tensors_go_in_by_order_and_come_back_as_tensors(tmp_path: Path) -> None:
    sessions = Sessions(one_graph(tmp_path), Providers())
    (made,) = sessions.run("decoder", torch.tensor([1.0, 2.0]), torch.tensor([[10.0, 0.0], [20.0, 0.0]])[:, 0])
    assert made.tolist() == [11.0, 22.0]


def test_whoever_looks_between_layers_looks_between_graphs(tmp_path: Path) -> None:
    sessions, seen = Sessions(one_graph(tmp_path), Providers()), []
    hook = torch.nn.modules.module.register_module_forward_pre_hook(lambda module, _: seen.append(module))
    try:
        sessions.run("decoder", torch.zeros(2), torch.zeros(2))
    finally:
        hook.remove()
    assert len(seen) == 1


def test_what_onnxruntime_says_is_our_error(tmp_path: Path) -> None:
    sessions = Sessions(one_graph(tmp_path), Providers())
    with pytest.raises(ModelError, match=r"onnxruntime cannot run decoder: .*; export it again") as raised:
        sessions.run("decoder", torch.zeros(3), torch.zeros(3))
    assert len(str(raised.value).splitlines()) == 1


def test_a_graph_onnxruntime_refuses_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="onnxruntime cannot run decoder"):
        Sessions(one_graph(tmp_path, "NoSuchOperator"), Providers())


def test_running_out_of_memory_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from onnxruntime.capi.onnxruntime_pybind11_state import RuntimeException

    sessions = Sessions(one_graph(tmp_path), Providers())

    def full(*_: object) -> None:
        raise RuntimeException("[ONNXRuntimeError] : 6 : Failed to allocate memory for requested buffer of size 9")

    monkeypatch.setattr(sessions._sessions["decoder"], "session", type("Full", (), {"run": full})())
    with pytest.raises(DeviceMemoryError, match="Render smaller frames"):
        sessions.run("decoder", torch.zeros(2), torch.zeros(2))


def test_an_absent_provider_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=f"has no {TENSORRT} here, only .*{CPU_PROVIDER}.*; install a build") as told:
        Sessions(one_graph(tmp_path), Providers(names=(TENSORRT,)))
    assert len(str(told.value).splitlines()) == 1


def test_the_cpu_comes_last_and_tensorrt_keeps_what_it_built(tmp_path: Path) -> None:
    chosen = Providers(names=(TENSORRT, CPU_PROVIDER), device=1, cache=tmp_path, half=True).with_options()
    assert [name for name, _ in chosen] == [TENSORRT, CPU_PROVIDER]
    assert chosen[0][1] == {
        "device_id": "1",
        "trt_fp16_enable": "True",
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": str(tmp_path),
    }
