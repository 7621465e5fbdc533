"""Settings of the training of a self-model."""

import dataclasses

FEWEST_SPLATS = 20  # of a level


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelConfig:
    """How one level of detail is trained."""

    num_splats: int
    size_px: int  # image height and width [px]
    steps: int  # of Adam
    batch: int  # images a step


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How a self-model is trained in one round."""

    num_images: int = 150
    num_surface_images: int = 60  # of the images, those with depth, to place the splats
    num_validation: int = 40
    image_px: int = 256  # height and width of the images [px]
    fovy_deg: tuple[float, float] = (40.0, 55.0)
    elevation_deg: tuple[float, float] = (-75.0, 5.0)
    # Distance and spread of the cameras' targets are in radii of the robot's workspace, whose
    # center the cameras look at.
    distance: tuple[float, float] = (1.5, 2.6)
    target_spread: float = 0.15
    learning_rate: float = 0.1
    refining: float = 0.3  # times this rate for splats of an earlier round
    detail: float = 1.0  # times the splats of all levels but the close-up; large robots need more
    levels: tuple[LevelConfig, ...] = (
        LevelConfig(num_splats=300, size_px=32, steps=500, batch=8),
        LevelConfig(num_splats=600, size_px=64, steps=700, batch=6),
        LevelConfig(num_splats=1500, size_px=128, steps=250, batch=4),
        LevelConfig(num_splats=5000, size_px=256, steps=80, batch=2),
    )
    # The close-up is a part of an image of `close_up_of_px`, around the outermost link. The part's
    # middle is at most `close_up_off` of its height away from the link.
    close_up: LevelConfig = LevelConfig(num_splats=2400, size_px=96, steps=500, batch=4)
    close_up_of_px: int = 480
    close_up_off: float = 0.15


# A first round that leaves a usable self-model soon. Plans compare images of up to 128 px, and the
# close-up; the level of 256 px is for pictures.
FIRST_ROUND = FitConfig(
    num_images=120,
    num_surface_images=50,
    levels=(
        LevelConfig(num_splats=300, size_px=32, steps=500, batch=8),
        LevelConfig(num_splats=600, size_px=64, steps=600, batch=6),
        LevelConfig(num_splats=1500, size_px=128, steps=200, batch=4),
    ),
    close_up=LevelConfig(num_splats=2400, size_px=96, steps=350, batch=4),
)


def check_fit_config(config: FitConfig) -> None:
    """Raise a ValueError that names a setting which no self-model can be trained with."""
    levels = {f"levels[{k}]": level for k, level in enumerate(config.levels)}
    bounds = {
        "num_images": (config.num_images, 1),
        "num_surface_images": (config.num_surface_images, 1),
        "num_validation": (config.num_validation, 1),
        "number of levels": (len(levels), 1),
        "learning_rate": (config.learning_rate, 1e-9),
        "refining": (config.refining, 1e-9),
        "close_up_of_px": (config.close_up_of_px, config.close_up.size_px),
    }
    for name, level in (levels | {"close_up": config.close_up}).items():
        detail = config.detail if name in levels else 1.0
        bounds |= {
            f"num_splats of {name}, times detail": (detail * level.num_splats, FEWEST_SPLATS),
            f"size_px of {name}": (level.size_px, 1),
            f"steps of {name}": (level.steps, 1),
            f"batch of {name}": (level.batch, 1),
        }
        if name in levels:
            bounds[f"image_px beside {name}"] = (config.image_px, level.size_px)
    for name, (value, low) in bounds.items():
        if not low <= value < float("inf"):
            raise ValueError(f"{name} is {value:g}; expected a number of at least {low:g}")
