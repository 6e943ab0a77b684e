"""Which environment and checkpoint an evaluation plays, for how long, and what it records."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

import sauna
import small_envs
from command_line import sauna as sauna_process
from faults.hostile_runs import change_manifest
from helpers import SMALL
from sauna import cli
from sauna.config.plugins import name_of
from sauna.experiments.evaluate import episodes, play
from sauna.experiments.evaluate.episodes import VideoFailure, kwargs_of
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.evaluate.video import check_drawn, frame, frames_per_second, video
from sauna.system import run_directory
from sauna.system.checkpoint import numbered
from sauna.system.errors import BadInput, SaunaError
from sauna.training.artifact import load_artifact

SETTINGS = {**SMALL, "processes": 1, "arm": "ppo", "steps": 96}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Of an environment with an argument, and three kept checkpoints."""
    path = tmp_path_factory.mktemp("evaluated") / "run"
    kept = {"checkpoint_every": 1, "keep_checkpoints": 3, "eval_every": 32, "eval_episodes": 1}
    kwargs = {"first": 1000, "step": 2}  # no number is bad before episode 1000
    sauna.train(
        "small_envs:NotANumber", quiet=True, out=path, env_kwargs=kwargs, **SETTINGS, **kept
    )
    return path


@pytest.fixture(scope="module")
def endless(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("endless") / "run"
    sauna.train("small_envs:Never", quiet=True, out=path, **SETTINGS)
    return path


def test_the_runs_own_arguments_stay_and_can_be_changed(run: Path) -> None:
    artifact = load_artifact(run)
    own = {"first": 1000, "step": 2}
    assert (
        kwargs_of(artifact, None, None) == kwargs_of(artifact, "small_envs:NotANumber", None) == own
    )
    assert kwargs_of(artifact, "small_envs:NotANumber", {"step": 5}) == {"first": 1000, "step": 5}
    assert kwargs_of(artifact, None, '{"step": 5}') == {"first": 1000, "step": 5}
    assert kwargs_of(artifact, "small_envs:Scripted", None) == {}
    with pytest.raises(BadInput, match="env_kwargs: cannot read"):
        kwargs_of(artifact, None, "[1]")


def test_the_same_environment_by_name_plays_the_same_episodes(run: Path, capsys) -> None:
    plain = sauna.evaluate(run, episodes=2)
    named = sauna.evaluate(run, episodes=2, env="small_envs:NotANumber")
    assert named["members"] == plain["members"]
    arguments = ["eval", str(run), "--episodes", "2", "--env-kwargs", '{"speed": 3}']
    with pytest.raises(SystemExit) as exit:
        cli.main(arguments)
    assert exit.value.code == 2 and "cannot be made" in capsys.readouterr().err


def test_any_kept_checkpoint_can_be_played_and_loaded(run: Path, capsys) -> None:
    before = run_directory.read_config_file(run / "evaluation_sampled.json")
    first = sauna.evaluate(run, episodes=2, checkpoint="1")
    for bad in ("x", -1, 1.5):
        with pytest.raises(BadInput, match="checkpoint: must be a whole number of at least 0"):
            sauna.load(run, checkpoint=bad)
    assert first["iteration"] == 1 and before["iteration"] == 3
    assert first["members"] != before["members"]
    assert run_directory.read_config_file(run / "evaluation_sampled.json") == before
    for number in (1, 2):
        expected = TrainedPolicy(load_artifact(run, iteration=number))
        got = sauna.load(run, checkpoint=number)
        np.testing.assert_array_equal(got(np.ones(3)), expected(np.ones(3)))
    with pytest.raises(BadInput, match=r"keeps none of iteration 9 \(it has: 1, 2, 3\)"):
        sauna.load(run, checkpoint=9)
    cli.main(["eval", str(run), "--episodes", "1", "--checkpoint", "2"])
    assert "checkpoint of iteration 2" in capsys.readouterr().out


def test_a_batch_gives_the_actions_of_its_observations(run: Path) -> None:
    policy = sauna.load(run)
    many = np.linspace(-1, 1, 12).reshape(4, 3)
    np.testing.assert_allclose(policy(many), [policy(one) for one in many], rtol=1e-6)
    action, state = policy.predict(many[0], deterministic=True)
    assert state is None
    np.testing.assert_array_equal(action, policy(many[0]))
    drawn = [policy.predict(many)[0] for _ in range(2)]
    assert drawn[0].shape == policy(many).shape and not np.array_equal(*drawn)
    again = sauna.load(run)
    again.predict(many[0], deterministic=True)  # counts as a call
    np.testing.assert_array_equal(again.predict(many)[0], drawn[0])
    for wrong in (np.ones(4), np.ones((1, 20)), {"goal": np.ones(3)}, np.ones((0, 3))):
        with pytest.raises(BadInput, match=r"expected \(3,\), one observation or a batch|is empty"):
            policy(wrong)


def test_the_best_policy_is_that_of_the_best_evaluation(run: Path, endless: Path, capsys) -> None:
    """Which is the checkpoint after it, as there is one after every iteration here."""
    evaluations = {row["iteration"]: row["eval_return_mean"] for row in run_directory.rows(run)}
    best = max(evaluations, key=lambda iteration: evaluations[iteration])
    played = sauna.evaluate(run, episodes=2, best=True)
    assert played["members"] == sauna.evaluate(run, episodes=2, checkpoint=best + 1)["members"]
    assert played["best"] == {"ppo/0": 32 * (best + 1)}
    assert (run / "evaluation_best_sampled.json").exists()
    expected = sauna.load(run, checkpoint=best + 1)(np.ones(3))
    np.testing.assert_array_equal(sauna.load(run, best=True)(np.ones(3)), expected)
    cli.main(["eval", str(run), "--episodes", "1", "--best"])
    assert f"ppo/0 (best, after {32 * (best + 1)} env steps)" in capsys.readouterr().out
    with pytest.raises(BadInput, match="best: ppo/0 was not evaluated during training"):
        sauna.load(endless, best=True)


def test_an_episode_without_an_end_is_cut_and_that_is_said(endless: Path, capsys) -> None:
    said: list[str] = []
    result = sauna.evaluate(endless, episodes=2, max_steps=40, say=said.append)
    assert result["members"]["ppo/0"]["lengths"] == [40, 40]
    assert said == ["ppo/0: 2 of 2 episodes were cut after 40 steps"]
    cli.main(["eval", str(endless), "--episodes", "1", "--max-steps", "7"])
    assert "length 7.0" in capsys.readouterr().out
    page = sauna.inspect(endless, episodes=2, max_steps=30, frames=False)
    assert page.stat().st_size > 10_000


def test_a_long_evaluation_says_how_far_it_is(endless: Path, monkeypatch) -> None:
    monkeypatch.setattr(play, "QUIET", 0.0)
    said: list[str] = []
    sauna.evaluate(endless, episodes=2, max_steps=3, say=said.append)
    assert "ppo/0: episode 2 of 2, 3 env steps" in said


def test_frames_of_odd_sides_and_without_a_rate_become_a_video(endless: Path) -> None:
    """41 x 45 pixels; the frame of step t is as bright as t."""
    result = sauna.evaluate(endless, episodes=1, max_steps=9, video=True, checkpoint=3)
    frames = imageio.imread(result["video"])
    assert frames.shape == (10, 42, 46, 3) and result["video"].endswith("ppo-0_sampled_3.mp4")
    np.testing.assert_allclose(frames.mean((1, 2, 3)), np.arange(10) * 20, atol=8)
    assert [path.name for path in (endless / "videos").iterdir()] == ["ppo-0_sampled_3.mp4"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Hopper-v5", "CartPole-v1"])
def test_a_policy_of_the_zoo_plays_at_once_and_is_recorded(name: str, tmp_path: Path) -> None:
    arguments = ["--video", "--episodes", "2", "--max-steps", "60"]
    done = sauna_process("eval", f"zoo:{name}", *arguments, cwd=tmp_path)
    if "cannot be drawn here" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    path = Path(done.stdout.splitlines()[-1].removeprefix("video: "))
    assert path.parent == tmp_path / "runs" / f"zoo-{name}" / "videos"
    frames = imageio.imread(path).astype(int)
    assert len(frames) == 61 and frames[0].std() > 1  # the policy stands for 60 steps
    assert np.abs(frames[0] - frames[-1]).max() > 50  # and moves


def test_frames_go_to_the_encoder_one_by_one(tmp_path: Path, monkeypatch) -> None:
    """It has each of them before the next one is drawn."""
    seen: list[int] = []

    class Encoder(contextlib.nullcontext):
        def append_data(self, picture: np.ndarray) -> None:
            seen.append(int(picture[0, 0, 0]))

    monkeypatch.setattr("imageio.v2.get_writer", lambda path, **chosen: Encoder())
    with video(tmp_path / "a.mp4", 30.0) as add:
        for k in range(5):
            add(np.full((4, 4, 3), k, np.uint8))
            assert seen == [*range(k + 1)]


def test_a_failing_video_keeps_the_returns(endless: Path, capsys) -> None:
    arguments = {"env_kwargs": {"breaks": 4}, "max_steps": 9, "episodes": 3}
    with pytest.raises(VideoFailure, match="the lamp is broken") as failure:
        sauna.evaluate(endless, video=True, **arguments)
    assert failure.value.result["members"]["ppo/0"]["lengths"] == [9, 9, 9]
    flags = ["--episodes", "3", "--max-steps", "9", "--video", "--env-kwargs", '{"breaks": 4}']
    with pytest.raises(SystemExit) as exit:
        cli.main(["eval", str(endless), *flags])
    printed = capsys.readouterr()
    assert exit.value.code == 1 and "the lamp is broken" in printed.err
    assert "ppo/0: return" in printed.out and "3 episodes" in printed.out
    assert not list((endless / "videos").glob("*part*"))


def test_render_mode_and_size_among_the_arguments_can_be_filmed(endless: Path) -> None:
    arguments = {"env_kwargs": {"render_mode": None, "size": 33}, "max_steps": 3, "episodes": 1}
    result = sauna.evaluate(endless, video=True, **arguments)
    assert imageio.imread(result["video"]).shape == (4, 34, 38, 3)


def test_what_has_pictures() -> None:
    check_drawn("small_envs:Never", {})
    check_drawn("small_envs:Never", {"breaks": 1})  # whether it can be drawn is another question
    without_render = name_of(lambda **kwargs: small_envs.Scripted())
    for env in ("small_envs:Scripted", "jax_envs:make_walk", without_render):
        with pytest.raises(BadInput, match=r"takes render_mode='rgb_array' and has render\(\)"):
            check_drawn(env, {})


@pytest.mark.parametrize("rate", [None, 0, "fast", float("nan"), -3])
def test_a_rate_that_is_none_is_thirty(rate) -> None:
    env = small_envs.Never()
    env.metadata = {"render_fps": rate}
    assert frames_per_second(env) == 30.0
    env.metadata = None
    assert frames_per_second(env) == 30.0


def test_what_is_no_picture_is_refused() -> None:
    assert frame(np.zeros((3, 4), np.uint8)).shape == (4, 4, 3)
    for drawn in (None, np.zeros((4, 4, 3)), np.zeros((4, 4, 2), np.uint8), [np.zeros((4, 4, 3))]):
        with pytest.raises(SaunaError, match="video: the environment"):
            frame(drawn)


def test_stretched_actions_are_played_as_they_were_trained(tmp_path: Path) -> None:
    """The mode of an untrained policy is about 0: the middle of [0, 1000]."""
    lengths = {}
    for stretched in (True, False):
        out = tmp_path / str(stretched)
        run = sauna.train(
            "small_envs:Wide", quiet=True, out=out, rescale_actions=stretched, **SETTINGS
        )
        assert run_directory.read_config(run.path)["config"]["rescale_actions"] is stretched
        lengths[stretched] = float(run.policy()(np.zeros(1))[0])
    assert 300 < lengths[True] < 700 and lengths[False] < 5


def test_a_run_of_parts_is_trained_and_played(tmp_path: Path) -> None:
    run = sauna.train("small_envs:Parts", quiet=True, out=tmp_path / "run", **SETTINGS)
    assert run_directory.read_config(run.path)["spaces"][:2] == ["vector", [9]]
    assert sauna.evaluate(run.path, episodes=1)["members"]["ppo/0"]["lengths"] == [4]
    assert episodes.MAX_STEPS == 30_000


@pytest.mark.parametrize("members", [[], ["ppo/0", "ppo/0"]])
def test_a_run_whose_members_were_tampered_with_is_refused(
    members: list[str], endless: Path, tmp_path: Path, capsys
) -> None:
    """Not evaluated to nothing, with exit 0."""
    run = tmp_path / "run"
    shutil.copytree(endless, run)
    for path in numbered(run / "checkpoints"):
        change_manifest(run, lambda manifest: {**manifest, "members": members}, path.name)
    for command in ("eval", "inspect"):
        with pytest.raises(SystemExit) as exit:
            cli.main([command, str(run), "--episodes", "1", "--max-steps", "3"])
        said = capsys.readouterr().err
        assert exit.value.code == 1 and said.endswith("its members are not named, each once\n")
