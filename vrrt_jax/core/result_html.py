"""A result as a piece of a web page, which notebooks show. No scripts, and no files beside it."""

import base64
import io
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from vrrt_jax.core.result import PlanResult

_SOLVED, _FAILED = "#2a7f62", "#b3394a"
_CELL = "padding:2px 10px 2px 0;text-align:left;vertical-align:top"


def result_html(result: "PlanResult") -> str:
    """Status, advice, picture and numbers of a result; all texts are escaped."""
    color = _SOLVED if result.ok else _FAILED
    parts = [
        f'<b style="color:{color}">{escape(result.status.name)}</b>: {escape(result.status.value)}'
    ]
    if result.advice:
        parts.append(f"<div><i>{escape(result.advice)}</i></div>")
    if result.draw is not None:
        caption = escape(result.draw.caption)
        parts.append(f"<div>{_picture(result.draw(result))}<br><small>{caption}</small></div>")
    rows = "".join(
        f'<tr><th style="{_CELL}">{escape(name)}</th><td style="{_CELL}">{escape(text)}</td></tr>'
        for name, text in _rows(result)
    )
    parts.append(f"<table>{rows}</table>")
    return f"<div>{''.join(parts)}</div>"


def _rows(result: "PlanResult") -> list[tuple[str, str]]:
    """Names and texts; what is not known is left out."""
    check, times = result.verification, result.timing
    rows = [("path", f"{len(result.path)} waypoints, cost {result.cost:.3g}")]
    if np.isfinite(result.clearance):
        rows.append(("clearance", f"{result.clearance:.3f} m"))
    if check is not None:
        verdict = check.contact or "free"
        rows.append(
            ("exact check", f"{verdict} ({check.checked} configurations, {check.geometry})")
        )
    rows.append(("loss", f"{result.loss:.2e}, a match up to {result.match_threshold:.2e}"))
    if np.isfinite(result.match_probability):
        rows.append(("match probability", f"{result.match_probability:.2f}"))
    if len(result.alternatives):
        rows.append(("ambiguous", f"{len(result.alternatives)} other configurations match as well"))
    rows.append(("search", f"{result.expansions} expansions, {int(result.tree.size)} nodes"))
    spent = ", ".join(f"{name.removesuffix('_s')} {value:.1f} s" for name, value in times.items())
    return [*rows, ("time", spent)]


def _picture(pixels: np.ndarray) -> str:
    """Pixels (H, W, 3) uint8 as an image inside the page."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="the result" src="data:image/png;base64,{data}">'
