"""Settings: ranges beside their fields, changes by name."""

import dataclasses

import pytest

from vrrt_jax import Budget, PlannerConfig, SeedConfig, TreeConfig
from vrrt_jax.config import check_config


@pytest.mark.parametrize(
    "config, message",
    [
        (PlannerConfig(tree=TreeConfig(lanes=1)), r"tree.lanes=1 is out of range; .* \[2, 4096\]"),
        (PlannerConfig().changed({"expand.kappa": 1.0}), r"expand.kappa=1.0 .* \[0.0, 1.0\)"),
        (PlannerConfig(budget=Budget(time_limit_s=float("nan"))), "budget.time_limit_s=nan"),
        (PlannerConfig(seeds=SeedConfig(num=None)), "seeds.num=None"),
        (PlannerConfig(tree=TreeConfig(capacity=64)), "tree.capacity=64 leaves no room"),
    ],
)
def test_settings_out_of_range_are_named(config, message):
    with pytest.raises(ValueError, match=message):
        check_config(config)


def test_none_is_allowed_where_it_means_no_limit():
    check_config(PlannerConfig(budget=Budget(patience=None)))
    check_config(PlannerConfig.paper())


def test_changes_go_to_their_stage_and_unknown_names_are_told():
    config = PlannerConfig().changed({"seeds.num": 256, "budget.attempts": 1})
    assert config == PlannerConfig(seeds=SeedConfig(num=256), budget=Budget(attempts=1))
    with pytest.raises(ValueError, match="unknown setting 'probes'; have: tree, expand, seeds"):
        PlannerConfig().changed({"probes": 256})
    with pytest.raises(ValueError, match="unknown setting .*probes.; have: num, radius, kept"):
        PlannerConfig().changed({"seeds.probes": 256})


def test_every_number_has_a_range():
    for stage in dataclasses.fields(PlannerConfig):
        for field in dataclasses.fields(getattr(PlannerConfig(), stage.name)):
            assert "range" in field.metadata or field.type == "bool" or field.type is bool
