"""What a user asks of an evaluation, as it was asked."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gcd_model import RenderOptions
from gcd_model.geometry import CameraMount
from gcd_train.evaluation.choosing import Choice
from gcd_train.evaluation.protocols import AS_PLANNED, FrameBounds, ProtocolName
from gcd_train.hexplane import HexPlaneSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class Looks:
    """What clips of scenes look like; None for what suits the weights.

    angles: how far goals are drawn. path: of the target camera. modality: colours, or class maps.
    """

    angles: Literal["max90", "max180"] | None = None
    path: Literal["gradual", "direct"] | None = None
    modality: Literal["rgb", "semantic"] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneWishes:
    """What only whole scenes can be asked for; see `SceneCuts`."""

    looks: Looks = Looks()
    bounds: FrameBounds = AS_PLANNED
    controls: Path | None = None
    clips: int | None = None
    exact: bool = False
    cameras: Sequence[str] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Rivals:
    """What the weights are measured against.

    usual: baselines too. names: these, each name or several with commas between; None for the usual ones. train: pairs
    for means, at most `train_limit`. svd: weights for vanilla SVD. predictions: NAME=FOLDER of others' frames.
    privileged: names of those of them that were given more than the source video. hexplane: what it learns of a clip.
    """

    usual: bool = True
    names: Sequence[str] | None = None
    train: Sequence[Path] | None = None
    train_limit: int = 1000
    svd: str | None = None
    predictions: Sequence[str] | None = None
    privileged: Sequence[str] | None = None
    hexplane: HexPlaneSettings = HexPlaneSettings()  # noqa: RUF009  it is frozen


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidate:
    """What is put to the test. weights: by name or path, None for rivals alone.

    They are measured with the shipped steps and with each of `steps`. sampling: all the rest. device,
    dtype: see `load_synthesizer`.
    """

    weights: str | None = None
    device: str = "auto"
    dtype: str | None = None
    steps: Sequence[int] | None = None
    sampling: RenderOptions = RenderOptions()  # noqa: RUF009  it is frozen


@dataclass(frozen=True, kw_only=True, slots=True)
class Asked:
    """All that is asked of an evaluation.

    cut: how clips are cut from whole scenes. mount: declared for the source camera of driving pairs. lpips: folder of
    the weights for it.
    """

    data: Sequence[Path]
    protocol: ProtocolName = "paper"
    choice: Choice = Choice()  # noqa: RUF009  it is frozen
    cut: SceneWishes = SceneWishes()
    mount: CameraMount | None = None
    tested: Candidate = Candidate()
    rivals: Rivals = Rivals()
    lpips: Path | None = None


def declared_mount(height_m: float | None, tilt_deg: float | None) -> CameraMount | None:
    """The mount that is declared; None where nobody says any. Raises OptionError for one that no camera has."""
    if height_m is None and tilt_deg is None:
        return None
    usual = CameraMount()
    return CameraMount(
        height_m=usual.height_m if height_m is None else height_m,
        tilt_deg=usual.tilt_deg if tilt_deg is None else tilt_deg,
    )
