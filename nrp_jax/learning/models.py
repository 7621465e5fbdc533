"""The networks: a discriminator that ranks waypoints, and a CVAE that generates them.

Both see the surroundings of the start as an image, which is encoded once for all candidates (Lu et
al. 2024, section IV). Letters: ``n`` starts, ``C`` candidates of a start, ``E`` features.
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp

GLOBAL_CVAE = "global-cvae"  # sees the whole map, and generates configurations along whole paths
NEXT = "next"  # sees the whole map, and tells where to go from a configuration and how far it is
MAP_KINDS = (GLOBAL_CVAE, NEXT)
WAYPOINT_KINDS = ("discriminator", "cvae")
KINDS = (*WAYPOINT_KINDS, *MAP_KINDS)
FIRE = "fire"  # a database of experiences, see nrp_jax.learning.similarity
TASKS = ("snake", "fetch")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Architecture and inputs of a network; kept with its weights."""

    task: str  # "snake" or "fetch"
    kind: str  # one of KINDS
    scope: str = "window"  # what the network sees: the local "window", or the whole "map"
    paper: bool = False  # the published architecture and its raw inputs
    patches: tuple[int, ...] = (4, 2)  # side of the patches each encoder layer merges
    channels: tuple[int, ...] = (32, 64)  # width of each encoder layer
    context: int = 128  # width of the layers that join image, start and goal
    width: int = 64  # width of the layers after those, for each candidate or latent
    # Add to each candidate what the image holds where the robot would be; for windows only.
    lookup: bool = True
    latent: int = 8  # dimensions of the CVAE's latent; of NEXT, features of each of its channels
    kl_weight: float = 0.01  # of the CVAE's KL term
    blocked_weight: float = 0.0  # of the term that keeps the CVAE's waypoints clear of obstacles
    attention: int = 8  # channels that NEXT attends to
    iterations: int = 20  # of the module with which NEXT plans on the map
    turning: int = 0  # joints whose turns to the goal NEXT sees, those with cosines and sines

    @classmethod
    def default(cls, task: str, kind: str, scope: str = "window") -> "ModelConfig":
        """The light architecture: patches merged by matrix products, heights as channels."""
        check_choices(task, kind, scope)
        if kind == NEXT:
            turning = 6 if task == "snake" else 8
            whole = {"scope": "map", "lookup": False, "patches": (5, 2)}
            return cls(task=task, kind=kind, attention=4, turning=turning, **whole)
        scope = "map" if kind == GLOBAL_CVAE else scope
        wide = {"channels": (64, 96), "context": 192} if task == "fetch" else {}
        if scope == "map":
            wide["lookup"] = False
            wide["patches"] = (5, 2, 2) if task == "snake" else (5, 2, 3)
            wide["channels"] = (32, 64, 96)
        if kind == "cvae":
            wide |= {"context": 384, "width": 384}
            blocked = {"snake": 0.5, "fetch": 0.3}  # measured for windows alone
            wide["blocked_weight"] = blocked[task] if scope == "window" else 0.0
        if kind == GLOBAL_CVAE:
            wide |= {"context": 256, "width": 256}
        return cls(task=task, kind=kind, scope=scope, **wide)

    @classmethod
    def published(cls, task: str, kind: str, scope: str = "window") -> "ModelConfig":
        """The architecture of the paper, as its published code has it."""
        check_choices(task, kind, scope)
        if kind == NEXT:
            return cls(task=task, kind=kind, scope="map", paper=True, lookup=False)
        scope = "map" if kind == GLOBAL_CVAE else scope
        width = 512 if task == "snake" else 1024
        latent = 5 if task == "snake" else 8
        return cls(
            task=task, kind=kind, scope=scope, paper=True, lookup=False, width=width, latent=latent
        )


def check_choices(task: str, kind: str, scope: str = "window") -> None:
    """Raise a ValueError that lists what there is."""
    for name, value, choices in (
        ("task", task, TASKS),
        ("model", kind, KINDS),
        ("scope", scope, ("window", "map")),
    ):
        if value not in choices:
            raise ValueError(f"unknown {name} '{value}'; have: {', '.join(choices)}")


# The convolutions of the published models, a tuple for each layer:
# features, kernel, stride, padding, whether normalized, whether pooled.
_SNAKE = (
    (16, (4, 4), 2, 1, False, False),
    (32, (3, 3), 2, 1, True, False),
    (64, (3, 3), 2, 1, True, False),
)
_CONVOLUTIONS = {
    ("snake", "window", "discriminator"): _SNAKE,
    ("snake", "window", "cvae"): (*_SNAKE, (128, (4, 4), 2, 1, True, False)),
    ("snake", "map"): (*_SNAKE, (128, (4, 4), 2, 1, True, False)),
    ("fetch", "window"): (
        (64, (3, 3, 3), 1, 0, True, True),
        (64, (3, 3, 3), 1, 0, True, True),
        (64, (3, 3, 3), 1, 0, True, False),
    ),
    ("fetch", "map"): (
        (16, (7, 7, 3), 2, 0, True, False),
        (32, (5, 5, 3), 1, 0, True, True),
        (64, (5, 5, 3), 1, 0, True, False),
        (128, (5, 5, 1), 1, 0, True, False),
    ),
}


class PatchEncoder(nn.Module):
    """Merges square patches of cells into one, layer by layer.

    Matrix products are far faster on a CPU than convolutions.
    """

    config: ModelConfig

    @nn.compact
    def __call__(self, image: jax.Array, train: bool) -> jax.Array:
        """Features (n, F) of images (n, X, Y, Z), whose heights are channels."""
        x = image
        for side, channels in zip(self.config.patches, self.config.channels, strict=True):
            # The cells of a patch, side by side, are the channels of one new cell.
            n, width, depth, _ = x.shape
            x = x.reshape(n, width // side, side, depth // side, side, -1)
            x = x.transpose(0, 1, 3, 2, 4, 5).reshape(n, width // side, depth // side, -1)
            x = nn.relu(nn.Dense(channels)(x))
        return x.reshape(len(x), -1)


class PaperEncoder(nn.Module):
    """The published convolutions: 2D for the snake, 3D with coordinates for the Fetch."""

    config: ModelConfig

    @nn.compact
    def __call__(self, image: jax.Array, train: bool) -> jax.Array:
        """Features (n, F) of occupancies (n, X, Y, Z)."""
        config = self.config
        key = (config.task, config.scope)
        layers = _CONVOLUTIONS.get(key) or _CONVOLUTIONS[(*key, config.kind)]
        x = image if config.task == "snake" else _with_coordinates(image)
        for features, kernel, stride, padding, normalized, pooled in layers:
            x = nn.Conv(features, kernel, stride, padding)(x)
            if normalized:
                x = nn.BatchNorm(use_running_average=not train, epsilon=1e-4, momentum=0.9)(x)
            x = nn.leaky_relu(x, 0.1 if config.task == "fetch" else 0.01)
            if pooled:
                x = nn.max_pool(x, (2,) * len(kernel), (2,) * len(kernel))
        x = x.reshape(len(x), -1)
        if config.task == "fetch" and config.scope == "map":
            x = _normalized(nn.Dense(2048)(x), train)
        return x


def _with_coordinates(image: jax.Array) -> jax.Array:
    """Occupancy, and the coordinates of the cells' centers [m], as channels (n, X, Y, Z, 4)."""
    size = jnp.array(image.shape[1:])
    cells = jnp.stack(jnp.meshgrid(*map(jnp.arange, image.shape[1:]), indexing="ij"), axis=-1)
    middle = jnp.array([0.5, 0.5, 0.0]) * size  # heights count from the floor
    centers = 0.1 * (cells + 0.5 - middle)
    centers = jnp.broadcast_to(centers, (len(image), *centers.shape))
    return jnp.concatenate([image[..., None], centers.astype(image.dtype)], axis=-1)


def _normalized(x: jax.Array, train: bool, slope: float = 0.01) -> jax.Array:
    """Batch normalization and a leaky ReLU."""
    x = nn.BatchNorm(use_running_average=not train, momentum=0.9)(x)
    return nn.leaky_relu(x, slope)


def _encoder(config: ModelConfig) -> nn.Module:
    return (PaperEncoder if config.paper else PatchEncoder)(config)


class Discriminator(nn.Module):
    """How likely is each candidate to be an (almost) optimal waypoint?"""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        image: jax.Array,
        start: jax.Array,
        goal: jax.Array,
        candidates: jax.Array,
        relation: jax.Array,
        train: bool = False,
    ) -> jax.Array:
        """Logits (n, C).

        Args:
            image: (n, X, Y, Z) surroundings of the starts.
            start: (n, E) features.
            goal: (n, E') features.
            candidates: (n, C, E'') features, or (1, C, E'') if all starts share them.
            relation: (n, C, R) from :func:`nrp_jax.learning.batches.relations`; unused without
                ``lookup``.
            train: normalize by this batch.
        """
        config = self.config
        context = jnp.concatenate([_encoder(config)(image, train), start, goal], axis=-1)
        if config.paper:
            # The published first layer reads context and candidate side by side. Its product is a
            # sum of two, of which the context's is computed once for all candidates.
            x = nn.Dense(config.width)(context)[:, None]
            x = x + nn.Dense(config.width, use_bias=False)(candidates)
            x = _normalized(x, train)
            if config.task == "fetch":
                for _ in range(2):
                    x = _normalized(nn.Dense(config.width)(x), train)
                x = nn.leaky_relu(nn.Dense(256)(x), 0.01)
            return nn.Dense(1)(x)[..., 0]
        context = nn.relu(nn.Dense(config.context)(context))
        context = nn.relu(nn.Dense(config.context)(context))
        # The context shifts and scales the features of every candidate.
        shift, scale = jnp.split(nn.Dense(2 * config.width)(context)[:, None], 2, axis=-1)
        x = nn.Dense(config.width)(candidates)
        if config.lookup:
            x = x + nn.Dense(config.width, use_bias=False)(relation)
        x = nn.relu(x * (1 + scale) + shift)
        x = nn.relu(nn.Dense(config.width)(x))
        return nn.Dense(1)(x)[..., 0]


class CVAE(nn.Module):
    """A conditional variational autoencoder of waypoints; planning uses its decoder alone."""

    config: ModelConfig
    num_outputs: int

    def setup(self):
        """Build encoder and decoder; in the light model they share the image's encoder."""
        config = self.config
        self.decoder_image = _encoder(config)
        self.encoder_image = _encoder(config) if config.paper else None
        self.encoder = Layers(config, 2 * config.latent)
        self.decoder = Layers(config, self.num_outputs)

    def __call__(self, image, start, goal, waypoints, key, train: bool = False):
        """Encode waypoints (n, C, E), sample latents and decode them.

        Returns:
            The reconstruction (n, C, E); mean and log variance (n, C, latent).
        """
        seen = self.decoder_image(image, train)
        own = self.encoder_image(image, train) if self.encoder_image else seen
        context = jnp.concatenate([own, start, goal], axis=-1)
        mean, log_variance = jnp.split(self.encoder(context, waypoints, train), 2, axis=-1)
        z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
        return self._decode(seen, start, goal, z, train), mean, log_variance

    def decode(self, image, start, goal, z):
        """Waypoint features (n, C, E) for latents (n, C, latent)."""
        return self._decode(self.decoder_image(image, False), start, goal, z, False)

    def _decode(self, seen, start, goal, z, train: bool):
        made = self.decoder(jnp.concatenate([seen, start, goal], axis=-1), z, train)
        # The light model generates the step from the start.
        return made if self.config.paper else made + start[:, None]


class Layers(nn.Module):
    """Fully connected layers on a context (n, F) joined with C inputs (n, C, E) each."""

    config: ModelConfig
    num_outputs: int

    @nn.compact
    def __call__(self, context: jax.Array, inputs: jax.Array, train: bool) -> jax.Array:
        """Outputs (n, C, num_outputs)."""
        config = self.config
        if config.paper:
            x = nn.Dense(config.width)(context)[:, None]
            x = x + nn.Dense(config.width, use_bias=False)(inputs)
            x = _normalized(x, train, 0.0)
            for _ in range(2):
                x = _normalized(nn.Dense(config.width)(x), train, 0.0)
            return nn.Dense(self.num_outputs)(x)
        context = nn.relu(nn.Dense(config.context)(context))
        x = nn.Dense(config.width)(context)[:, None] + nn.Dense(config.width)(inputs)
        x = nn.relu(x)
        for _ in range(2):
            x = nn.relu(nn.Dense(config.width)(x))
        return nn.Dense(self.num_outputs)(x)


def discriminator_loss(logits: jax.Array, target: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean binary cross-entropy () of the candidates (n, C), weighted by the mask."""
    entropy = jax.nn.softplus(logits) - target * logits
    return jnp.sum(entropy * mask) / jnp.maximum(jnp.sum(mask), 1.0)


def cvae_loss(
    config: ModelConfig,
    waypoints: jax.Array,
    reconstruction: jax.Array,
    mean: jax.Array,
    log_variance: jax.Array,
    mask: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The CVAE's objective: squared error of the features plus the weighted KL divergence.

    Returns:
        The loss, the reconstruction error and the KL divergence [nat], all ().
    """
    total = jnp.maximum(jnp.sum(mask), 1.0)
    error = jnp.sum(jnp.mean((reconstruction - waypoints) ** 2, axis=-1) * mask) / total
    divergence = 0.5 * jnp.sum(jnp.exp(log_variance) + mean**2 - 1.0 - log_variance, axis=-1)
    divergence = jnp.sum(divergence * mask) / total
    return error + config.kl_weight * divergence, error, divergence
