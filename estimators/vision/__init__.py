"""Vision: frames in, tracked points out. Imports OpenCV; nothing else of the package does.

`SquareTracker` follows a corner of a square through shifts, turns and zooms, `TextureTracker` follows natural
texture at one zoom; both take frames and return tracked points, one a frame. `locate_square` looks at a single image.
"""

from microdrivers.estimators.vision.locate import SquareFit, SquareNotFound, locate_square
from microdrivers.estimators.vision.square import SquareTracker, least_turn
from microdrivers.estimators.vision.texture import TextureTracker

__all__ = [
    "SquareTracker",
    "TextureTracker",
    "SquareFit",
    "SquareNotFound",
    "locate_square",
    "least_turn",
]
