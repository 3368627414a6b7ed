"""What each browser has for itself: whether its view follows the camera, and screenshots."""

from __future__ import annotations

import contextlib
from typing import Any

import cv2
import numpy as np

# A browser in the background never answers.
_RENDER_TIMEOUT_S = 20.0
_MAX_RENDER_PX = 4096
_BEHIND_M, _ABOVE_M, _AHEAD_M = 0.9, 0.35, 1.5


class Visitors:
    """Adds the controls of each client when it connects.

    Args:
        server: viser's.
        name: of the run; screenshots begin with it.
    """

    def __init__(self, server: Any, name: str):
        self._server, self._name = server, "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
        self._follows: dict[int, Any] = {}
        self._pose: np.ndarray | None = None
        self._frame = 0
        server.on_client_connect(self._came)
        server.on_client_disconnect(self._went)

    def follow(self, frame: int, pose: np.ndarray) -> None:
        """Moves the views that follow behind the camera, float64 [4, 4] T_world_camera of a frame."""
        self._frame, self._pose = frame, pose
        clients = self._server.get_clients()
        for number, box in list(self._follows.items()):
            if number in clients and box.value is True:
                self._place(clients[number])

    def _place(self, client: Any) -> None:
        if self._pose is None:
            return
        right_up, forward, center = -self._pose[:3, 1], self._pose[:3, 2], self._pose[:3, 3]
        with contextlib.suppress(Exception), client.atomic():  # the client may be leaving
            client.camera.up_direction = tuple(right_up)
            client.camera.position = tuple(center - _BEHIND_M * forward + _ABOVE_M * right_up)
            client.camera.look_at = tuple(center + _AHEAD_M * forward)

    def _came(self, client: Any) -> None:
        with contextlib.suppress(Exception):  # it may have left again
            box = client.gui.add_checkbox(
                "Follow camera", initial_value=False, hint="off: drag to look around", order=4
            )
            box.on_update(lambda _: self._place(client) if box.value is True else None)
            button = client.gui.add_button("Screenshot", hint="saves the 3-D view as PNG", order=5)
            button.on_click(lambda _: self._capture(client))
            self._follows[client.client_id] = box

    def _went(self, client: Any) -> None:
        self._follows.pop(client.client_id, None)

    def _capture(self, client: Any) -> None:
        try:
            height, width = client.camera.image_height, client.camera.image_width
            height, width = (min(max(int(size), 1), _MAX_RENDER_PX) for size in (height, width))
            image = client.get_render(height, width, transport_format="jpeg", timeout=_RENDER_TIMEOUT_S)
            content = cv2.imencode(".png", np.ascontiguousarray(image[..., 2::-1]))[1].tobytes()
            client.send_file_download(f"{self._name}-{self._frame:06d}.png", content, save_immediately=True)
        except Exception as error:
            with contextlib.suppress(Exception):
                client.add_notification("No screenshot", str(error), color="red", auto_close_seconds=8.0)
