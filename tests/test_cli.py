"""The command line as a user meets it: exit codes, one clear line, nothing created."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from command_line import sauna, sauna_here, small_flags
from sauna import cli
from sauna.config.accepted import over, translate
from sauna.config.other_names import ACCEPTED, ADVICE, SAME
from sauna.config.parsing import many_seeds
from sauna.config.presets import ARMS, PRESETS, overrides_of, resolve, resolve_run
from sauna.config.settings import FIELDS, flag, parse, to_json
from sauna.config.settings_file import settings_in
from sauna.config.stored import read_stored, stored_config, to_stored
from sauna.config.task_presets import TASK_PRESETS
from sauna.system import run_directory
from sauna.system.errors import BadInput

ENV = "small_envs:Scripted"


BAD = [
    (["train", "HalfCheeta-v5"], "did you mean 'HalfCheetah-v5'?"),
    (["train", ENV, "--arm", "suana"], "did you mean 'sauna'?"),
    (["train", ENV, "--preset", "mujco"], "did you mean 'mujoco'?"),
    (["train", ENV, "--treshold", "0.2"], "did you mean '--threshold'?"),
    (["train", ENV, "--threshold"], "expected one argument"),
    (["train", ENV, "--arm", "sauna", "--filter", "sanua"], "did you mean 'sauna'?"),
    (["train", ENV, "--arm", "sauna", "--filter", "nowhere:it"], "cannot import 'nowhere'"),
    (["train", ENV, "--minibatches", "33"], "33 does not divide rollout_steps x envs = 2048"),
    (["train", ENV, "--steps", "-5"], "steps: must be at least 1"),
    (["train", ENV, "--steps", "100"], "less than one rollout"),
    (["train", ENV, "--steps", "1.5"], "steps: cannot read '1.5' as a whole number"),
    (["train", ENV, "--seeds", "0"], "seeds: empty"),
    (["train", ENV, "--seeds", "1,1"], "seed is given twice"),
    (["train", ENV, "--seeds=-1,2"], "seeds: must lie between"),
    (["train", ENV, "--gamma", "1.1"], "gamma: must be at most 1"),
    (["train", ENV, "--gamma", "nan"], "gamma: must be a finite number"),
    (["train", ENV, "--hidden", ""], "hidden: empty"),
    (["train", ENV, "--env-kwargs", '{"a": [0, Infinity]}'], "JSON has no infinity and no NaN"),
    (["train", ENV, "--arm", "ppo", "--threshold", "0.5"], "threshold: not read by arm ppo"),
    (["train", ENV, "--arm", "ppo", "--filter", "sauna"], "filter: fixed by arm ppo"),
    (["train", ENV, "--arm", "random-drop"], "random-drop needs a rate"),
    (["train", ENV, "--drop-rate-from", "RUN"], "--drop-rate-from"),
    (["train", ENV, "--arm", "sauna", "--gae-over", "kept"], "kept needs truncation=terminate"),
    (["train", ENV, "--network", "nature-cnn"], "does not fit vector observations"),
    (["train", ENV, "--env-processes", "3"], "more worker processes than environments"),
    (["train", "small_envs:Spaced", "--env-kwargs", '{"action": "tuple"}'], "is not supported"),
    (["train", "small_envs:Picture", "--hidden", "8"], "hidden: not read"),
    (["train", ENV, "--seeds", "123456"], "for the one seed 123456 write --seed 123456"),
    (["train", ENV, "--arm", "sauna", "--filter", "small_envs:Scripted"], "not a sauna.StepFilter"),
    (
        ["train", ENV, "--arm", "sauna", "--vex-target", "small_envs:Scripted"],
        "is not a sauna.VexTarget",
    ),
    (["train", ENV, "--network", "small_envs:Scripted"], "is not a flax.linen module"),
    (["train", "small_envs:ConstantReward", "--log-std-init", "1"], "log_std_init: not read"),
    (["train", "small_envs:Picture", "--normalize-observations"], "have no running moments"),
    (["train", "small_envs:Misshapen"], "of shape (3,), and gives (1,)"),
    (
        ["train", "small_envs:Misshapen", "--env-kwargs", '{"size": 4}'],
        "shape (3,), and gives (4,)",
    ),
    (
        ["train", ENV, "--arm", "sauna", "--filter", "jax_envs:misspelt"],
        "has no attribute 'treshold'",
    ),
    (
        ["train", ENV, "--arm", "sauna", "--filter", "jax_envs:too_long"],
        "a mask of shape (2,) and type bool",
    ),
    (
        ["train", ENV, "--arm", "sauna", "--filter", "jax_envs:forgetting"],
        "a state of other arrays",
    ),
    (
        ["train", ENV, "--arm", "sauna", "--vex-target", "jax_envs:summed"],
        "gives shape () instead of (2048, 1)",
    ),
    (["train", "small_envs:Broken", "--env-kwargs", '{"broken": "step"}'], "cannot be played"),
    (["train", ENV, "--threshold", "0.8"], "threshold: not read by arm ppo"),
    (["train", ENV, "--n-steps", "64"], "here it is '--rollout-steps': kept steps"),
    (["train", ENV, "--num_envs=4"], "here it is '--envs': environments per member"),
    (["train", ENV, "--lr", "1e-3"], "here it is '--learning-rate'"),
    (["train", ENV, "--total-timesteps", "1e6"], "here it is '--steps'"),
    (["train", ENV, "--batch-size", "100"], "batch_size: 100 does not divide"),
    (["train", ENV, "--batch-size", "0"], "batch_size: 0 does not divide"),
    (["train", ENV, "--batch-size", "64", "--minibatches", "2"], "either batch_size or minib"),
    (["train", ENV, "--seed", "1", "--seeds", "2"], "either seed or seeds, not both"),
    (["train", ENV, "--target-kl", "0"], "target_kl: must be a number above 0"),
    (["train", ENV, "--target-kl", "x"], "target_kl: cannot read 'x' as a number"),
    (["train", ENV, "--target-kl", "0.01", "--stop", "espo"], "either target_kl or stop"),
    (["train", ENV, "--target-kl", "0.01", "--algorithm", "a2c"], "target_kl: only read"),
    (["train", ENV, "--eval-every", "512", "--stop-at", "x"], "stop_at: cannot read 'x' as a num"),
    (
        ["train", ENV, "--eval-every", "512", "--stop-at", "-1e3", "--steps", "9"],
        "steps: 9 is less",
    ),
    (["train", ENV, "--log-std-init", "-.5E-1", "--steps", "9"], "steps: 9 is less"),
    (["train", ENV, "--stop-at", "-x"], "expected one argument"),
    (["train", ENV, "--optimizer", "adamv"], "did you mean 'adam'"),
    (["train", ENV, "--kl-threshold", "0.01"], "here it is '--desired-kl'"),
    (
        ["train", ENV, "--seeds", "1.5"],
        "seeds: cannot read '1.5' as a count (6 are the seeds 0 to 5)",
    ),
    (["train", ENV, "--env-kwargs", "[1]"], "cannot read '[1]' as a JSON object, such as '{"),
    (["train", ENV, "--lr-schedule", "x"], "here it is '--learning-rate-schedule'"),
    (["train", ENV, "--seed", "1,2"], "seed: cannot read '1,2' as a whole number"),
    (["compare", ENV, "--ent-coef", "0.1"], "here it is '--entropy-coef'"),
    (["resume", "nothere", "--gamma", "0.9"], "a resumed run computes what it began with"),
    (["resume", "nothere", "--total-timesteps", "9"], "here it is '--steps'"),
    (["resume", "nothere", "--n-steps", "9"], "a resumed run computes what it began with"),
    (["resume", "nothere", "--procesess", "2"], "did you mean '--processes'?"),
    (["train"], "no environment given"),
    (["train", "--config", "none.json"], "cannot read none.json"),
    (["resume", "nothere"], "nothere is not a run directory"),
    (["resume", "nothere", "--gamma", "1"], "unknown argument '--gamma'"),
    (["eval", "nothere"], "nothere is not a run directory"),
    (["eval", "nothere", "--episodes", "0"], "episodes: must be a whole number of at least 1"),
    (["inspect", "nothere"], "nothere is not a run directory"),
    (["inspect", "nothere", "--episodes", "0"], "episodes: must be a whole number of at least 1"),
    (["inspect", "nothere", "--frames"], "did you mean '--no-frames'?"),
    (["list", "foo"], "invalid choice"),
    (["train", ENV, "--arm", "my:rule"], "--arm ppo --sampler my:rule, or --arm sauna --filter"),
    (["trian", ENV], "invalid choice: 'trian'"),
]


@pytest.mark.parametrize("arguments, expected", BAD, ids=[" ".join(b[0]) for b in BAD])
def test_bad_input_is_one_line_exit_2_and_nothing_created(
    arguments, expected, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit:
        cli.main(arguments)
    errors = capsys.readouterr().err
    assert exit.value.code == 2
    *frames, line = errors.splitlines()  # above the line stand frames of the user's own code
    assert expected in line and line.startswith("sauna: ")
    assert all(not frame.startswith("sauna: ") for frame in frames)
    assert not frames or frames[0].startswith("  File ")
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_found_without_importing_jax(tmp_path) -> None:
    code = (
        "import sys, sauna.cli\n"
        "try: sauna.cli.main(['train', 'Hopper-v5', '--minibatches', '7'])\n"
        "except SystemExit as e: print(e.code, 'jax' in sys.modules, 'flax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.split() == ["2", "False", "False"]


def test_train_resume_eval_and_list_together(tmp_path) -> None:
    run = tmp_path / "run"
    done = sauna("train", ENV, "--out", str(run), *small_flags(seeds=2, arm="sauna"), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "compiling" in done.stdout and "sauna/1: return" in done.stdout
    assert {p.name for p in run.iterdir()} == {
        ".lock",
        "checkpoints",
        "config.json",
        "figures",
        "metrics.csv",
        "metrics.jsonl",
        "summary.json",
        "timing.jsonl",
    }
    assert (run / "figures" / "learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    again = sauna_here("train", ENV, "--out", str(run), cwd=tmp_path)
    assert again.returncode == 2 and f"sauna resume {run}" in again.stderr
    assert "nothing to do" in sauna_here("resume", str(run), cwd=tmp_path).stdout
    for mode in ("sampled", "deterministic"):
        more = ["--deterministic"] if mode == "deterministic" else []
        done = sauna_here("eval", str(run), "--episodes", "3", *more, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"{mode} actions, frozen normaliser" in done.stdout
        assert "sauna/1: return" in done.stdout and "length" in done.stdout
        stored = json.loads((run / f"evaluation_{mode}.json").read_text())
        assert stored["mode"] == mode and len(stored["members"]["sauna/0"]["returns"]) == 3
    done = sauna_here("eval", str(run), "--member", "sauna/7", cwd=tmp_path)
    assert done.returncode == 2 and "did you mean 'sauna/" in done.stderr
    done = sauna_here("eval", str(run), "--env", "small_envs:Endless", cwd=tmp_path)
    assert done.returncode == 2 and "other spaces than the run: observation shape" in done.stderr


@pytest.mark.parametrize(
    "what, word",
    [
        ("envs", "HalfCheetah-v5"),
        ("arms", "sauna-paper"),
        ("presets", "mujoco-release"),
        ("filters", "random-drop"),
        ("targets", "minibatch"),
    ],
)
def test_lists(what: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["list", what])
    assert word in capsys.readouterr().out


@pytest.mark.slow
def test_the_same_command_gives_the_same_run_and_config_repeats_it(tmp_path) -> None:
    flags = small_flags(arm="sauna", threshold=0.7, seeds="4,9", envs=2)
    first, second = tmp_path / "first", tmp_path / "second"
    assert sauna("train", ENV, "--out", str(first), *flags).returncode == 0
    done = sauna("train", "--config", str(first / "config.json"), "--out", str(second))
    assert done.returncode == 0, done.stderr
    assert (first / "metrics.jsonl").read_bytes() == (second / "metrics.jsonl").read_bytes()
    other = tmp_path / "other"
    config = str(first / "config.json")
    assert sauna("train", "--config", config, "--out", str(other), "--seeds", "4,").returncode == 0
    rows = run_directory.rows(other)
    assert rows == [row for row in run_directory.rows(first) if row["seed"] == 4]


def test_a_value_edited_in_config_json_counts() -> None:
    stored = to_stored(resolve_run({"env": ENV, "arm": "ppo,sauna", "seeds": "2"}))
    stored["config"] |= {"threshold": 0.9, "processes": 2, "out": "there"}
    again = overrides_of(read_stored(stored))
    assert resolve(again).threshold == 0.9
    assert not {"processes", "out"} & set(again)  # a new run has its own
    stored["config"]["treshold"] = 0.9
    with pytest.raises(BadInput, match="did you mean 'threshold'"):
        read_stored(stored)


def test_every_field_has_a_flag_and_a_help_line(capsys) -> None:
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    text = capsys.readouterr().out
    for name, field in FIELDS.items():
        assert len(field.metadata["help"]) > 5
        assert name == "env" or flag(name) in text


def help_of(*arguments: str) -> str:
    """The help of a command, its lines joined."""
    command = cli._subparser(cli.make_parser(arguments), arguments[0])
    return " ".join(command.format_help().split())


def test_help_shows_what_most_need_first_with_types_and_the_presets_values() -> None:
    text = help_of("train", "--preset", "atari")
    places = [text.index(word) for word in ("most needed", "--arm NAME", "learning (defaults of")]
    assert places == sorted(places) and text.index("--seed INT") < text.index("--gae-lambda")
    assert "--arm NAME,... what to train" in text and "(default ppo)" in text
    assert "preset atari" in text
    assert (
        "--clip-range FLOAT clip range of the probability ratio (and the value) (default 0.1)"
        in text
    )
    assert "--envs INT environments per member (N) (default 8)" in text
    assert "--optimizer adam|rmsprop" in text
    assert "(default 0.2)" in help_of("train")
    assert "(default 16)" in help_of("train", "--algorithm=a2c")
    assert "--clip-range" in help_of("train", "--preset", "no such")  # is refused later
    lunar = help_of("train", "LunarLander-v3", "--arm", "sauna")
    assert "preset lunar-lander" in lunar and "discount (default 0.999)" in lunar
    own = help_of("train", "my_module:MyEnv", "--arm", "sauna")
    assert "preset mujoco" in own and "(default sauna)" in own


def test_compare_says_its_own_defaults() -> None:
    text = help_of("compare")
    assert "or which ones (100,101,110) (default 6)" in text
    assert "(default sauna)" in text and "(default ppo,vex- head,sauna+random,sauna)" in text


def test_one_seed_and_samples_per_minibatch() -> None:
    assert translate({"seed": "7"}) == {"seeds": (7,)}
    assert translate({"batch_size": 64}) == {"minibatches": 32}
    by_kl = translate({"target_kl": 0.01, "stop_kwargs": {"factor": 1}})
    assert by_kl == {"stop": "target-kl", "stop_kwargs": '{"factor": 1, "limit": 0.01}'}
    atari = {"preset": "atari", "envs": "16", "batch_size": "512"}
    assert translate(atari) == {"preset": "atari", "envs": "16", "minibatches": 4}
    assert translate({"seed": None, "gamma": 0.9}) == {"gamma": 0.9}


def test_seed_and_batch_size_replace_what_a_file_says(tmp_path) -> None:
    file = tmp_path / "settings.json"
    file.write_text(json.dumps({"env": ENV, "seeds": [1, 2], "minibatches": 4}))
    typed = {"seed": "7", "batch_size": "256"}
    merged = translate(over(settings_in(str(file), trust=True), typed))
    assert merged == {"env": ENV, "seeds": (7,), "minibatches": 8}


def test_what_a_large_count_of_seeds_means_is_said() -> None:
    assert "42 seeds, 0 to 41; for the one seed 42 write --seed 42" in str(
        many_seeds((*range(42),))
    )
    assert many_seeds((42,)) is None and many_seeds(tuple(range(6))) is None
    assert many_seeds(tuple(range(100, 142))) is None  # which nobody types as a count


def test_other_trainers_names_lead_to_fields() -> None:
    for ours in SAME.values():
        assert ours in FIELDS or ours in ACCEPTED
    assert not set(SAME) & set(FIELDS) and not set(ADVICE) & set(FIELDS)
    with pytest.raises(BadInput, match="unknown key 'ent_coef'; here it is 'entropy_coef'"):
        resolve({"env": "x", "ent_coef": 0.1})


def test_config_goes_through_json_unchanged() -> None:
    config = resolve({"env": "x", "seeds": "3,4", "hidden": "5,6", "env_kwargs": '{"b": 1}'})
    assert stored_config(json.loads(json.dumps(to_json(config)))) == config


@pytest.mark.parametrize(
    "name, text, value",
    [
        ("steps", "1e6", 1_000_000),
        ("seeds", "3", (0, 1, 2)),
        ("seeds", "100,101", (100, 101)),
        ("seeds", "7,", (7,)),
        ("seeds", [5, 6], (5, 6)),
        ("hidden", "512,256,128", (512, 256, 128)),
        ("clip_value", "no", False),
        ("learning_rate", "3e-4", 3e-4),
        ("arm", "ppo, sauna", ("ppo", "sauna")),
        ("wrap", "", ()),  # none of the preset's
        ("value_hidden", "", ()),
    ],
)
def test_values_are_read(name, text, value) -> None:
    assert parse(name, text) == value


@pytest.mark.parametrize(
    "name, text", [("steps", True), ("gamma", "x"), ("clip_value", "maybe"), ("seeds", "a,b")]
)
def test_values_that_cannot_be_read(name, text) -> None:
    with pytest.raises(BadInput, match=f"{name}: cannot read"):
        parse(name, text)


def test_presets_are_the_published_numbers() -> None:
    config = resolve({"env": "x", "arm": "ppo"})
    published = {
        "rollout_steps": 2048,
        "envs": 1,
        "minibatches": 32,
        "epochs": 10,
        "learning_rate": 3e-4,
        "learning_rate_schedule": "linear",
        "clip_range": 0.2,
        "entropy_coef": 0.0,
        "value_coef": 0.5,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "hidden": (64, 64),
        "activation": "tanh",
        "trunk": "separate",
        "adam_epsilon": 1e-5,
        "max_grad_norm": 0.5,
        "clip_observations": 10.0,
        "clip_rewards": 10.0,
        "log_std_init": 0.0,
        "clip_value": True,
    }
    assert {name: getattr(config, name) for name in published} == published
    release = resolve({"env": "x", "arm": "ppo", "preset": "mujoco-release"})
    changed = {n for n in FIELDS if getattr(release, n) != getattr(config, n)}
    assert changed == {"preset", "epochs", "learning_rate_schedule"}
    assert (release.epochs, release.learning_rate_schedule) == (15, "constant")
    flagrun = resolve({"env": "x", "arm": "ppo", "preset": "flagrun"})
    changed = {n for n in FIELDS if getattr(flagrun, n) != getattr(config, n)}
    assert changed == {"preset", "envs", "rollout_steps", "minibatches", "epochs"}
    assert (flagrun.rollout_steps, flagrun.envs, flagrun.epochs) == (512, 32, 15)
    assert flagrun.rollout_steps * flagrun.envs // flagrun.minibatches == 4096
    atari = resolve({"env": "x", "arm": "ppo", "preset": "atari"})
    published = {
        "rollout_steps": 128,
        "envs": 8,
        "minibatches": 4,
        "epochs": 3,
        "learning_rate": 2.5e-4,
        "learning_rate_schedule": "linear",
        "clip_range": 0.1,
        "entropy_coef": 0.01,
        "value_coef": 1.0,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "trunk": "shared",
        "sign_rewards": True,
        "normalize_rewards": False,
        "clip_value": True,
    }
    assert {name: getattr(atari, name) for name in published} == published
    minatar = resolve({"env": "x", "arm": "ppo", "preset": "minatar"})
    published = {
        "rollout_steps": 128,
        "envs": 64,
        "minibatches": 8,
        "epochs": 4,
        "learning_rate": 5e-3,
        "learning_rate_schedule": "linear",
        "clip_range": 0.2,
        "entropy_coef": 0.01,
        "value_coef": 0.5,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "hidden": (64, 64),
        "activation": "relu",
        "trunk": "separate",
        "normalize_observations": False,
        "normalize_rewards": False,
        "sign_rewards": False,
    }
    assert {name: getattr(minatar, name) for name in published} == published
    assert set(PRESETS) - set(TASK_PRESETS) == {
        "mujoco",
        "mujoco-release",
        "flagrun",
        "atari",
        "minatar",
        "a2c",
        "a2c-atari",
        "a2c-mujoco",
    }


def test_arms_are_the_options_table() -> None:
    def options(arm: str) -> tuple:
        rate = {"drop_rate": 0.1} if arm == "random-drop" else {}
        c = resolve_run({"env": "x", "arm": arm, **rate}).arms[arm]
        return (
            c.filter,
            c.vex_coef,
            c.vex_target,
            c.history,
            c.decision,
            c.dropped,
            c.gae_over,
            c.truncation,
            c.budget,
        )

    corrected = ("all", "env", "replace", "all", "bootstrap", "env")
    assert options("ppo") == ("none", 0.0, "sample", *corrected)
    assert options("vex-head") == ("none", 0.5, "sample", *corrected)
    assert options("random-drop") == ("random-drop", 0.5, "sample", *corrected)
    assert options("sauna") == ("sauna", 0.5, "sample", *corrected)
    assert options("sauna-paper") == ("sauna", 0.5, "rollout", *corrected)
    quirks = ("kept", "joint", "replace", "kept", "terminate", "kept")
    assert options("sauna-reference") == ("sauna", 0.5, "minibatch", *quirks)
    assert {resolve({"env": "x", "arm": a}).threshold for a in ARMS if "sauna" in a} == {0.3}
