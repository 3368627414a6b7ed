"""The controls beside the 3-D view: state, playing, layers, images and curves."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from spslam.viewer.colors import GROUND_TRUTH, KEYFRAME, LOOP, LOST, RELOCALIZED, error_probability_colors, hexadecimal
from spslam.viewer.curves import Curve, known_curves
from spslam.viewer.model import RunModel
from spslam.viewer.player import Player
from spslam.viewer.scene_layers import LAYERS

if TYPE_CHECKING:
    from spslam.viewer.images import FrameImages

_CHART_HEIGHT_PX = 120


class Panel:
    """Builds the controls and keeps them up to date.

    Args:
        server: viser's.
        model: the frames.
        player: what pause, step and the slider act on.
        on_layer: called with a layer's name and whether it is to be seen.
    """

    def __init__(self, server: Any, model: RunModel, player: Player, on_layer: Callable[[str, bool], None]):
        self._server, self._model, self._player = server, model, player
        self._charts: dict[str, Any] = {}
        self._images: list[Any] = []
        self._depth_range_m: tuple[float, float] | None = None
        gui = server.gui
        self._state = gui.add_markdown("waiting for the first frame", order=0)
        self._slider = None
        if player.total is not None:
            last = max(player.total - 1, 1)
            self._slider = gui.add_slider("Frame", min=0, max=last, step=1, initial_value=last, order=1)
            self._slider.on_update(self._slid)
        self._play = None
        if player.can_pause:
            self._play = gui.add_button(player.label, order=2)
            self._play.on_click(self._clicked)
            gui.add_button("Step", hint="one frame more", order=3).on_click(lambda _: self._stepped())
        with gui.add_folder("Layers", order=8):
            for name, label in LAYERS.items():
                box = gui.add_checkbox(label, initial_value=True)
                box.on_update(lambda event, name=name: on_layer(name, bool(event.target.value)))
            gui.add_markdown(_legend())
        self._image_folder = gui.add_folder("Images", order=6)
        self._chart_folder = gui.add_folder("Curves", order=7)

    def show_state(self, shown: int) -> None:
        """Text and slider for frame `shown`."""
        self._state.content = describe(self._model, shown)
        self._label_play()
        if self._slider is not None and self._slider.value != shown:
            self._slider.value = shown

    def show_images(self, images: FrameImages) -> None:
        """Color above depth, each beside the map's rendering."""
        range_m = images.depth_range(self._model.info.depth_range_m)
        shown = images.colors(), images.depths(range_m)
        labels = "color: camera | map", f"depth {range_m[0]:.1f} to {range_m[1]:.1f} m: camera | map"
        if not self._images:
            with self._image_folder:
                self._images = [
                    self._server.gui.add_image(image, label=label, format="jpeg", jpeg_quality=80)
                    for image, label in zip(shown, labels, strict=True)
                ]
        for handle, image, label in zip(self._images, shown, labels, strict=True):
            handle.image, handle.label = image, label

    def show_curves(self) -> None:
        """All curves that have values."""
        for curve in known_curves(self._model):
            data = curve.points(self._model)
            if len(data[0]) < 2:
                continue
            if curve.column in self._charts:
                self._charts[curve.column].data = data
            else:
                with self._chart_folder:
                    self._charts[curve.column] = self._server.gui.add_uplot(data, **_chart(curve))

    def _slid(self, event: Any) -> None:
        # Assignments by this process come back as events without a client.
        if event.client is not None and self._slider is not None and _is_number(self._slider.value):
            self._player.seek(int(self._slider.value))

    def _clicked(self, _: Any) -> None:
        self._player.toggle()
        self._label_play()

    def _stepped(self) -> None:
        self._player.step()
        self._label_play()

    def _label_play(self) -> None:
        if self._play is not None:
            self._play.label = self._player.label


def describe(model: RunModel, shown: int) -> str:
    """The state of a frame in one paragraph of Markdown."""
    if not 0 <= shown < len(model):
        return "waiting for the first frame"
    probability, residual = model.column("error_probability")[shown], model.column("residual_cm")[shown]
    fps = model.column("fps")[shown]
    of = f" of {model.info.total}" if model.info.total is not None else ""
    parts = [f"**{'LOST' if model.lost[shown] else 'tracked'}**, frame {shown + 1}{of}"]
    if math.isfinite(fps):
        parts.append(f"{fps:.1f} frames/s")
    if math.isfinite(residual):
        parts.append(f"residual {residual:.2f} cm")
    if math.isfinite(probability):
        parts.append(f"error probability {probability:.3f}")
    lost = int(np.count_nonzero(model.lost))
    return ", ".join(parts) + (f"; {lost} frames lost so far" if lost else "")


def _legend() -> str:
    low, middle, high = (hexadecimal(color) for color in error_probability_colors(np.array([0.0, 0.5, 1.0])))
    entries = [
        (low, "path, error probability 0"),
        (middle, "0.5"),
        (high, "1"),
        (hexadecimal(LOST), "lost"),
        (hexadecimal(KEYFRAME), "keyframes"),
        (hexadecimal(LOOP), "loops"),
        (hexadecimal(RELOCALIZED), "relocalized"),
        (hexadecimal(GROUND_TRUTH), "ground truth"),
    ]
    return " ".join(f'<span style="color:{color}">■</span> {text}' for color, text in entries)


def _chart(curve: Curve) -> dict[str, Any]:
    from viser import uplot

    series = (uplot.Series(label="frame"), uplot.Series(label=curve.title, stroke=curve.color, width=1.5))
    return {
        "series": series,
        "title": curve.title,
        "scales": {"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
        "legend": uplot.Legend(show=True),
        "height": _CHART_HEIGHT_PX,
    }


def _is_number(value: Any) -> bool:
    """A client may send anything as the value of a slider."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
