"""Settings of the training of a self-model."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelConfig:
    """How one level of detail is trained."""

    num_splats: int
    size_px: int  # image height and width [px]
    steps: int  # of Adam
    batch: int  # images a step


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How a self-model is trained."""

    num_images: int = 400
    num_surface_images: int = 150  # of the images, those with depth, to place the splats
    num_validation: int = 60
    image_px: int = 256  # height and width of the images [px]
    fovy_deg: tuple[float, float] = (40.0, 55.0)
    elevation_deg: tuple[float, float] = (-75.0, 5.0)
    # Distance and spread of the cameras' targets are in radii of the robot's workspace, whose
    # center the cameras look at.
    distance: tuple[float, float] = (1.5, 2.6)
    target_spread: float = 0.15
    learning_rate: float = 0.1
    detail: float = 1.0  # times the splats of all levels but the close-up; large robots need more
    levels: tuple[LevelConfig, ...] = (
        LevelConfig(num_splats=300, size_px=32, steps=1000, batch=8),
        LevelConfig(num_splats=600, size_px=64, steps=1500, batch=6),
        LevelConfig(num_splats=1500, size_px=128, steps=600, batch=4),
        LevelConfig(num_splats=5000, size_px=256, steps=300, batch=2),
    )
    # The close-up is a part of an image of `close_up_of_px`, around the outermost link. The part's
    # middle is at most `close_up_off` of its height away from the link.
    close_up: LevelConfig = LevelConfig(num_splats=2400, size_px=96, steps=1500, batch=4)
    close_up_of_px: int = 480
    close_up_off: float = 0.15
