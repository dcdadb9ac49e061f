"""Graphs of one clip each give what the networks give in one batch; and what is refused of exports."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import torch
from msgspec import structs
from small_models import TINY, TINY_DRIVING, as_loaded, random_clip, relative_error, tiny_driving, tiny_synthesizer
from torch import Tensor

from gcd_model.clip import View
from gcd_model.diffusion import RenderOptions, SolverName
from gcd_model.engines import onnx_export
from gcd_model.engines.onnx import CPU_PROVIDER, TENSORRT_PROVIDER, OnnxEngine, Sessions, load_export, provider_options
from gcd_model.engines.onnx_export import (
    FORMAT,
    MANIFEST,
    Manifest,
    export_onnx,
    graphs,
    is_export,
    read_manifest,
)
from gcd_model.errors import CheckpointError, DeviceMemoryError, ModelError, OptionError
from gcd_model.geometry import SphericalDelta
from gcd_model.loading import load_synthesizer
from gcd_model.networks import empty_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import digest


class TorchGraphs:
    """The graphs before they are exported, held to the sizes they would have."""

    def __init__(self, synthesizer: Synthesizer) -> None:
        self.graphs = {graph.name: graph for graph in graphs(synthesizer.networks)}
        self.runs: list[str] = []

    def run(self, name: str, *inputs: Tensor) -> Tensor:
        graph = self.graphs[name]
        self.runs.append(name)
        assert [each.shape for each in inputs] == [each.shape for each in graph.inputs.values()], name
        return graph.module(*inputs)


def engined(synthesizer: Synthesizer) -> tuple[Synthesizer, TorchGraphs]:
    """The same model, clip by clip."""
    found, networks = TorchGraphs(synthesizer), empty_networks(synthesizer.traits.config)
    return Synthesizer(networks, synthesizer.traits, OnnxEngine(found, networks)), found


@pytest.mark.parametrize(("solver", "runs", "bound"), [("euler", 3 * 4 + 8, 1e-5), ("heun", 5 * 4 + 2 * 8, 1e-4)])
def test_views_samples_and_branches_are_runs_of_one_graph(solver: SolverName, runs: int, bound: float) -> None:
    """2 views of 2 samples, guided at the last noise level alone, where Heun's correction also takes off."""
    torched = tiny_synthesizer()
    ours, found = engined(torched)
    paths = [torched.traits.plan_view(SphericalDelta(azimuth_deg=angle)) for angle in (10.0, -20.0)]
    options = RenderOptions(
        seed=1, steps=4, solver=solver, guidance=(1.0, 2.0), guidance_interval=(0.0, 1.0), samples=2
    )
    features, expected_features = (each.encode(random_clip()) for each in (ours, torched))
    assert relative_error(features.latents, expected_features.latents) < 1e-5
    for view, expected in zip(
        ours.render(features, paths, options), torched.render(expected_features, paths, options), strict=True
    ):
        assert relative_error(view.latents, expected.latents) < bound
        assert relative_error(view.video, expected.video) < bound
    assert found.runs.count("step") == runs
    assert found.runs.count("image_encoder") == found.runs.count("condition_encoder") == TINY.frames
    assert found.runs.count("decoder") == 4


def test_another_size_than_the_exports_is_refused() -> None:
    ours, _ = engined(tiny_synthesizer())
    with pytest.raises(OptionError):
        ours.encode(random_clip(structs.replace(TINY, height=64)))


def one_graph(tmp_path: Path, operator: str = "Add") -> dict[str, Path]:
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


def test_tensors_go_in_by_order_and_whoever_looks_between_layers_looks_between_graphs(tmp_path: Path) -> None:
    sessions, seen = Sessions(one_graph(tmp_path)), []
    hook = torch.nn.modules.module.register_module_forward_pre_hook(lambda module, _: seen.append(module))
    try:
        made = sessions.run("decoder", torch.tensor([1.0, 2.0]), torch.tensor([[10.0, 0.0], [20.0, 0.0]])[:, 0])
    finally:
        hook.remove()
    assert made.tolist() == [11.0, 22.0]
    assert len(seen) == 1


def test_what_onnxruntime_refuses_is_our_error_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ModelError) as raised:
        Sessions(one_graph(tmp_path)).run("decoder", torch.zeros(3), torch.zeros(3))
    assert len(str(raised.value).splitlines()) == 1
    with pytest.raises(ModelError):
        Sessions(one_graph(tmp_path, "NoSuchOperator"))


def test_running_out_of_memory_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sessions = Sessions(one_graph(tmp_path))
    from onnxruntime.capi.onnxruntime_pybind11_state import RuntimeException

    def full(*_: object) -> None:
        raise RuntimeException("[ONNXRuntimeError] : 6 : Failed to allocate memory for requested buffer of size 9")

    full_device = SimpleNamespace(run=full, get_inputs=lambda: ())
    monkeypatch.setattr(sessions._sessions["decoder"], "session", full_device)
    with pytest.raises(DeviceMemoryError):
        sessions.run("decoder")


def test_an_absent_provider_is_refused_the_cpu_comes_last_and_tensorrt_keeps_what_it_built(tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        Sessions(one_graph(tmp_path), [(TENSORRT_PROVIDER, {})])
    cache = tmp_path / "cache"
    chosen = provider_options("cuda:1", (TENSORRT_PROVIDER, CPU_PROVIDER), cache, half=True)
    assert [name for name, _ in chosen] == [TENSORRT_PROVIDER, CPU_PROVIDER]
    assert chosen[0][1] == {
        "device_id": "1",
        "trt_fp16_enable": "True",
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": str(cache),
    }
    with pytest.raises(OptionError):
        provider_options("cpu:1", (), cache, half=False)


def manifest(*, height: int = TINY.height, **files: str) -> Manifest:
    card = Card(name="tiny", config=structs.replace(TINY, height=height), family=FAMILIES["kubric90"], move_time=2)
    return Manifest(
        format=FORMAT,
        card=card.to_metadata(),
        source="0123456789ab",
        precision="float32",
        opset=20,
        exporter="a test",
        graphs={"decoder": files},
    )


def an_export(folder: Path, name: str = "decoder.onnx") -> Path:
    """A folder with one file that is a graph by name."""
    (folder / name).write_bytes(b"a graph")
    stated = manifest(**{name: digest((folder / name,))})
    (folder / MANIFEST).write_bytes(msgspec.json.encode(stated))
    return folder


def test_the_digest_names_weights_precision_and_size_and_nothing_else() -> None:
    stated = manifest()
    assert stated.sha256_12 == structs.replace(stated, exporter="another", opset=21).sha256_12
    others = (
        structs.replace(stated, source="ba9876543210"),
        structs.replace(stated, precision="float16"),
        manifest(height=64),
    )
    assert len({stated.sha256_12, *(other.sha256_12 for other in others)}) == 4


@pytest.mark.parametrize(
    "text",
    [
        b"{",
        b"{}",
        msgspec.json.encode(manifest()).replace(FORMAT.encode(), b"gcd-onnx-9"),
        msgspec.json.encode(manifest()).replace(b'"opset"', b'"opzet"'),
        msgspec.json.encode(manifest()),  # its graph has no file
    ],
)
def test_a_manifest_that_cannot_be_used_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / MANIFEST).write_bytes(text)
    with pytest.raises(CheckpointError):
        read_manifest(tmp_path)


@pytest.mark.parametrize("content", [b"A graph", b"a gra", None])
def test_whole_folders_are_read_and_damaged_ones_or_others_files_are_not(tmp_path: Path, content: bytes | None) -> None:
    folder = an_export(tmp_path)
    assert is_export(folder)
    assert list(read_manifest(folder).graphs["decoder"]) == ["decoder.onnx"]
    with pytest.raises(CheckpointError):
        load_export(folder)  # it lacks the other graphs of its model
    (folder / "decoder.onnx").unlink()
    if content is not None:
        (folder / "decoder.onnx").write_bytes(content)
    (tmp_path / "inner").mkdir()
    for wrong in (folder, an_export(tmp_path / "inner", "../secret")):
        with pytest.raises(CheckpointError):
            read_manifest(wrong)


@pytest.mark.parametrize(
    "options", [{"family": "driving"}, {"dtype": "float16"}, {"frames": 14}, {"engine": "torch"}, {"engine": "cuda"}]
)
def test_an_export_says_all_of_itself_and_torch_does_not_run_it(tmp_path: Path, options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        load_synthesizer(an_export(tmp_path), **options)


@pytest.mark.parametrize("options", [{"engine": "onnxruntime"}, {"providers": ("CPUExecutionProvider",)}])
def test_onnxruntime_runs_nothing_but_exports(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        load_synthesizer("random:kubric90", **options)


@pytest.mark.parametrize(
    ("out", "options"),
    [("mine", {}), ("mine", {"overwrite": True}), ("no/where", {}), ("export", {"height": 36})],
    ids=["there", "no export", "no folder", "no size of the network"],
)
def test_nothing_is_written_over_what_is_no_export_into_nowhere_or_of_another_size(
    tmp_path: Path, out: str, options: dict[str, Any]
) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(OptionError):
        export_onnx(as_loaded(tiny_synthesizer()), tmp_path / out, **options)
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


def test_an_export_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gcd_model.engines.onnx_export.write_graph", full)
    with pytest.raises(CheckpointError):
        export_onnx(as_loaded(tiny_synthesizer()), tmp_path / "export")
    assert list(tmp_path.iterdir()) == []


# Whole exports, run by onnxruntime, against torch.


def whole_export(test: Callable[..., None]) -> Callable[..., None]:
    """Minutes, as exporting is slow."""
    pytest.importorskip("onnxscript", reason="needs the extra `onnx`")
    return pytest.mark.slow(pytest.mark.timeout(3600)(test))


def view(synthesizer: Synthesizer) -> View:
    """Two guided steps and two samples of a random clip."""
    config, steered = synthesizer.traits.config, synthesizer.traits.config.camera != "none"
    path = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=10.0) if steered else None)
    options = RenderOptions(seed=1, steps=2, guidance=(1.0, 2.0), samples=2)
    return synthesizer.render(synthesizer.encode(random_clip(config)), [path], options)[0]


@whole_export
@pytest.mark.parametrize("made", [tiny_synthesizer, tiny_driving], ids=["published", "ours"])
def test_an_export_gives_what_torch_gives(
    made: Callable[[], Synthesizer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_export, "APART_ABOVE", 1 << 16)
    torched = made()
    stated = export_onnx(as_loaded(torched), tmp_path / "export")
    assert any(len(files) == 2 for files in stated.graphs.values()), "no weights lie apart: nothing was tried"
    onnxed = load_synthesizer(tmp_path / "export", engine="onnxruntime")
    expected, found = view(torched), view(onnxed)
    assert expected.video.std() > 0.01, "a constant picture would show nothing"
    assert relative_error(found.latents, expected.latents) < 1e-4
    assert relative_error(found.video, expected.video) < 1e-4
    assert onnxed.traits.sha256_12 == stated.sha256_12
    assert onnxed.traits.family == torched.traits.family
    assert "/work" not in "".join(path.read_bytes().decode("latin1") for path in (tmp_path / "export").glob("*.onnx"))


@whole_export
def test_half_precision_misses_by_little_and_takes_less_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No graph becomes a single message on the way: one of over 2 GiB cannot."""
    import onnx.shape_inference

    monkeypatch.setattr(onnx.shape_inference, "infer_shapes", None)
    torched = tiny_driving()
    for precision in ("float32", "float16"):
        export_onnx(as_loaded(torched), tmp_path / precision, precision=precision)  # type: ignore[arg-type]
    sizes = {
        name: [(tmp_path / each / f"{name}.onnx").stat().st_size for each in ("float32", "float16")]
        for name in ("step", "decoder")
    }
    assert sizes["step"][1] < 0.75 * sizes["step"][0]
    assert sizes["decoder"][0] == sizes["decoder"][1], "what is looked at stays as it is"
    found, expected = view(load_synthesizer(tmp_path / "float16")), view(torched)
    assert 0 < relative_error(found.video, expected.video) < 0.02


@whole_export
def test_another_size_is_another_export(tmp_path: Path) -> None:
    torched = tiny_driving()
    config = structs.replace(torched.traits.config, height=64)
    export_onnx(as_loaded(torched), tmp_path / "export", height=64)
    larger = load_synthesizer(tmp_path / "export")
    assert larger.traits.config == config
    assert larger.encode(random_clip(config)).latents.shape[-2:] == (16, 12)
    with pytest.raises(OptionError):
        larger.encode(random_clip(TINY_DRIVING))
