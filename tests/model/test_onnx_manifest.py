"""What an export says about itself, what is refused of one, and the arithmetic of narrower weights."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from msgspec import structs
from small_models import TINY, tiny_synthesizer

from gcd_model.checkpoints import LoadedWeights, digest
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.families import KUBRIC90
from gcd_model.loading import load_synthesizer
from gcd_model.onnx_export import export_onnx, is_export, read_manifest
from gcd_model.onnx_manifest import FORMAT, MANIFEST, FileRecord, GraphRecord, Manifest, from_bytes, to_bytes
from gcd_model.onnx_precision import eight_bit_weights
from gcd_model.own_format import Card


def card(height: int = TINY.height) -> dict[str, str]:
    config = structs.replace(TINY, height=height)
    return Card(name="tiny", config=config, family="kubric90", move_time=2).to_metadata()


def manifest(*files: FileRecord, height: int = TINY.height) -> Manifest:
    record = GraphRecord(files=files, precision="float32", inputs=(), outputs=())
    return Manifest(
        format=FORMAT,
        card=card(height),
        source="0123456789ab",
        precision="float32",
        opset=20,
        exporter="a test",
        graphs={"decoder": record},
    )


def an_export(tmp_path: Path, content: bytes = b"a graph") -> Path:
    """A folder with one file that is a graph by name."""
    (tmp_path / "decoder.onnx").write_bytes(content)
    told = FileRecord(name="decoder.onnx", size=len(content), sha256=digest((tmp_path / "decoder.onnx",)))
    (tmp_path / MANIFEST).write_bytes(to_bytes(manifest(told)))
    return tmp_path


def test_a_manifest_survives_the_round_trip() -> None:
    stated = manifest(FileRecord(name="decoder.onnx", size=3, sha256="0" * 64))
    assert from_bytes(to_bytes(stated)) == stated


def test_the_digest_names_weights_precision_and_size_and_nothing_else() -> None:
    stated = manifest()
    assert stated.sha256_12 == structs.replace(stated, exporter="another", opset=21).sha256_12
    others = (
        structs.replace(stated, source="ba9876543210"),
        structs.replace(stated, precision="int8"),
        manifest(height=64),
    )
    assert len({stated.sha256_12, *(other.sha256_12 for other in others)}) == 4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"{", "cannot be used"),
        (b"[]", "cannot be used"),
        (b"{}", "has format None, this version reads 'gcd-onnx-1'; export it again"),
        (b'{"format": "gcd-onnx-9"}', "has format 'gcd-onnx-9'"),
        (b'{"format": "gcd-onnx-1"}', "cannot be used"),
        (to_bytes(manifest()).replace(b'"opset"', b'"opzet"'), "opzet"),
    ],
)
def test_a_manifest_that_cannot_be_used_says_why(text: bytes, said: str) -> None:
    with pytest.raises(CheckpointError, match=said):
        from_bytes(text)


def test_whole_folders_are_read_and_damaged_ones_are_not(tmp_path: Path) -> None:
    folder = an_export(tmp_path)
    assert is_export(folder)
    assert read_manifest(folder).graphs["decoder"].files[0].size == 7
    (folder / "decoder.onnx").write_bytes(b"A graph")
    with pytest.raises(CheckpointError, match=r"decoder.onnx is not the one that was written; copy or export it again"):
        read_manifest(folder)
    (folder / "decoder.onnx").write_bytes(b"a gra")
    with pytest.raises(CheckpointError, match=r"decoder.onnx has 5 bytes, wanted are 7"):
        read_manifest(folder)
    (folder / "decoder.onnx").unlink()
    with pytest.raises(CheckpointError, match=r"lacks its file decoder.onnx"):
        read_manifest(folder)


def test_a_manifest_names_no_file_outside_its_folder(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"x")
    folder = tmp_path / "export"
    folder.mkdir()
    told = FileRecord(name="../secret", size=1, sha256=digest((tmp_path / "secret",)))
    (folder / MANIFEST).write_bytes(to_bytes(manifest(told)))
    with pytest.raises(CheckpointError, match="lacks its file"):
        read_manifest(folder)


# --- loading, exporting --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"family": "driving"}, {"dtype": "float16"}, {"frames": 14}])
def test_an_export_says_all_of_itself(tmp_path: Path, options: dict[str, str]) -> None:
    with pytest.raises(OptionError, match="is an export and says all of itself"):
        load_synthesizer(an_export(tmp_path), **options)


@pytest.mark.parametrize("engine", ["torch", "cuda"])
def test_torch_does_not_run_an_export(tmp_path: Path, engine: str) -> None:
    with pytest.raises(OptionError, match=f"which the engine onnxruntime runs; for {engine} give the weights"):
        load_synthesizer(an_export(tmp_path), engine=engine)


@pytest.mark.parametrize("options", [{"engine": "onnxruntime"}, {"providers": ("CPUExecutionProvider",)}])
def test_onnxruntime_runs_nothing_but_exports(options: dict[str, object]) -> None:
    with pytest.raises(OptionError, match="make one: gcd-node export --weights random:kubric90 --onnx FOLDER"):
        load_synthesizer("random:kubric90", **options)


def tiny_weights() -> LoadedWeights:
    return LoadedWeights(
        name="tiny",
        networks=tiny_synthesizer().networks,
        family=KUBRIC90,
        move_time=2,
        trained=False,
        sha256_12="0" * 12,
    )


def test_nothing_is_written_over_that_is_no_export(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for overwrite in (False, True):
        with pytest.raises(OptionError, match="exists; give another name, or allow an export to be overwritten"):
            export_onnx(tiny_weights(), tmp_path / "mine", overwrite=overwrite)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_an_export_into_nowhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="there is no folder"):
        export_onnx(tiny_weights(), tmp_path / "absent" / "export")


def test_a_size_the_network_cannot_take_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="must be multiples of 8 for tiny, got 36x64"):
        export_onnx(tiny_weights(), tmp_path / "export", height=36)


def test_an_export_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gcd_model.onnx_export.write_graph", full)
    with pytest.raises(CheckpointError, match="cannot be written: No space left on device"):
        export_onnx(tiny_weights(), tmp_path / "export")
    assert list(tmp_path.iterdir()) == []


# --- eight bits ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "axis"), [((8, 4, 3, 3), 0), ((6, 10), 1), ((6, 10), 0)])
def test_eight_bits_miss_a_weight_by_half_a_step_at_most(shape: tuple[int, ...], axis: int) -> None:
    weights = torch.randn(shape, generator=torch.Generator().manual_seed(0)).numpy()
    whole, scale = eight_bit_weights(weights, axis)
    assert whole.dtype == np.int8
    assert scale.shape == (shape[axis],)
    steps = scale.reshape([-1 if i == axis else 1 for i in range(len(shape))])
    assert np.all(np.abs(whole * steps - weights) <= steps * 0.501)
    assert np.abs(whole).max() == 127


def test_a_channel_of_zeros_stays_zero() -> None:
    whole, scale = eight_bit_weights(np.zeros((2, 3), np.float32), 0)
    assert not whole.any()
    assert np.all(scale > 0)


def test_a_manifest_is_readable_json() -> None:
    text = to_bytes(manifest())
    assert msgspec.json.decode(text)["precision"] == "float32"
    assert text.count(b"\n") > 10
