"""Figures from records: what is summed, over which frames and pixels, and how sure it is."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from made_records import record, region

from gcd_train.evaluation.statistics import ClipTable, FigureName, Span, Sums
from gcd_train.evaluation.store import ClipRecord, Region


def scenes(method: str = "model", shift: float = 0.0) -> list[ClipRecord]:
    """Two clips of each of four scenes, all of other PSNR."""
    values = (18.0, 19.0, 21.0, 20.5, 17.0, 16.0, 25.0, 24.0)
    return [
        record(method, f"scn{number // 2:05d}.sample_{number % 2:02d}", psnr_db=value + shift)
        for number, value in enumerate(values)
    ]


def summed(records: Sequence[ClipRecord], *, classes: int = 0) -> Sums:
    """Frames 2 to the last, all pixels."""
    return ClipTable.of(records, classes).scene_sums()


def figure(record: ClipRecord, name: FigureName, frames: Span = "2-last", region: Region = "all") -> float:
    return ClipTable.of([record]).scene_sums(frames, region).value(name)


# --- how sure -----------------------------------------------------------------------------------------------------


def test_the_interval_of_a_mean_is_that_of_a_plain_bootstrap_over_scenes() -> None:
    found = summed(scenes())
    of_scenes = np.array([18.5, 20.75, 16.5, 24.5])
    drawn = of_scenes[np.random.default_rng(0).integers(0, 4, size=(20_000, 4))].mean(axis=1)
    interval = found.interval("psnr_db")
    assert interval.value == pytest.approx(of_scenes.mean())
    assert (interval.low, interval.high) == pytest.approx(tuple(np.quantile(drawn, [0.025, 0.975])), abs=0.15)


def test_a_difference_is_paired_so_a_constant_lead_has_no_error() -> None:
    first, other = (summed(scenes(name, shift)) for name, shift in (("a", 1.5), ("b", 0.0)))
    apart = first.interval("psnr_db", other)
    assert (apart.value, apart.low, apart.high) == pytest.approx((1.5,) * 3)
    assert apart.off_zero
    back = other.interval("psnr_db", first)
    assert (back.low, back.high) == pytest.approx((-apart.high, -apart.low))


def test_a_single_scene_has_no_bounds_and_no_claim() -> None:
    found = summed(scenes()[:2])
    assert math.isnan(found.interval("psnr_db").low)
    assert not found.interval("psnr_db").off_zero


def test_intervals_of_pooled_classes_lie_around_the_figure_of_all() -> None:
    clips = [
        record("a", f"s{scene}", regions={"all": region(counts=[(0, 0, 50), (1, 1, 10 + scene), (1, 0, 9)])})
        for scene in range(5)
    ]
    found = summed(clips).interval("miou_common")
    assert found.low < found.value < found.high
    assert found.value == pytest.approx((250 / 295 + 60 / 105) / 2)


# --- frames and pixels --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "pixels", "expected"),
    [
        ("2-last", "all", 20.0),
        ("all", "all", 40.0),
        ("last", "all", 30.0),
        ("2-last", "occluded", 12.0),  # of frames 3 and 4, frame 2 has no such pixel
        ("2-last", "visible", math.nan),
    ],
)
def test_figures_are_of_the_frames_and_pixels_asked_for(frames: Span, pixels: Region, expected: float) -> None:
    regions = {"all": region((100.0, 10.0, 20.0, 30.0)), "occluded": region((None, None, 11.0, 13.0))}
    assert figure(record(regions=regions), "psnr_db", frames, pixels) == pytest.approx(expected, nan_ok=True)


def test_sharpness_and_flicker_are_ratios_of_sums_without_the_first_frame() -> None:
    clip = record(gradient=(9.0, 1.0, 2.0, 3.0), step=(9.0, 1.0, 3.0))
    expected: dict[Span, tuple[float, float]] = {
        "2-last": (1.0, 1.0),
        "last": (1.5, 1.5),
        "all": (15 / 8, 13 / 6),
    }
    found = {frames: (figure(clip, "gradient_energy", frames), figure(clip, "flicker", frames)) for frames in expected}
    assert found == {frames: pytest.approx(each) for frames, each in expected.items()}


# --- classes ------------------------------------------------------------------------------------------------------


def test_iou_is_pooled_over_clips_not_averaged() -> None:
    one = record(key="a", regions={"all": region(counts=[(0, 0, 90), (1, 0, 10)])}, gradient=None, step=None)
    two = record(key="b", regions={"all": region(counts=[(0, 1, 10), (1, 1, 10)])}, gradient=None, step=None)
    found = summed([one, two])
    assert (found.value(0), found.value(1)) == pytest.approx((90 / 110, 10 / 30))
    assert found.value("miou_full") == pytest.approx((90 / 110 + 10 / 30) / 2)
    assert math.isnan(found.value("psnr_db"))


def test_what_is_said_to_be_of_no_class_is_wrong_and_makes_no_class() -> None:
    found = summed([record(regions={"all": region(counts=[(0, 0, 6), (0, 255, 2), (1, 1, 4)])})], classes=3)
    assert [found.value(label) for label in range(3)] == pytest.approx([6 / 8, 1.0, math.nan], nan_ok=True)
    assert found.common == (0, 1)


def test_the_ten_commonest_classes_are_those_of_all_targets_in_every_region() -> None:
    counts = [(label, label, 100 - label) for label in range(12)]
    clip = record(regions={"all": region(counts=counts), "occluded": region(counts=[(11, 0, 50)])})
    assert summed([clip]).common == tuple(range(10))
    assert figure(clip, "miou_common") == pytest.approx(1.0)
    assert figure(clip, "miou_common", region="occluded") == pytest.approx(0.0)  # class 0, said where 11 is
