"""Pieces of the report's HTML: sections, figures, tables, and the scripts with the policy that allows them."""

from __future__ import annotations

import base64
import hashlib
import html
import importlib.resources
from collections.abc import Sequence

import numpy as np

from spslam.evaluation.report_images import image_uri


def section(title: str, body: str, note: str = "") -> str:
    """A section with a heading and a note under it; empty without a body."""
    if not body:
        return ""
    below = f"<p>{html.escape(note)}</p>" if note else ""
    return f"<section><h2>{html.escape(title)}</h2>{below}{body}</section>"


def figure(image: np.ndarray, max_width: int, caption: str, kind: str = "view") -> str:
    """An embedded image [H, W, 3] with a caption."""
    text = html.escape(caption)
    source = image_uri(image, max_width)
    return f'<figure class="{kind}"><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def table(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of escaped texts, which scrolls by itself where it is too wide; the first column is a heading."""
    first = f"<tr>{''.join(f'<th>{html.escape(cell)}</th>' for cell in head)}</tr>" if head else ""
    lines = "".join(
        f"<tr><th>{html.escape(cells[0])}</th>{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells[1:])}</tr>"
        for cells in rows
    )
    return f'<div class="wide"><table>{first}{lines}</table></div>'


def web_file(name: str) -> str:
    """The content of a script or style sheet that comes with the package."""
    return (importlib.resources.files("spslam.evaluation") / "web" / name).read_text(encoding="utf-8")


def security_policy(scripts: Sequence[str]) -> str:
    """A content security policy by which a page runs these scripts alone and requests nothing from anywhere."""
    hashes = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; base-uri 'none'"
