"""Whole exports, run by onnxruntime, against torch: minutes, as exporting is slow. Run with `pytest -m slow`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec import structs
from small_models import TINY_DRIVING, loaded, random_clip, relative_error, tiny_driving, tiny_synthesizer

from gcd_model.clip import View
from gcd_model.diffusion import RenderOptions
from gcd_model.engines.onnx_export import Manifest, export_onnx
from gcd_model.errors import OptionError
from gcd_model.geometry import SphericalDelta
from gcd_model.loading import load_synthesizer
from gcd_model.synthesizer import Synthesizer

pytest.importorskip("onnxruntime", reason="needs the extra `onnx`")
pytest.importorskip("onnxscript", reason="needs the extra `onnx`")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

WORKER = Path(__file__).parent / "full_size_export.py"


def exported(
    synthesizer: Synthesizer, folder: Path, precision: str = "float32", apart_above: int = 1 << 30
) -> Manifest:
    return export_onnx(loaded(synthesizer), folder, precision=precision, apart_above=apart_above)


def view(synthesizer: Synthesizer) -> View:
    """Two guided steps and two samples of a random clip."""
    config, steered = synthesizer.traits.config, synthesizer.traits.config.camera != "none"
    path = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=10.0) if steered else None)
    options = RenderOptions(seed=1, steps=2, guidance=(1.0, 2.0), samples=2)
    return synthesizer.render(synthesizer.encode(random_clip(config)), [path], options)[0]


@pytest.mark.parametrize("made", [tiny_synthesizer, tiny_driving], ids=["published", "ours"])
def test_an_export_gives_what_torch_gives(made: object, tmp_path: Path) -> None:
    torched = made()  # type: ignore[operator]
    manifest = exported(torched, tmp_path / "export", apart_above=1 << 16)
    assert any(len(files) == 2 for files in manifest.graphs.values()), "no weights lie apart: nothing was tried"
    onnxed = load_synthesizer(tmp_path / "export", engine="onnxruntime")
    expected, found = view(torched), view(onnxed)
    assert expected.video.std() > 0.01, "a constant picture would show nothing"
    assert relative_error(found.latents, expected.latents) < 1e-4
    assert relative_error(found.video, expected.video) < 1e-4
    assert onnxed.traits.sha256_12 == manifest.sha256_12
    assert onnxed.traits.family == torched.traits.family
    assert "/work" not in "".join(path.read_bytes().decode("latin1") for path in (tmp_path / "export").glob("*.onnx"))


@pytest.mark.parametrize(("precision", "error"), [("float16", 0.02)])
def test_narrow_numbers_miss_by_little_and_take_less_room(
    precision: str, error: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No graph becomes a single message on the way: one of over 2 GiB cannot."""
    import onnx.shape_inference

    monkeypatch.setattr(onnx.shape_inference, "infer_shapes", None)
    torched = tiny_driving()
    whole, narrow = exported(torched, tmp_path / "whole"), exported(torched, tmp_path / "narrow", precision)
    sizes = [sum(file.size for file in each.graphs["step"]) for each in (whole, narrow)]
    assert sizes[1] < 0.75 * sizes[0]
    found, expected = view(load_synthesizer(tmp_path / "narrow")), view(torched)
    assert 0 < relative_error(found.video, expected.video) < error
    decoders = [each.graphs["decoder"][0].size for each in (whole, narrow)]
    assert decoders[0] == decoders[1], "what is looked at stays as it is"


def test_another_size_is_another_export(tmp_path: Path) -> None:
    torched = tiny_driving()
    config = structs.replace(torched.traits.config, height=64)
    export_onnx(loaded(torched), tmp_path / "export", height=64)
    larger = load_synthesizer(tmp_path / "export")
    assert larger.traits.config == config
    assert larger.encode(random_clip(config)).latents.shape[-2:] == (16, 12)
    with pytest.raises(OptionError):
        larger.encode(random_clip(TINY_DRIVING))


def test_the_full_size_step_is_exported_within_twelve_gigabytes(tmp_path: Path) -> None:
    """Structure and memory alone: nothing is run."""
    done = subprocess.run([sys.executable, WORKER, tmp_path], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    print(found)
    assert found["peak_gb"] <= 12.0
    assert found["inputs"]["latents"] == [14, 4, 32, 48]
    assert found["inputs"]["crosses"][0] == 14
    assert found["files"] == ["step.onnx", "step.onnx.data"]
    assert found["graph_mb"] < 50, "weights stand in the graph"
    assert 4.5 < found["data_gb"] < 6.2, "cross-attention, position and embedding weights are no part of a step"
    assert found["apart"] == found["weights"] > 500
