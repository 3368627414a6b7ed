"""Names of what functions take as numbers: the same as in `spslam.ops`."""

from enum import IntEnum


class Activation(IntEnum):
    """What follows the last layer of `mlp`."""

    NONE = 0
    TANH = 1
    SIGMOID = 2


class RandomStream(IntEnum):
    """What a draw is for; draws of different streams are independent."""

    PIXEL_DATABASE = 0
    TRACKING_PIXELS = 1
    TRACKING_RAYS = 2
    MAPPING_PIXELS = 3
    MAPPING_RAYS = 4
    FRAME_SELECTION = 5
    COVISIBILITY = 6
    ENCODER_POINTS = 7
    INITIALIZATION = 8
    EVALUATION = 9
