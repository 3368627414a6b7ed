"""What a viewer costs a run: the same frames with and without in turn, two clients attached, one of which is stalled.

    python -m experiments.viewer_cost 7scenes --data DATA/redkitchen --frames 0:1000 --repeats 3

Each run is a command of its own, as a user gives it. The first client receives and drops what it is sent, from this
process, so that its time is not the viewer's; with `--browser` it is a page in a headless Chromium instead, which draws
on the same processors. The second one asks for the page's socket and never reads it.

Prints for each run: frames per second; seconds of the whole command; seconds of processor time of the run, of its
viewer and of the clients; the viewer's memory (resident, and proportional: of what it shares with others, its part);
and megabytes that the first client received. Below that, each pair's frames per second with a viewer by those without,
whether the trajectories are the same, and whether a process of the viewer outlived its run.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from spslam.cli.arguments import add_config

_SECONDS_BETWEEN_SAMPLES, _POLL_S = 1.0, 0.05
_START_TIMEOUT_S = 120.0
_COLUMNS = ("fps", "wall_s", "run_s", "viewer_s", "clients_s", "rss_mb", "pss_mb", "received_mb")


class Clients:
    """Two clients of the viewer at a port.

    Args:
        port: of the viewer.
        browser: whether the first one is a page in Chromium.
    """

    def __init__(self, port: int, browser: bool):
        self.received_mb = 0.0
        self._address, self._browser = f"127.0.0.1:{port}", browser
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._attend, daemon=True)
        self._thread.start()

    def leave(self) -> None:
        """Ends them."""
        self._left.set()
        self._thread.join()

    def _attend(self) -> None:
        with contextlib.ExitStack() as stack:
            stalled = stack.enter_context(self._connect())
            if self._browser:
                from tests.browser import open_browser

                page = stack.enter_context(stack.enter_context(open_browser()).page())
                page.open(f"http://{self._address}/")
                self._left.wait()
            else:
                self._drop(stack.enter_context(self._connect()))
            stalled.close_socket()

    def _connect(self) -> contextlib.AbstractContextManager[Any]:
        import viser
        import websockets.sync.client as client

        options: dict[str, Any] = {"subprotocols": [f"viser-v{viser.__version__}"], "proxy": None, "max_size": None}
        deadline = time.monotonic() + _START_TIMEOUT_S
        while True:
            try:
                return client.connect(f"ws://{self._address}/", **options)
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)

    def _drop(self, connection: Any) -> None:
        with contextlib.suppress(Exception):  # the run has ended
            while True:
                self.received_mb += len(connection.recv()) / 1e6


def processes(root: int) -> Iterator[int]:
    """A process and its descendants."""
    yield root
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{root}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from processes(int(child))


def find_viewer(run: int) -> int | None:
    """The viewer's process among those of a run."""
    for pid in processes(run):
        with contextlib.suppress(OSError):
            if b"spslam.viewer.process" in Path(f"/proc/{pid}/cmdline").read_bytes():
                return pid
    return None


def sample(pid: int, figures: dict[str, float]) -> None:
    """Processor time so far, and the largest memory seen; what has ended leaves the figures as they are."""
    with contextlib.suppress(OSError, IndexError):
        ticks = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
        figures["viewer_s"] = sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            name = line.split(":")[0].lower() + "_mb"
            if name in ("rss_mb", "pss_mb"):
                figures[name] = max(figures.get(name, 0.0), int(line.split()[1]) / 1024)


def own_seconds() -> float:
    """Processor time of this process and of those of its children that have ended."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def measure(command: list[str], output: Path, view: bool, browser: bool) -> tuple[dict[str, float], bytes, bool]:
    """One run.

    Returns:
        Figures, trajectory, and whether its viewer outlived it.
    """
    figures: dict[str, float] = {}
    port = free_port()
    command = [*command, "--output", str(output), *(["--view", "--port", str(port)] if view else [])]
    before, began = own_seconds(), time.perf_counter()
    run = subprocess.Popen(command, stderr=subprocess.PIPE)
    clients, viewer, due_s = Clients(port, browser) if view else None, None, 0.0
    # Until it ends, but not waited for: then its own figures are gone.
    while os.waitid(os.P_PID, run.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
        if view and time.perf_counter() >= due_s:
            due_s = time.perf_counter() + _SECONDS_BETWEEN_SAMPLES
            viewer = viewer or find_viewer(run.pid)
            if viewer is not None:
                sample(viewer, figures)
        time.sleep(_POLL_S)
    wall_s = time.perf_counter() - began
    _, status, usage = os.wait4(run.pid, 0)
    if status:
        raise SystemExit(run.stderr.read().decode() if run.stderr else "the run failed")
    outlived = viewer is not None and Path(f"/proc/{viewer}").exists()
    if clients is not None:
        clients.leave()
        figures["received_mb"] = clients.received_mb
    metrics = json.loads((output / "metrics.json").read_text())
    spent_s = usage.ru_utime + usage.ru_stime
    figures |= {
        "fps": metrics["fps"],
        "wall_s": wall_s,
        "run_s": spent_s - figures.get("viewer_s", 0.0),
        "clients_s": own_seconds() - before - spent_s,
    }
    return figures, (output / "trajectory.txt").read_bytes(), outlived


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def main() -> None:
    """Runs with and without in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_config(parser)
    parser.add_argument("--frames", help="START:STOP[:STEP], only these frames")
    parser.add_argument("--repeats", type=int, default=3, help="pairs of runs")
    parser.add_argument("--browser", action="store_true", help="the first client is a page in Chromium")
    args = parser.parse_args()
    command = [sys.executable, "-m", "spslam", "run", args.config, "--device", "cpu", "--no-mesh", "--quiet"]
    command += ["--data", str(args.data)] if args.data else []
    command += ["--frames", args.frames] if args.frames else []
    command += [f"--set={change}" for change in (*args.changes, "run.previews=0")]
    import viser  # noqa: F401 before the time of the clients is counted

    trajectories, outlived, ratios = set(), False, []
    print("viewer  " + "  ".join(f"{name:>11}" for name in _COLUMNS), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(args.repeats):
            fps = {}
            # The first of two runs alternates, as a machine may become slower with time.
            for view in (False, True) if number % 2 == 0 else (True, False):
                output = Path(folder) / f"{number}-{view}"
                figures, trajectory, left = measure(command, output, view, args.browser)
                trajectories.add(trajectory)
                outlived, fps[view] = outlived or left, figures["fps"]
                values = "  ".join(f"{figures.get(name, 0.0):11.1f}" for name in _COLUMNS)
                print(f"{'yes' if view else 'no':<8}{values}", flush=True)
            ratios.append(fps[True] / fps[False])
    print(f"frames/s with / without: {', '.join(f'{r:.3f}' for r in ratios)}; median {statistics.median(ratios):.3f}")
    print(f"trajectories are {'the same' if len(trajectories) == 1 else 'DIFFERENT'}")
    print(f"a viewer {'OUTLIVED its run' if outlived else 'ended with each run'}")


if __name__ == "__main__":
    main()
