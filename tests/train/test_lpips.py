"""LPIPS on random weights, in files as they are published, against a straight-line calculation."""

import hashlib
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from gcd_train.errors import DataError
from gcd_train.evaluation import metrics
from gcd_train.evaluation.metrics import Lpips

VGG_PLAN = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)
VGG_COMPARED, ALEX_COMPARED = (3, 8, 15, 22, 29), (1, 4, 7, 9, 11)
CHANNELS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}


@pytest.fixture(autouse=True, scope="module")
def published() -> Iterator[None]:
    """What these tests write last counts as published."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "PUBLISHED", dict(metrics.PUBLISHED))
        yield


def vgg_features() -> nn.Sequential:
    layers: list[nn.Module] = []
    inputs = 3
    for outputs in VGG_PLAN:
        if outputs:
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
        else:
            layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


def alex_features() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


def write(folder: Path, name: str, features: nn.Sequential, heads: dict[str, Tensor]) -> Path:
    """Both files, in the older of torch's two formats, as the published ones are."""
    folder.mkdir(exist_ok=True)
    body = {f"features.{key}": value for key, value in features.state_dict().items()}
    body["classifier.0.weight"] = torch.zeros(2, 2)
    file = "vgg16-397923af.pth" if name == "vgg" else "alexnet-owt-7be5be79.pth"
    for path, content in ((folder / file, body), (folder / f"{name}.pth", heads)):
        torch.save(content, path, _use_new_zipfile_serialization=False)
        metrics.PUBLISHED[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return folder


def random_heads(name: str) -> dict[str, Tensor]:
    return {f"lin{i}.model.1.weight": torch.rand(1, channels, 1, 1) for i, channels in enumerate(CHANNELS[name])}


class Made:
    """A network of random weights, and the folder that holds them."""

    def __init__(self, folder: Path, name: str) -> None:
        torch.manual_seed(0)
        self.name, self.features = name, vgg_features() if name == "vgg" else alex_features()
        self.heads = random_heads(name)
        self.folder = write(folder, name, self.features, self.heads)
        self.lpips = Lpips.open(self.folder)

    @torch.no_grad()
    def by_hand(self, view: Tensor, target: Tensor) -> float:
        """One frame, [3, H, W] each, from brightness -1 to 1 with the shift and scale of the paper's authors."""
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x, y = ((2 * each - 1 - shift[:, None, None]) / scale[:, None, None] for each in (view, target))
        total, stage = 0.0, 0
        for place, layer in enumerate(self.features):
            x, y = layer(x), layer(y)
            if place in (VGG_COMPARED if self.name == "vgg" else ALEX_COMPARED):
                apart = (x / (x.norm(dim=0) + 1e-10) - y / (y.norm(dim=0) + 1e-10)) ** 2
                weight = self.heads[f"lin{stage}.model.1.weight"].view(-1, 1, 1)
                total, stage = total + float((apart * weight).sum(dim=0).mean()), stage + 1
        assert stage == 5
        return total


@pytest.fixture(scope="module")
def alex(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("alex") / "weights", "alex")


def pictures(count: int, size: int = 40) -> Tensor:
    return torch.rand(count, 3, size, size + 3, generator=torch.Generator().manual_seed(count))


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_distances_are_those_calculated_by_hand(name: str, tmp_path: Path) -> None:
    made = Made(tmp_path / name, name)
    lpips = made.lpips
    view, target = pictures(2), 1 - pictures(2)
    by_hand = [made.by_hand(a, b) for a, b in zip(view, target, strict=True)]
    assert min(by_hand) > 0.01
    assert lpips(torch.stack([target, view]), target).tolist() == [[0.0, 0.0], pytest.approx(by_hand, rel=1e-4)]
    assert lpips.network == made.name


def test_weights_are_told_apart_by_their_identity(alex: Made, tmp_path: Path) -> None:
    found = Lpips.open(write(alex.folder, "alex", alex.features, alex.heads)).identity
    assert found == alex.lpips.identity
    assert found.startswith("alex-")
    assert Lpips.open(write(tmp_path / "other", "alex", alex.features, random_heads("alex"))).identity != found


def test_a_folder_without_both_files_is_refused_and_what_it_holds_is_said(tmp_path: Path) -> None:
    for folder in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(DataError):
            Lpips.open(folder)
    torch.save({}, tmp_path / "vgg16-397923af.pth")
    with pytest.raises(DataError, match=r"got vgg16-397923af\.pth"):
        Lpips.open(tmp_path)


@pytest.mark.parametrize("name", ["alex.pth", "alexnet-owt-7be5be79.pth"])
def test_other_files_than_the_published_ones_are_refused_unread(alex: Made, tmp_path: Path, name: str) -> None:
    folder = write(tmp_path / "bad", "alex", alex.features, alex.heads)
    whole = (folder / name).read_bytes()
    for content in (b"", whole[:-1], whole[:400] + b"\0" + whole[401:], pickle.dumps(Opened(tmp_path / "run"))):
        (folder / name).write_bytes(content)
        with pytest.raises(DataError, match="is not the published file") as caught:
            Lpips.open(folder)
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


class Opened:
    """Makes a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return open, (str(self.path), "w")
