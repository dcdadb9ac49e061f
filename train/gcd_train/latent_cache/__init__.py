"""The latent cache of a driving set: frozen encoders run once, training reads what they gave.

With the fixed path of ParallelDomain-4D a target depends on the frame t and the path position i alone, a source on t
alone (see `plan`), so a scene of 50 frames is cached as, at 384 x 256 with the published networks (latents
4 x 32 x 48, tokens of 1024, float16; variances one byte each):

    what                         rows    bytes a row                  bytes
    source latents, K = 4          49    K x 12 288               2 408 448
    image tokens                   49    2 048                      100 352
    target means                  517    12 288                   6 352 896
    target log-variances          517    6 144                    3 176 448
    a scene                                                      12.0 MB
    1 533 scenes                                                 18.5 GB    (4.4 TB of point clouds as published)

    gradual path alone            504    targets instead of 517   11.8 MB    18.1 GB
    direct path alone              49    targets                   3.4 MB     5.2 GB
    both, `--moments mean`        517    no variances              8.9 MB    13.6 GB
    both, mean, K = 1                                              7.1 MB    10.8 GB

K copies keep the 0.02 pixel noise of the paper: every frame of every clip draws one of the K on its own, K^14 mixes a
clip. Each scene is one file that appears whole, with its SHA-256 in `index.json`.

What a scene costs, both paths, K = 4: 713 encoder passes of 0.411 TFLOP and 49 of the image tower of 0.324 TFLOP, 309
TFLOP together (counted by torch on one 384 x 256 frame of the published shapes, random weights). The released trainer
spends 16 TFLOP on them in every sample: 13 000 updates of 24 clips are 5.0 EFLOP, the cache of 1 533 scenes 0.47. One
such frame took 6.9 CPU s in the encoder and 6.1 in the tower on the development machine, so a scene is 1.45 CPU hours
there (extrapolated): this is work for a GPU. Its 517 targets are 0.38 CPU s each from the points of 19 cameras, 0.18
drawn exactly (measured on one generated frame of 640 x 480).
"""

from gcd_train.latent_cache.encoders import EncoderChoice, Encoders, load_encoders
from gcd_train.latent_cache.index import CacheIdentity, CacheIndex, Moments, ShardEntry, read_index
from gcd_train.latent_cache.pictures import MomentPictures, PathPictures
from gcd_train.latent_cache.plan import ClipPlace, ClipPlan, PathKind
from gcd_train.latent_cache.reader import CachedClip, CachedLatents
from gcd_train.latent_cache.writer import (
    CacheJob,
    CacheOptions,
    CacheProgress,
    cache_scenes,
    damaged_scenes,
    identity_of,
    only_writer,
)

__all__ = [
    "CacheIdentity",
    "CacheIndex",
    "CacheJob",
    "CacheOptions",
    "CacheProgress",
    "CachedClip",
    "CachedLatents",
    "ClipPlace",
    "ClipPlan",
    "EncoderChoice",
    "Encoders",
    "MomentPictures",
    "Moments",
    "PathKind",
    "PathPictures",
    "ShardEntry",
    "cache_scenes",
    "damaged_scenes",
    "identity_of",
    "load_encoders",
    "only_writer",
    "read_index",
]
