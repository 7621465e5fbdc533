"""A self-model is trained on MuJoCo's images, and goes on after an interruption."""

import dataclasses

import pytest

from vrrt_jax.splat import fit, fit_level
from vrrt_jax.splat.fit_config import FitConfig, LevelConfig
from vrrt_jax.splat.model import load_self_model

SMALL = LevelConfig(num_splats=90, size_px=32, steps=120, batch=2)
CONFIG = FitConfig(
    num_images=30,
    num_surface_images=20,
    num_validation=6,
    image_px=64,
    levels=(SMALL,),
    close_up=dataclasses.replace(SMALL, num_splats=70),
    close_up_of_px=128,
)


def test_a_small_self_model_is_trained_and_resumed(arm, tmp_path, monkeypatch):
    robot, spec = arm
    path = tmp_path / "arm.npz"
    train_level, calls = fit.fit_level, []

    def interrupted(*args, **kwargs):
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return train_level(*args, **kwargs)

    monkeypatch.setattr(fit, "fit_level", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit.fit_self_model(robot, spec, path, seed=0, config=CONFIG)
    with pytest.raises(ValueError, match="unfinished training of another robot, seed"):
        fit.fit_self_model(robot, spec, path, seed=1, config=CONFIG)
    other = dataclasses.replace(robot, xml=robot.xml + " ")
    with pytest.raises(ValueError, match="unfinished training of another robot"):
        fit.fit_self_model(other, spec, path, seed=0, config=CONFIG)

    restored, rendered = [], []
    restore, render_images = fit_level.restore_checkpoint, fit.render_images
    monkeypatch.setattr(
        fit_level, "restore_checkpoint", lambda *a: restored.append(a[0].name) or restore(*a)
    )
    monkeypatch.setattr(
        fit, "render_images", lambda *a, **k: rendered.append(k) or render_images(*a, **k)
    )
    model = fit.fit_self_model(robot, spec, path, seed=0, config=CONFIG)
    assert len(restored) == 1 and not rendered  # the level and the images that were done
    assert not path.with_name("arm.npz.work").exists()
    assert model.levels[0].psnr_db > 22 and model.close_up.psnr_db > 18
    assert all(0 < level.match_threshold < 0.5 for level in (*model.levels, model.close_up))
    assert load_self_model(path).close_up.match_threshold == model.close_up.match_threshold


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"num_images": 0}, "num_images is 0"),
        ({"num_validation": 0}, "num_validation is 0"),
        ({"num_surface_images": 0}, "num_surface_images is 0"),
        ({"levels": ()}, "number of levels is 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"detail": 0.01}, "num_splats of levels.0., times detail is 0.9"),
        ({"image_px": 8}, "image_px beside levels.0. is 8; expected .* at least 32"),
        ({"close_up_of_px": 8}, "close_up_of_px is 8"),
        ({"levels": (dataclasses.replace(SMALL, steps=0),)}, "steps of levels.0. is 0"),
    ],
)
def test_settings_that_train_nothing_are_refused(arm, tmp_path, change, words):
    robot, spec = arm
    config = dataclasses.replace(CONFIG, **change)
    with pytest.raises(ValueError, match=words):
        fit.fit_self_model(robot, spec, tmp_path / "arm.npz", seed=0, config=config)
    assert not list(tmp_path.iterdir())
