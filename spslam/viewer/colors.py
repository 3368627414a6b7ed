"""Colors of what is drawn, one meaning each."""

import numpy as np

# Of error probabilities 0, 0.5 and 1: told apart also by those who can't tell red from green.
_SURE, _DOUBTFUL, _WRONG = np.array([[38, 108, 196], [247, 178, 37], [206, 32, 41]], np.float64)
_UNJUDGED = np.array([120, 130, 150], np.float64)
LOST = (190, 0, 190)
KEYFRAME = (90, 120, 140)
LOOP = (0, 160, 0)
RELOCALIZED = (0, 150, 110)
GROUND_TRUTH = (60, 60, 60)
AHEAD = (205, 205, 205)  # the path after the moment that is shown
CAMERA = (20, 20, 20)
_LINEAR = np.round(255 * (np.arange(256) / 255) ** 2.2).astype(np.uint8)


def error_probability_colors(values: np.ndarray) -> np.ndarray:
    """uint8 [N, 3] RGB for error probabilities [N]: blue, amber, red; gray where NaN."""
    known = np.nan_to_num(np.clip(values, 0, 1), nan=0.0)[:, None]
    colors = np.where(
        known < 0.5, _SURE + 2 * known * (_DOUBTFUL - _SURE), _DOUBTFUL + (2 * known - 1) * (_WRONG - _DOUBTFUL)
    )
    return np.where(np.isnan(values)[:, None], _UNJUDGED, colors).round().astype(np.uint8)


def linear(colors: np.ndarray) -> np.ndarray:
    """uint8 colors as viser's lines want them: it shows them as if they were proportional to light."""
    return _LINEAR[colors]


def hexadecimal(color: tuple[int, int, int] | np.ndarray) -> str:
    """`#rrggbb`."""
    return "#" + "".join(f"{int(channel):02x}" for channel in color)
