"""A dynamic scene as six planes of features, learnt from a few videos with known cameras (own, in plain torch).

After Cao and Johnson 2023, "HexPlane: A Fast Representation for Dynamic Scenes".
"""

from gcd_train.hexplane.bounds import SceneBounds
from gcd_train.hexplane.field import HexField
from gcd_train.hexplane.learning import draw, learn
from gcd_train.hexplane.planes import HexPlanes
from gcd_train.hexplane.posed_pictures import Camera, PosedPicture
from gcd_train.hexplane.settings import HexPlaneSettings

__all__ = [
    "Camera",
    "HexField",
    "HexPlaneSettings",
    "HexPlanes",
    "PosedPicture",
    "SceneBounds",
    "draw",
    "learn",
]
