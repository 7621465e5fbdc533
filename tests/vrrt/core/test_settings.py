"""Settings: ranges beside their fields, changes by name."""

import dataclasses

import pytest

from vrrt_jax import Budget, LineageConfig, PlannerConfig, TreeConfig
from vrrt_jax.config import check_config


@pytest.mark.parametrize(
    "config, message",
    [
        (PlannerConfig(tree=TreeConfig(lanes=1)), r"tree.lanes=1 is out of range; .* \[2, 4096\]"),
        (PlannerConfig().changed({"expand.kappa": 1.0}), r"expand.kappa=1.0 .* \[0.0, 1.0\)"),
        (PlannerConfig(budget=Budget(time_limit_s=float("nan"))), "budget.time_limit_s=nan"),
        (
            PlannerConfig(lineages=LineageConfig(num=None)),
            "lineages.num=None; expected a whole number",
        ),
        (PlannerConfig(tree=TreeConfig(capacity=33)), "tree.capacity=33 leaves no room"),
    ],
)
def test_settings_out_of_range_are_named(config, message):
    with pytest.raises(ValueError, match=message):
        check_config(config)


def test_none_is_allowed_where_it_means_no_limit():
    check_config(PlannerConfig(budget=Budget(patience=None)))
    check_config(PlannerConfig.paper())


def test_changes_go_to_their_stage_and_unknown_names_are_told():
    config = PlannerConfig().changed({"lineages.num": 256, "budget.attempts": 1})
    assert config == PlannerConfig(lineages=LineageConfig(num=256), budget=Budget(attempts=1))
    with pytest.raises(ValueError, match="unknown setting 'probes'; have: tree, lineages, expand"):
        PlannerConfig().changed({"probes": 256})
    with pytest.raises(
        ValueError, match="unknown setting .lineages.probes.; have: lineages.num, lineages.trees"
    ):
        PlannerConfig().changed({"lineages.probes": 256})


def test_every_number_has_a_range():
    for stage in dataclasses.fields(PlannerConfig):
        for field in dataclasses.fields(getattr(PlannerConfig(), stage.name)):
            assert "range" in field.metadata or field.type == "bool" or field.type is bool


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"tree.rewiring": "no"}, "tree.rewiring='no'; expected True or False"),
        ({"tree.lanes": True}, "tree.lanes=True; expected a whole number"),
        ({"tree.lanes": 8.5}, "tree.lanes=8.5; expected a whole number"),
        ({"expand.alpha": "0.1"}, "expand.alpha='0.1'; expected a number"),
        ({"tree": 16}, "tree=16; expected a TreeConfig"),
        ({"tree.lanes.x": 1}, "'tree.lanes' is a single setting"),
        ({"tree.lane": 1}, "unknown setting 'tree.lane'; have: tree.lanes, tree.capacity"),
    ],
)
def test_values_of_the_wrong_type_and_wrong_names_are_told(changes, message):
    with pytest.raises(ValueError, match=message):
        check_config(PlannerConfig().changed(changes))


def test_a_config_of_another_kind_is_told():
    with pytest.raises(ValueError, match="config is a builtins.dict; expected a vrrt_jax.Planner"):
        check_config({})
