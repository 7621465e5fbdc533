"""A small picture of a plan in a home, from above."""

import dataclasses

import numpy as np
from PIL import Image, ImageDraw

from nrp_jax.homes.grid import Grid
from vrrt_jax.core.result import PlanResult

PICTURE_PX = 320  # the longer side
_SOLID, _WAY, _START, _GOAL = "#3b4252", "#d1495b", "#2a9d8f", "#d1495b"
_DOT = 4  # radius of start and goal [px]


@dataclasses.dataclass(frozen=True)
class TopView:
    """Draws a result: the map, and the way of the robot's base through it."""

    grid: Grid
    caption = "from above: the start (green), the way of the base, and the goal (red)"

    def __call__(self, result: PlanResult) -> np.ndarray:
        """The picture (H, W, 3) uint8, with +y upwards; start green, goal red."""
        solid = np.asarray(self.grid.occupied.any(axis=2))
        scale = PICTURE_PX / max(solid.shape)
        size = [max(1, round(scale * side)) for side in solid.shape]
        cells = Image.fromarray(np.where(solid.T[::-1], np.uint8(255), np.uint8(0)))
        picture = Image.new("RGB", (size[0], size[1]), "white")
        picture.paste(_SOLID, mask=cells.resize((size[0], size[1]), Image.Resampling.BOX))
        pen = ImageDraw.Draw(picture)
        corner, px_per_m = np.asarray(self.grid.origin[:2]), scale / self.grid.resolution

        def at(q: np.ndarray) -> list[tuple[float, float]]:
            places = px_per_m * (np.atleast_2d(q)[:, :2] - corner)
            return [(float(x), size[1] - float(y)) for x, y in places]

        if len(result.trajectory) > 1:
            pen.line(at(result.trajectory), fill=_WAY, width=2)
        for q, color in ((result.path[0], _START), (result.target, _GOAL)):
            pen.circle(at(q)[0], _DOT, fill=color, outline="black")
        return np.asarray(picture)
