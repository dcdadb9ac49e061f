"""Figures from records: what is summed, over which frames and pixels, and how sure it is."""

import math

import numpy as np
import pytest
from made_records import record, region

from gcd_train.errors import DataError
from gcd_train.evaluation import Selection, figures, lead, summed_up, tallies
from gcd_train.evaluation.class_counts import class_counts
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.tallies import FIGURE_NAMES


def four_scenes(method: str = "model", shift: float = 0.0) -> list[ClipRecord]:
    """Two clips of each of four scenes, all of other PSNR."""
    values = (18.0, 19.0, 21.0, 20.5, 17.0, 16.0, 25.0, 24.0)
    return [
        record(method, f"scn{number // 2:05d}.sample_{number % 2:02d}", psnr_db=value + shift)
        for number, value in enumerate(values)
    ]


# --- laws ---------------------------------------------------------------------------------------------------------


def test_sums_of_clips_add_up_to_the_sum_of_all() -> None:
    clips = tallies(four_scenes(), Selection())
    grouped = clips.grouped([each.scene for each in four_scenes()])
    whole = clips.weighted(np.ones(8))
    for name in FIGURE_NAMES:
        np.testing.assert_allclose(grouped.weighted(np.ones(4)).figure(name), whole.figure(name))


def test_the_order_of_clips_changes_no_total() -> None:
    some = four_scenes()
    assert figures(some).psnr_db == pytest.approx(figures(some[::-1]).psnr_db)


def test_a_row_leads_itself_by_nothing() -> None:
    found = summed_up(four_scenes())
    assert lead(found, found, lambda of: of.psnr_db) == (0.0, 0.0)


def test_the_error_of_a_mean_over_scenes_is_the_usual_one() -> None:
    found = summed_up(four_scenes())
    scenes = np.array([each.psnr_db for each in found.clips]).reshape(4, 2).mean(axis=1)
    assert len(found.without) == 4
    assert found.error.psnr_db == pytest.approx(scenes.std(ddof=1) / 2)


def test_a_constant_lead_has_no_error() -> None:
    ahead, error = lead(summed_up(four_scenes(shift=1.5)), summed_up(four_scenes("other")), lambda of: of.psnr_db)
    assert ahead == pytest.approx(1.5)
    assert error == pytest.approx(0.0, abs=1e-9)


# --- frames and pixels --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (Selection(), 20.0),
        (Selection(frames="all"), 40.0),
        (Selection(frames="last"), 30.0),
        (Selection(frames=2), 10.0),
        (Selection(region="occluded"), 12.0),  # of frames 3 and 4, frame 2 has no such pixel
        (Selection(frames=2, region="occluded"), math.nan),
        (Selection(region="visible"), math.nan),
    ],
)
def test_figures_are_of_the_frames_and_pixels_asked_for(selection: Selection, expected: float) -> None:
    clip = record(
        regions={"all": region((100.0, 10.0, 20.0, 30.0)), "occluded": region((None, None, 11.0, 13.0))},
    )
    assert figures([clip], selection).psnr_db == pytest.approx(expected, nan_ok=True)


def test_the_last_frame_has_its_own_figure_in_every_selection() -> None:
    clip = record(regions={"all": region((100.0, 10.0, 20.0, 30.0))})
    assert figures([clip]).last_psnr_db == 30.0


def test_a_clip_without_such_pixels_does_not_count_and_every_other_counts_alike() -> None:
    sparse = record(key="a", regions={"all": region((1.0,) * 4), "occluded": region((None, None, None, 10.0))})
    none = record(key="b", regions={"all": region((1.0,) * 4), "occluded": region((None,) * 4)})
    full = record(key="c", regions={"all": region((1.0,) * 4), "occluded": region((20.0,) * 4)})
    assert figures([sparse, none, full], Selection(region="occluded")).psnr_db == pytest.approx(15.0)


def test_sharpness_and_flicker_are_ratios_of_sums_without_the_first_frame() -> None:
    clip = record(gradient=(9.0, 1.0, 2.0, 3.0), step=(9.0, 1.0, 3.0))
    found = figures([clip])
    assert found.gradient_energy == pytest.approx(6.0 / 6.0)
    assert found.flicker == pytest.approx(4.0 / 4.0)
    last = figures([clip], Selection(frames="last"))
    assert (last.gradient_energy, last.flicker) == pytest.approx((1.5, 1.5))
    third = figures([clip], Selection(frames=3))
    assert (third.gradient_energy, third.flicker) == pytest.approx((1.0, 0.5))
    assert math.isnan(figures([clip], Selection(frames=1)).flicker)


def test_what_is_not_measured_apart_is_nan_there() -> None:
    clip = record(lpips=0.3, regions={"all": region((20.0,) * 4), "occluded": region((20.0,) * 4)}, grid=[(0, 0, 5)])
    assert figures([clip]).lpips == pytest.approx(0.3)
    apart = figures([clip], Selection(region="occluded"))
    assert np.isnan([apart.lpips, apart.flicker, apart.miou, apart.accuracy]).all()


def test_sharpness_of_a_region_weighs_frames_by_their_pixels_and_skips_those_without() -> None:
    parts = region((20.0,) * 4, gradient=(9.0, None, 1.0, 4.0), pixels=(0.9, 0.0, 0.1, 0.3))
    clip = record(regions={"all": region((20.0,) * 4), "occluded": parts})
    found = figures([clip], Selection(region="occluded"))
    assert found.gradient_energy == pytest.approx((0.1 * 1.0 + 0.3 * 4.0) / (0.4 * 2.0))
    assert math.isnan(figures([clip], Selection(frames=2, region="occluded")).gradient_energy)


def test_a_method_without_pictures_has_figures_of_classes_alone() -> None:
    clip = record(regions={"all": region(counts=[(0, 0, 3), (1, 0, 1)])}, gradient=None, step=None)
    found = figures([clip])
    pictures = (found.psnr_db, found.ssim, found.lpips, found.gradient_energy, found.flicker, found.diversity)
    assert np.isnan(pictures).all()
    assert found.class_iou_full == pytest.approx((0.75, 0.0))


def test_draws_are_averaged_and_their_spread_is_told() -> None:
    draws = region((20.0,) * 4, draws=2)
    apart = type(draws)(pixels=draws.pixels, psnr_db=((10.0,) * 4, (20.0,) * 4), ssim=draws.ssim, diversity=(0.02,) * 4)
    found = figures([record(regions={"all": apart}, draws=2)])
    assert found.psnr_db == pytest.approx(15.0)
    assert found.diversity == pytest.approx(0.02)


# --- classes ------------------------------------------------------------------------------------------------------


def test_iou_is_pooled_over_clips_not_averaged() -> None:
    one = record(key="a", regions={"all": region(counts=[(0, 0, 90), (1, 0, 10)])})
    two = record(key="b", regions={"all": region(counts=[(0, 1, 10), (1, 1, 10)])})
    found = figures([one, two])
    assert found.class_iou_full == pytest.approx((90 / 110, 10 / 30))
    assert found.miou_full == pytest.approx((90 / 110 + 10 / 30) / 2)


def test_every_class_has_a_place_even_if_nobody_saw_it() -> None:
    clip = record(regions={"all": region(counts=[(0, 0, 90)])}, grid=[(0, 0, 9)])
    found = figures([clip], classes=3)
    assert found.class_iou_full == pytest.approx((1.0, math.nan, math.nan), nan_ok=True)
    assert len(found.class_iou) == 3
    assert found.accuracy == 1.0


def test_what_is_said_to_be_of_no_class_is_wrong_and_makes_no_class() -> None:
    clip = record(regions={"all": region(counts=[(0, 0, 6), (0, 255, 2), (1, 1, 4)])}, grid=[(0, 255, 3), (0, 0, 1)])
    found = figures([clip], classes=2)
    assert found.class_iou_full == pytest.approx((6 / 8, 1.0))
    assert (found.class_iou[0], found.accuracy) == (0.25, 0.25)
    assert class_counts([clip]).common == (0, 1)


def test_the_ten_commonest_classes_are_those_of_all_targets_in_every_region() -> None:
    counts = [(label, label, 100 - label) for label in range(12)]
    rare = [(11, 0, 50)]
    clip = record(regions={"all": region(counts=counts), "occluded": region(counts=rare)})
    assert class_counts([clip]).common == tuple(range(10))
    assert figures([clip]).miou_common == pytest.approx(1.0)
    apart = figures([clip], Selection(region="occluded"))
    assert apart.miou_full == pytest.approx(0.0)
    assert apart.miou_common == pytest.approx(0.0)  # class 0, said where 11 is


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("records", [[], [record("a"), record("b")]])
def test_figures_of_none_or_of_several_methods_are_refused(records: list[ClipRecord]) -> None:
    with pytest.raises(DataError, match="records of one method"):
        summed_up(records)


def test_a_single_scene_tells_nothing_of_the_error() -> None:
    found = summed_up([record(key="a.0"), record(key="a.1")])
    assert math.isnan(found.error.psnr_db)
    assert found.without == ()
    assert math.isnan(lead(found, found, lambda of: of.psnr_db)[1])
