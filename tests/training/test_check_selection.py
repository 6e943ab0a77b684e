"""Rules of a user's own: they are traced before a run, and they train."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sauna
from command_line import sauna_here
from helpers import SMALL, configured
from sauna.algorithm.selection.registry import make_filter
from sauna.config.arms import ARMS, arm_settings, fixed_by
from sauna.config.presets import resolve, resolve_run
from sauna.config.settings import Config
from sauna.config.stored import read_stored, to_stored
from sauna.envs.spaces import Spaces
from sauna.experiments.run_list import list_runs
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.training.check_plugins import check_plugins

SPACES = Spaces("vector", (3,), "continuous", (2,), "", "")
BITS = Spaces("vector", (3,), "multi_binary", (2,), "", "")


def of(**settings: Any) -> Config:
    start = {"arm": "ppo", "rollout_steps": 16, "minibatches": 4, "hidden": "4", "steps": 64}
    return configured(**{**start, **settings})


@pytest.mark.parametrize("spaces", [SPACES, BITS])
def test_rules_that_fit_are_taken(spaces: Spaces) -> None:
    for settings in (
        {"arm": "sauna", "filter": "own_rules:likely"},
        {"arm": "sauna", "filter": "own_rules:likely", "filter_kwargs": '{"least": -2}'},
        {"sampler": "own_rules:newest", "sampler_kwargs": '{"share": 0.25}'},
        {"sampler": "own_rules:newest", "control": "reversed"},
        {"sampler": "own_rules:scoreless", "control": "stride"},
        {"loss_weight": "own_rules:softened", "loss_weight_kwargs": '{"power": 2}'},
        {"stop": "own_rules:far", "stop_kwargs": '{"limit": 0.1}'},
        {"objective": "own_rules:one_sided", "critic": "own_rules:robust"},
    ):
        check_plugins(of(**settings), spaces)


REFUSED = [
    (
        {"arm": "sauna", "filter": "own_rules:likely", "filter_kwargs": '{"most": -2}'},
        "filter_kwargs: own_rules:likely cannot be made: likely() got an unexpected",
    ),
    ({"arm": "sauna", "filter": "own_rules:far"}, "filter: own_rules:far is not a sauna.StepF"),
    ({"sampler": "own_rules:no_rule"}, "sampler: own_rules:no_rule is not a sauna.Sampler"),
    ({"sampler": "own_rules:too_short"}, "keep of shape (15,) and type bool instead of (16,)"),
    ({"sampler": "own_rules:by_number"}, "and type float32 instead of (16,) and bool"),
    ({"sampler": "own_rules:both"}, "not exactly one: keep or probability"),
    ({"sampler": "own_rules:neither"}, "not exactly one: keep or probability"),
    ({"sampler": "own_rules:mask_alone"}, "instead of a sauna.Choice"),
    ({"sampler": "own_rules:unpaired"}, "no pair of a state and a choice"),
    ({"sampler": "own_rules:misspelt"}, "has no attribute 'advantages'"),
    ({"sampler": "own_rules:growing"}, "a state of other arrays than it began with"),
    ({"sampler": "own_rules:of_nothing"}, "has share 0.0, which is not in (0, 1]"),
    ({"sampler": "own_rules:scoreless", "control": "reversed"}, "whose choice has a score"),
    (
        {"sampler": "own_rules:scoreless", "sampler_kwargs": '{"share": 0.5}'},
        "sampler_kwargs: own_rules:scoreless is a rule already and takes none",
    ),
    (
        {"sampler": "own_rules:newest", "sampler_kwargs": '{"sare": 0.5}'},
        "sampler_kwargs: own_rules:newest cannot be made: newest() got an unexpected",
    ),
    ({"loss_weight": "own_rules:single"}, "no pair of a mask and a scale"),
    ({"loss_weight": "own_rules:summed"}, "scale of shape () and type float32 instead of (4,)"),
    ({"loss_weight": "own_rules:far"}, "loss_weight: own_rules:far is not a sauna.LossWeight"),
    ({"stop": "own_rules:each"}, "an answer of shape (4,) and type bool instead of ()"),
    ({"stop": "own_rules:amount"}, "type float32 instead of () and bool"),
    ({"stop": "own_rules:nothere"}, "has no 'nothere'"),
    ({"sampler": "kondo", "sampler_kwargs": '{"share": 7}'}, "share must be a number between"),
    ({"sampler": "pods", "sampler_kwargs": '{"size": 7}'}, "unexpected keyword argument 'size'"),
    ({"stop": "espo", "stop_kwargs": '{"limit": "x"}'}, "limit must be a number at least 0"),
    ({"loss_weight": "delight", "loss_weight_kwargs": '{"on": "x"}'}, "on must be one of mean"),
    ({"critic": "own_rules:each_error"}, "a loss of shape (4,) and type float32 instead of ()"),
    ({"objective": "own_rules:averaged"}, "terms of shape () and type float32 instead of (4,)"),
    ({"critic": "own_rules:single"}, "critic: own_rules:single is not a function"),
    (
        {"arm": "prioritized", "sampler_kwargs": '{"share": 0.5}', "selection_losses": "policy"},
        "prioritized draws as many rows as the rollout has, for the critic; leave out its share",
    ),
    ({"arm": "gradient-norm", "normalize_over": "kept"}, "draws and keeps no set; use rollout"),
]


ONLY_CONTINUOUS = [
    ({"arm": "delight", "loss_weight_kwargs": '{"centred": false}'}, "delight reads centred for"),
    ({"arm": "delight", "loss_weight_kwargs": '{"on": "all"}'}, "delight reads on for continuous"),
    ({"arm": "kondo", "sampler_kwargs": '{"centred": true}'}, "kondo reads centred for continuous"),
]


@pytest.mark.parametrize("settings, text", ONLY_CONTINUOUS)
def test_arguments_that_bits_do_not_read_are_refused(settings: dict[str, Any], text: str) -> None:
    check_plugins(of(**settings), SPACES)
    with pytest.raises(BadInput, match=text):
        check_plugins(of(**settings), BITS)


def test_a_share_that_is_read_with_losses_of_the_policy_alone() -> None:
    check_plugins(of(arm="kondo", sampler_kwargs='{"share": 0.5}'), SPACES)
    check_plugins(of(arm="prioritized", selection_losses="policy"), SPACES)
    check_plugins(of(arm="top-advantage", normalize_over="kept"), SPACES)


@pytest.mark.parametrize("settings, text", REFUSED)
def test_a_mistake_is_one_line_before_the_run(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(BadInput) as found:
        check_plugins(of(**settings), SPACES)
    assert text in str(found.value) and "\n" not in str(found.value)


def test_a_mistake_ends_with_2_and_creates_nothing(tmp_path) -> None:
    settings = {"arm": "ppo", "rollout-steps": 16, "minibatches": 4, "steps": 64}
    command = ["small_envs:Scripted", *(f"--{name}={value}" for name, value in settings.items())]
    mistakes = (
        ["--sampler", "own_rules:too_short"],
        ["--sampler", "kondo", "--sampler-kwargs", '{"share": 7}'],
    )
    for mistake in mistakes:
        run = sauna_here("train", *command, *mistake, "--out", "run", cwd=tmp_path)
        assert run.returncode == 2 and run.stderr.count("\n") == 1, run.stderr
        assert list(tmp_path.iterdir()) == []


def test_rules_train_by_name_and_by_value(tmp_path) -> None:
    """A quarter of the rows: minibatches of 2. The sampler's state is a Python number."""
    settings = {**SMALL, "arm": "ppo", "steps": 64, "selection_mode": "smaller"}
    found = sauna.train(
        "small_envs:Scripted",
        out=tmp_path / "one",
        quiet=True,
        sampler="own_rules:newest",
        sampler_kwargs={"share": 0.25},
        loss_weight="own_rules:softened",
        stop="own_rules:far",
        stop_kwargs={"limit": 1e9},
        **settings,
    )
    for row in found.metrics:
        assert row["sample_rate"] == 0.25 and row["gradient_steps"] == 8
        assert row["samples_backward"] == 16 and row["samples_forward"] == 16 + 32
    import own_rules

    again = sauna.train(
        "small_envs:Scripted",
        out=tmp_path / "two",
        quiet=True,
        sampler=own_rules.newest,
        sampler_kwargs={"share": 0.25},
        loss_weight=own_rules.softened,
        stop=own_rules.far,
        stop_kwargs={"limit": 1e9},
        **settings,
    )
    assert [row["policy_loss"] for row in again.metrics] == [
        row["policy_loss"] for row in found.metrics
    ]


def test_a_run_of_ones_own_rule_is_called_by_it(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    rule = {"sampler": "own_rules:newest", "control": "random"}
    settings = {**SMALL, **rule, "arm": "ppo", "steps": 64, "quiet": True}
    found = sauna.train("small_envs:Scripted", **settings)
    assert found.path.name.startswith("small_envs-Scripted_ppo+own_rules.newest_seed0_")
    assert {row["member"] for row in found.metrics} == {"ppo+own_rules.newest/0"}
    assert "ppo+own_rules.newest" in list_runs(tmp_path)[1]
    assert sauna.load(found.path, member="ppo+own_rules.newest/0").name == "ppo+own_rules.newest/0"
    further = sauna.resume(found.path, steps=128, quiet=True)
    assert {row["member"] for row in further.metrics} == {"ppo+own_rules.newest/0"}
    sauna.export(found.path, tmp_path / "exported", episodes=0, say=print)
    assert sauna.load(tmp_path / "exported").name == "ppo+own_rules.newest/0"
    stored = run_directory.read_config(found.path)
    before = {name: value for name, value in stored.items() if name != "names_rules"}
    assert [member.name for member in read_stored(before).members] == ["ppo/0"], "a run of before"
    assert "names_rules" not in to_stored(resolve_run({"env": "x", "arm": "gigaflow"}))


def test_everything_a_rule_is_written_with_is_public() -> None:
    for name in sauna.__all__:
        assert getattr(sauna, name).__name__ == name
    assert {"Sampler", "Samples", "Choice", "StepFilter", "ScoredStep"} <= set(sauna.__all__)


MISTAKEN = [
    ({"control": "random"}, "control: needs a rule to follow"),
    ({"sampler": "pods", "loss_weight": "delight", "control": "random"}, "are two rules"),
    ({"loss_weight": "delight", "control": "stride"}, "controlled by random or reversed"),
    ({"arm": "random-drop", "drop_rate": 0.5, "control": "stride"}, "is a control itself"),
    ({"arm": "sauna-reference", "control": "random"}, "control: needs gae_over=all"),
    ({"arm": "sauna-reference", "critic": "avec"}, "critic: needs gae_over=all"),
    (
        {"arm": "sauna-reference", "recompute_advantages": True},
        "recompute_advantages: needs gae_over=all",
    ),
    ({"objective": "unclipped"}, "unclipped needs a stop rule"),
    ({"algorithm": "a2c", "stop": "espo"}, "stop: not read"),
    ({"sampler_kwargs": "{}"}, "sampler_kwargs: not read"),
    ({"arm": "sauna", "filter_kwargs": "{}"}, "needs a filter of your own"),
    ({"arm": "random"}, "follows a rule; join it to one"),
    ({"arm": "ppo,gigaflow"}, "gigaflow differs from the other arms in"),
    ({"arm": "sauna,sauna+avec"}, "sauna+avec differs from the other arms in"),
    ({"arm": "gigaflow+random+avec+spo+pods"}, "joins sampler gigaflow and sampler pods"),
    ({"arm": "gigaflow+pods"}, "joins sampler gigaflow and sampler pods"),
    ({"arm": "gigaflow+avec+gigaflow"}, "joins a rule to itself"),
    ({"arm": "gigafow"}, "did you mean 'gigaflow'"),
    ({"sampler": "kondu"}, "did you mean 'kondo'"),
    ({"arm": "pods", "sampler_kwargs": '{"share": Infinity}'}, "JSON has no infinity"),
    ({"arm": "gigaflow", "sampler": "pods"}, "sampler: fixed by arm gigaflow; `--arm ppo` lets"),
    ({"arm": "gigaflow", "filter": "sauna"}, "filter: fixed by arm gigaflow; `--arm sauna` lets"),
    ({"arm": "gigaflow+avec", "critic": "squared"}, "critic: fixed by arm gigaflow+avec"),
    ({"arm": "gigaflow+random", "control": "stride"}, "control: fixed by arm gigaflow+random"),
    ({"arm": "espo", "objective": "clip"}, "objective: fixed by arm espo"),
    ({"arm": "merl", "auxiliary": "none"}, "auxiliary: fixed by arm merl"),
    ({"arm": "avec", "clip_value": True}, "clip_value: not read by arm avec"),
    ({"arm": "positive", "normalize_advantages": False}, "normalize_advantages: not read by arm"),
    ({"arm": "kondo", "selection_mode": "smaller"}, "a sampler with selection_losses=all"),
    ({"normalize_over": "kept"}, "normalize_over: kept needs a sampler"),
    ({"arm": "recompute", "epochs": 1}, "recompute_advantages: needs more than one epoch"),
    ({"arm": "recompute", "preset": "a2c"}, "recompute_advantages: needs more than one epoch"),
    ({"arm": "spo", "preset": "a2c"}, "objective: spo needs a ratio, which A2C has none of"),
    ({"arm": "sample-dropout", "preset": "a2c"}, "sample-dropout needs a ratio other than 1"),
]


@pytest.mark.parametrize("settings, text", MISTAKEN)
def test_rules_that_cannot_work_together_are_refused(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(BadInput) as found:
        resolve({"env": "small_envs:Scripted", "arm": "ppo", **settings})
    assert text in str(found.value)


def test_joined_rules_are_those_of_each_part() -> None:
    """In any order, but a control follows what it is joined to; each part changes ppo."""
    both = arm_settings("sauna+avec")
    assert both == {**ARMS["sauna"], "critic": "avec", "clip_value": False}
    turned = arm_settings("avec+sauna")
    assert {name: turned[name] for name in both} == both
    assert arm_settings("gigaflow+random") == {**ARMS["gigaflow"], "control": "random"}
    resolved = resolve({"env": "small_envs:Scripted", "arm": "gigaflow+stride"})
    assert (resolved.sampler, resolved.control, resolved.filter) == ("gigaflow", "stride", "none")


FREE = [
    ("sauna+avec", {"filter": "random-drop", "drop_rate": 0.5}, "filter", "random-drop"),
    ("ppo", {"sampler": "pods"}, "sampler", "pods"),
    ("gigaflow", {"sampler_kwargs": '{"threshold": 0.1}'}, "sampler_kwargs", '{"threshold":0.1}'),
    ("vex-head", {"auxiliary": "shuffled-observation"}, "auxiliary", "shuffled-observation"),
    ("kondo", {"selection_losses": "all"}, "selection_losses", "all"),
]


@pytest.mark.parametrize("arm, settings, name, value", FREE)
def test_what_an_arm_leaves_free(arm: str, settings: dict[str, Any], name: str, value: Any) -> None:
    found = resolve({"env": "small_envs:Scripted", "arm": arm, **settings})
    assert str(getattr(found, name)).replace(" ", "") == value


def test_every_rule_of_an_arm_is_fixed_by_it() -> None:
    """But for what its set is normalised over and which losses it touches."""
    free = {"normalize_over", "selection_losses", "clip_value", "vex_target"}
    for arm in ARMS:
        if not arm.startswith(("sauna", "vex-head", "random", "ppo")):
            changed = {k for k, v in ARMS[arm].items() if v != ARMS["ppo"].get(k)} - free
            assert changed <= fixed_by(arm), arm


def test_an_own_filters_arguments_matter() -> None:
    """A step of log-probability -2.5 is kept or dropped."""
    settings = {"arm": "sauna", "filter": "own_rules:likely"}
    zero = np.zeros(1, np.float32)
    step = sauna.ScoredStep(zero, zero, np.full(1, -2.5, np.float32), zero, zero)
    for least, kept in ((-3.0, True), (-2.0, False)):
        own = make_filter(of(**settings, filter_kwargs={"least": least}))
        assert own is not None and own.keep((), step, None, None)[1].tolist() == [kept]  # type: ignore[arg-type]


OFF = {
    "sampler": "none",
    "control": "none",
    "normalize_over": "minibatch",
    "advantage_sign": "both",
    "objective": "clip",
    "loss_weight": "none",
    "stop": "none",
    "critic": "squared",
    "recompute_advantages": False,
    "auxiliary": "none",
}


def test_a_hook_that_is_off_is_the_same_config_as_none_given() -> None:
    """So the same program, and the same bits; `six_runs.py` holds them to those of before."""
    plain = {"env": "small_envs:Scripted", "arm": "sauna,vex-head"}
    assert resolve({**plain, **OFF}) == resolve(plain)
    assert np.all([getattr(Config(), name) == value for name, value in OFF.items()])
