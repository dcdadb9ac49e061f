"""How near views are to what the camera would have seen, as numbers.

Pictures are float [T, 3, H, W] in [0, 1]; masks are bool [T, H, W]; class maps are uint8 [..., H, W], each value a
class's id.
"""

from gcd_train.metrics.classes import (
    NO_CLASS,
    class_iou,
    commonest_classes,
    confusion_matrix,
    frame_confusions,
    majority_classes,
    mean_iou,
    named_confusion,
    pixel_accuracy,
    void_ids,
    without_classes,
)
from gcd_train.metrics.lpips import Lpips
from gcd_train.metrics.pictures import (
    diversity,
    frame_change,
    gradient_magnitude,
    gradient_map,
    masked_mean,
    masked_psnr,
    psnr,
)
from gcd_train.metrics.structure import masked_ssim, ssim, ssim_map, window_mask

__all__ = [
    "NO_CLASS",
    "Lpips",
    "class_iou",
    "commonest_classes",
    "confusion_matrix",
    "diversity",
    "frame_change",
    "frame_confusions",
    "gradient_magnitude",
    "gradient_map",
    "majority_classes",
    "masked_mean",
    "masked_psnr",
    "masked_ssim",
    "mean_iou",
    "named_confusion",
    "pixel_accuracy",
    "psnr",
    "ssim",
    "ssim_map",
    "void_ids",
    "window_mask",
    "without_classes",
]
