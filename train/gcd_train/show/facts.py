"""A clip in numbers."""

import numpy as np

from gcd_train.show.footage import Footage


def facts_of(footage: Footage) -> list[tuple[str, str]]:
    """Name and value with its unit, for the sheet and the terminal."""
    near, far = footage.depth_range_m
    first, last = footage.frame_numbers[0], footage.frame_numbers[-1]
    way = np.linalg.norm(np.diff(footage.world_from_target[:, :3, 3], axis=0), axis=1).sum()
    height, width = footage.source.shape[1:3]
    seen = footage.seen_shares
    rows = [
        ("scene", f"{footage.scene_frames} frames at {footage.scene_fps:g} fps, {len(footage.cameras)} cameras"),
        ("clip", f"{footage.frames} frames at {footage.fps:g} fps, {first} to {last}"),
        ("pictures", f"{width} x {height} px, hfov {footage.hfov_deg:.1f}°"),
        ("path", footage.path),
        ("path length", f"{way:.1f} m in {footage.seconds[-1]:.2f} s"),
        ("depth", f"{near:.1f} to {far:.1f} m (1st to 99th percentile)"),
        (
            "seen",
            f"{100 * seen.mean():.0f} % of all surfaces, {100 * seen[-1]:.0f} % at the end\n({footage.visible_is})",
        ),
    ]
    if footage.bytes_read:
        rows.append(("read", f"{footage.bytes_read / 1e6:.1f} MB"))
    return rows
