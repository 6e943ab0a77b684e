"""What names an environment: each way works, or is refused with what to write instead."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import sauna
import small_envs
from helpers import SMALL, environment
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.envs.host.mujoco_envs import MujocoEnvs
from sauna.envs.make import env_maker, in_process_envs, known_in_this_process_alone, make_env
from sauna.envs.probe import probe
from sauna.system import run_directory
from sauna.system.errors import BadInput


@pytest.mark.parametrize("prefix", ["", "ale_py:", "gymnasium:"])
def test_a_game_is_one_environment_by_all_of_its_names(prefix: str) -> None:
    env = make_env(f"{prefix}ALE/Breakout-v5", {})
    assert env.observation_space.shape == (4, 84, 84)
    env.close()
    envs = in_process_envs(f"{prefix}ALE/Pong-v5", {}, [(0, 0)], "auto")
    assert type(envs).__name__ == "AtariEnvs"
    envs.close()


@pytest.mark.parametrize(
    "env, answer",
    [
        ("BreakoutNoFrameskip-v4", "ALE/Breakout-v5"),
        ("Breakout-v5", "ALE/Breakout-v5"),
        ("MsPacmanDeterministic-v0", "ALE/MsPacman-v5"),
        ("ale_py:Pong-v4", "ALE/Pong-v5"),
        ("Seaquest-ram-v4", "ALE/Seaquest-v5"),
    ],
)
def test_other_names_of_a_game_are_answered_with_the_right_one(env: str, answer: str) -> None:
    with pytest.raises(BadInput, match=f"write {answer}"):
        env_maker(env, {})


def test_ids_that_only_look_like_a_games_are_left_alone() -> None:
    assert make_env("CartPole-v1", {}).unwrapped.spec.id == "CartPole-v1"
    with pytest.raises(BadInput, match="unknown environment 'Breakin-v5'"):
        env_maker("Breakin-v5", {})


OWN = """
import gymnasium, small_envs
gymnasium.register("OwnScripted-v3", entry_point="small_envs:Scripted")
class Mine(small_envs.Scripted):
    pass
"""


@pytest.mark.parametrize(
    "name, words",
    [
        ("own_envs:Mine", None),
        ("own_envs:OwnScripted-v3", None),
        ("own_envs.py:Mine", "own_envs.py is a file; write the module: own_envs:Mine"),
        ("own_envs.py:OwnScripted-v3", "write the module: own_envs:OwnScripted-v3"),
        ("./own_envs.py:Mine", "write the module: own_envs:Mine"),
        ("a/b.py:Mine", "write the module: a.b:Mine"),
        ("/a/b.py:Mine", "in the folder /a, write the module: b:Mine"),
    ],
)
def test_modules_of_the_working_directory(name: str, words: str | None, tmp_path: Path) -> None:
    """In a process whose path does not begin with it, as of the command `sauna`."""
    (tmp_path / "own_envs.py").write_text(OWN)
    code = (
        "import sys; sys.path = [p for p in sys.path if p]\n"
        "from sauna.envs.probe import probe\n"
        "from sauna.system.errors import BadInput\n"
        f"try: print(probe({name!r}, {{}}).differs)\n"
        "except BadInput as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**environment(), "PYTHONSAFEPATH": "1"},
    )
    assert (words or "None") in done.stdout, done.stderr


@pytest.mark.parametrize(
    "env, words",
    [
        ("small_envs:INSTANCE", "is an environment already; give what makes one"),
        ("small_envs:make_vector", "gives a vector of environments; .* as envs"),
        ("small_envs:itertools", "is a module, and makes no environment"),
    ],
)
def test_what_makes_no_single_environment_is_refused_with_what_to_write(env, words) -> None:
    with pytest.raises(BadInput, match=words):
        probe(env, {})


def test_values_that_make_no_single_environment_are_refused(tmp_path: Path) -> None:
    for value, words in (
        (small_envs.Scripted(), "what was passed is an environment already"),
        (gymnasium.make("CartPole-v1"), "what was passed is an environment already"),
        (gymnasium.make_vec("CartPole-v1", num_envs=2), "is an environment already"),
        (lambda: gymnasium.make_vec("CartPole-v1", num_envs=2), "gives a vector"),
        (gymnasium.spec("CartPole-v1"), "makes no environment"),
    ):
        with pytest.raises(BadInput, match=words):
            sauna.train(value, quiet=True, out=tmp_path / "run", **SMALL)
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["ShortPole-v0", "mine/ShortPole-v0"])
def test_an_id_that_this_program_registered_trains_in_it(name: str, tmp_path: Path) -> None:
    """Also one whose class another process would find: its time limit is here alone."""
    entry = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"
    gymnasium.register(name, entry_point=entry, max_episode_steps=3)
    try:
        assert known_in_this_process_alone(name)
        assert not known_in_this_process_alone("CartPole-v1")
        run = sauna.train(name, quiet=True, out=tmp_path / "run", **SMALL)
        lengths = [n for row in run.metrics for n in row["episode_lengths"]]
        assert lengths and set(lengths) == {3}
        with pytest.raises(BadInput, match="other processes cannot import it"):
            sauna.compare(name, out=tmp_path / "compared")
    finally:
        del gymnasium.registry[name]


def test_render_mode_among_the_arguments_gives_way() -> None:
    made = make_env("small_envs:Never", {"render_mode": "human"}, render_mode="rgb_array")
    assert made.render_mode == "rgb_array"
    made = make_env("CartPole-v1", {"render_mode": None}, render_mode="rgb_array")
    assert made.unwrapped.render_mode == "rgb_array"


def test_mujoco_is_stepped_fast_unless_its_actions_are_stretched() -> None:
    """Humanoid's box is [-0.4, 0.4]; HalfCheetah's is [-1, 1], where stretching changes nothing."""
    name = "InvertedPendulum-v5"
    fast = in_process_envs(name, {}, [(0, 0)], "auto")
    slow = in_process_envs(name, {}, [(0, 0)], "auto", True)
    assert type(fast) is MujocoEnvs and type(slow) is GymnasiumEnvs
    assert type(in_process_envs("HalfCheetah-v5", {}, [(0, 0)], "auto", True)) is MujocoEnvs
    np.testing.assert_array_equal(fast.reset(), slow.reset())
    action, everyone = np.array([[1 / 3]], np.float32), np.ones(1, bool)
    one = np.array(fast.step(3 * action, everyone).observation)
    np.testing.assert_allclose(slow.step(action, everyone).observation, one, rtol=1e-5)


def test_a_close_that_raises_does_not_lose_a_training(tmp_path: Path) -> None:
    for processes in (0, 1):
        out = tmp_path / f"run{processes}"
        settings = {**SMALL, "processes": 1, "env_processes": processes}
        run = sauna.train("small_envs:Unclosable", quiet=True, out=out, **settings)
        assert run_directory.is_complete(run.path)
        assert sum(row["env_steps"] for row in run.metrics) >= 96


FLAGRUN = "sauna/HumanoidFlagrunHarder-v0"
MAKE = "print(type(gymnasium.make({!r}).unwrapped).__name__)"


@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium; " + MAKE.format(f"sauna:{FLAGRUN}"),
        "import gymnasium, sauna; " + MAKE.format(FLAGRUN),
        "import sauna, gymnasium; " + MAKE.format(FLAGRUN),
        "import sauna, gymnasium; " + MAKE.format(f"sauna:{FLAGRUN}"),
        # Looking for a package is not importing it; an import of a part is.
        "import sauna, importlib.util; importlib.util.find_spec('gymnasium'); "
        "import gymnasium.spaces; import gymnasium; " + MAKE.format(FLAGRUN),
    ],
)
def test_flagrun_is_known_to_any_program_in_any_order_of_imports(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "HumanoidFlagrunHarder", done.stderr


def test_registering_costs_nothing_without_gymnasium() -> None:
    code = (
        "import sys, sauna; print([m for m in ('gymnasium', 'jax', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_the_finder_is_there_once_and_goes_when_gymnasium_came() -> None:
    code = (
        "import sys, sauna; from sauna.envs.registration import register; register(); "
        "count = lambda: sum(type(f).__name__ == '_AfterGymnasium' for f in sys.meta_path); "
        "before = count(); import gymnasium; print(before, count())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["1", "0"], done.stderr
