"""Bars with figures made up by hand."""

import math

import pytest

from gcd_train.evaluation import Bar, Evaluation, Figures, bars

CLASSES = ("road", "car", "person")


def figures_of(
    *,
    psnr_db: float = math.nan,
    gradient: float = math.nan,
    flicker: float = math.nan,
    miou: float = math.nan,
    classes: tuple[float, ...] = (),
) -> Figures:
    return Figures(
        psnr_db=psnr_db,
        last_psnr_db=psnr_db,
        ssim=math.nan,
        gradient_energy=gradient,
        flicker=flicker,
        miou=miou,
        miou_full=miou,
        accuracy=math.nan,
        class_iou=classes,
        class_iou_full=classes,
    )


def row(total: Figures, name: str = "model") -> Evaluation:
    """Two scenes that are alike, so that no difference has an error."""
    return Evaluation(
        name=name,
        privileged=False,
        clips=(total, total),
        total=total,
        error=figures_of(gradient=0.01, flicker=0.02, miou=0.03, classes=(0.1, 0.2, 0.3)),
        without=(total, total),
        seconds_per_clip=0.0,
    )


DRIVING_RIVALS = (
    row(figures_of(psnr_db=17.5, miou=0.38), "depth_reprojection"),
    row(figures_of(psnr_db=18.0, miou=0.55), "depth_reprojection_on_mean"),
)
ORBIT_RIVALS = (row(figures_of(psnr_db=15.0), "copy_source"), row(figures_of(psnr_db=18.25), "ground_homography"))


def outcome(found: tuple[Bar, ...]) -> dict[str, tuple[bool, float]]:
    return {bar.name: (bar.reached, round(bar.margin, 6)) for bar in found}


def test_a_driving_model_is_held_against_the_exact_depth_with_mean_colour_and_majority_fill() -> None:
    total = figures_of(psnr_db=20.75, gradient=0.55, flicker=1.0, miou=0.5625, classes=(0.8, 0.5, 0.125))
    found = bars(row(total), DRIVING_RIVALS, classes=CLASSES, camera="none")
    assert outcome(found) == {
        "PSNR over depth_reprojection, dB": (True, 0.25),
        "gradient energy": (False, -0.05),
        "flicker": (True, 0.0),
        "mIoU": (False, -0.0175),
        "mIoU over depth_reprojection_on_mean": (True, 0.0125),
        "IoU of car": (True, 0.0),
        "IoU of person": (False, -0.025),
    }


def test_a_model_that_paints_classes_is_held_to_the_bars_of_the_class_map_alone() -> None:
    total = figures_of(miou=0.6, classes=(0.8, 0.5, 0.2))
    found = bars(row(total), DRIVING_RIVALS, classes=CLASSES, camera="none")
    assert all(bar.reached for bar in found)
    assert [bar.name for bar in found] == [
        "mIoU",
        "mIoU over depth_reprojection_on_mean",
        "IoU of car",
        "IoU of person",
    ]


def test_a_model_of_objects_is_held_against_copy_and_homography() -> None:
    found = bars(row(figures_of(psnr_db=18.5, gradient=1.5)), ORBIT_RIVALS, classes=(), camera="spherical")
    assert outcome(found) == {
        "PSNR over copy_source, dB": (True, 1.5),
        "PSNR over ground_homography, dB": (False, -0.25),
        "gradient energy": (False, -0.1),
    }


def test_without_baselines_the_bars_that_need_none_are_told() -> None:
    total = figures_of(psnr_db=20.0, gradient=0.7, flicker=0.5, miou=0.6, classes=(0.8, 0.5, 0.2))
    names = [bar.name for bar in bars(row(total), (), classes=CLASSES, camera="none")]
    assert names == ["gradient energy", "flicker", "mIoU", "IoU of car", "IoU of person"]


def test_as_good_as_the_rival_is_not_above_it() -> None:
    total = figures_of(miou=0.55, classes=(0.8, 0.5, 0.2))
    found = {bar.name: bar for bar in bars(row(total), DRIVING_RIVALS, classes=CLASSES, camera="none")}
    level = found["mIoU over depth_reprojection_on_mean"]
    assert level.margin == 0.0
    assert not level.reached


def test_a_class_that_nobody_saw_is_missed_and_not_passed_over() -> None:
    total = figures_of(miou=0.6, classes=(0.8, 0.5, math.nan))
    person = bars(row(total), (), classes=CLASSES, camera="none")[-1]
    assert not person.reached
    assert str(person) == "IoU of person: nothing to measure, wanted 0.15 or more: **missed**"


@pytest.mark.parametrize(
    ("bar", "text"),
    [
        (
            Bar(name="mIoU", value=0.6, error=0.012, least=0.58),
            "mIoU: 0.6 ± 0.012, wanted 0.58 or more: reached by 0.02",
        ),
        (
            Bar(name="lead", value=-0.5, error=0.1, least=0.0, strict=True),
            "lead: -0.5 ± 0.1, wanted more than 0: **missed** by 0.5",
        ),
        (
            Bar(name="energy", value=1.5, error=math.nan, least=0.6, most=1.4),
            "energy: 1.5, wanted 0.6 or more, 1.4 or less: **missed** by 0.1",
        ),
    ],
)
def test_a_bar_says_by_how_much_it_is_reached_or_missed(bar: Bar, text: str) -> None:
    assert str(bar) == text
