"""Vision: frames in, tracked points out. Imports OpenCV; nothing else of the package does.

`SquareTracker` follows a corner of a square through shifts, turns and zooms, `TextureTracker` follows natural
texture at one zoom; both take frames and return tracked points, one a frame. `locate_square` looks at a single image.

What a probe does to a specimen: `find_moving_tip` finds the probe by its motion, `contact_patch` chooses by what the
specimen is tracked, `DeformationTracker` measures both in µm, and `VisualContact` tells when they touched.
"""

from microdrivers.estimators.vision.contact import DeformationTracker, ImageScale
from microdrivers.estimators.vision.contact_patch import ContactPatch, NoContactPatch, contact_patch
from microdrivers.estimators.vision.locate import SquareFit, SquareNotFound, locate_square
from microdrivers.estimators.vision.moving_tip import NoMovingTip, TipView, find_moving_tip
from microdrivers.estimators.vision.square import SquareTracker, least_turn
from microdrivers.estimators.vision.texture import TextureTracker
from microdrivers.estimators.vision.visual_contact import ContactEvent, VisualContact

__all__ = [
    "SquareTracker",
    "TextureTracker",
    "SquareFit",
    "SquareNotFound",
    "locate_square",
    "least_turn",
    "TipView",
    "NoMovingTip",
    "find_moving_tip",
    "ContactPatch",
    "NoContactPatch",
    "contact_patch",
    "ImageScale",
    "DeformationTracker",
    "ContactEvent",
    "VisualContact",
]
