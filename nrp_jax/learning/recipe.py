"""How models are trained: our recipe, and the published one."""

import dataclasses
from typing import Self

import optax

from nrp_jax.learning.models import GLOBAL_CVAE, check_choices
from vrrt_jax.core.settings import setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a model is trained."""

    epochs: int = 60
    batch: int = 64  # queries a step
    learning_rate: float = 2e-3  # at its peak, after which it falls to 0 along a cosine
    weight_decay: float = 1e-3
    patience: int = 12  # training ends after so many epochs without a better validation loss
    augment: bool = True  # turn and mirror each query at random
    validation: float = 0.15  # share of the homes that is held out
    seed: int = 0
    # Halve a constant learning rate after so many steps without a lower loss, instead of the
    # cosine; Adam with its weight decay in the gradient, as published.
    plateau: int | None = None

    @classmethod
    def published(cls, task: str, kind: str) -> Self:
        """The paper's recipe, from the code that came with it (Lu et al. 2024).

        Its batches are of rows, ours of queries with up to eight rows each. The validation homes
        stay held out, which the paper's are not, and decide on the best epoch alone.
        """
        check_choices(task, kind)
        epochs = 100 if task == "fetch" and kind != GLOBAL_CVAE else 50
        many = kind == GLOBAL_CVAE or (task, kind) == ("snake", "cvae")
        return cls(
            epochs=epochs,
            batch=64 if many else 16,
            learning_rate=1e-3,
            weight_decay=5e-4 if (task, kind) == ("snake", "discriminator") else 0.0,
            patience=epochs,
            augment=False,
            plateau=10_000 if task == "fetch" else 5_000,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnlineConfig:
    """How NEXT is trained; the defaults are those that the NRP paper's authors published."""

    epochs: int = setting(50, 1, 100_000)  # on the expert's paths
    batch: int = setting(256, 1, 65_536)  # states a step
    learning_rate: float = setting(1e-3, 1e-8, 1.0)
    weight_decay: float = setting(5e-5, 0.0, 1.0)  # in the gradient
    step: float = setting(1.0, 0.01, 1e3)  # along a path, which the network learns [m]
    value_weight: float = setting(0.1, 0.0, 1e3)  # of the values' squared error in the loss
    augment: bool = False  # turn and mirror each path at random
    problems: int = setting(9000, 0, 1_000_000)  # that its planner tries in the training homes
    expansions: int = setting(500, 1, 1_000_000)  # of a problem
    states: int = setting(2000, 1, 1_000_000)  # new ones after which it is trained again
    round_epochs: int = setting(10, 1, 100_000)  # of each such training, on all paths so far
    explored: float = setting(1.0, 0.0, 1.0)  # share of RRT*'s expansions in the first problems
    least_explored: float = setting(0.1, 0.0, 1.0)  # and in the last ones, by tenths
    lanes: int = setting(32, 1, 4096)  # expansions at a time
    validation: float = 0.15  # share of the homes that is held out
    minutes: float = setting(1e6, 0.0, endless=True)  # no epoch but the first begins after so many
    seed: int = setting(0, 0, 2**31)

    @classmethod
    def light(cls) -> Self:
        """For two cores: a tenth of the problems, fewer epochs, shorter rounds, and symmetries.

        A batch has the states of two goals, with ten paths of the expert to each.
        """
        return cls(
            epochs=8,
            batch=720,
            problems=900,
            states=1000,
            round_epochs=1,
            augment=True,
            minutes=60.0,
        )

    def explored_in(self, problem: int) -> float:
        """The share of RRT*'s expansions in a problem."""
        tenths = int(10 * (self.explored - self.least_explored) * problem / max(self.problems, 1))
        return max(self.explored - tenths / 10, self.least_explored)


def check_settings(settings: TrainConfig) -> None:
    """Raise a ValueError that names the setting out of range."""
    for name, low, high in (
        ("epochs", 1, 100_000),
        ("batch", 1, 65_536),
        ("learning_rate", 1e-8, 1.0),
        ("patience", 1, 100_000),
        ("seed", 0, 2**31),
    ):
        value = getattr(settings, name)
        if not low <= value <= high:
            raise ValueError(f"{name} is {value}; expected {low} to {high}")


def make_optimizer(settings: TrainConfig, steps: int) -> optax.GradientTransformationExtraArgs:
    """The optimizer of a training of some steps; its updates are given the loss as ``value``."""
    if settings.plateau is not None:
        return optax.chain(
            optax.add_decayed_weights(settings.weight_decay),
            optax.adam(settings.learning_rate),
            optax.contrib.reduce_on_plateau(factor=0.5, patience=settings.plateau),
        )
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, settings.learning_rate, min(200, steps // 10 + 1), steps + 1
    )
    optimizer = optax.adamw(schedule, weight_decay=settings.weight_decay)
    return optax.with_extra_args_support(optimizer)
