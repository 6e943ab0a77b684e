"""Each thing that can be wrong with an environment is named, with what mends it."""

from __future__ import annotations

import random
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces as gym

from sauna import cli
from sauna.config.plugins import name_of
from sauna.experiments.check.findings import WARNING, WRONG, check
from sauna.experiments.check.played import why_outside
from sauna.system.errors import BadInput
from vector_envs import Agents


class Good(gymnasium.Env):
    """A point that moves; its episodes end by themselves after 6 to 12 steps."""

    observation_space = gym.Box(-100, 100, (2,), np.float32)
    action_space = gym.Box(-1, 1, (1,), np.float32)
    reward = 1.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(6, 12))
        self.point = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.seen(), {}

    def seen(self) -> Any:
        return self.point.copy()

    def step(self, action: Any) -> Any:
        self.left -= 1
        self.point += np.float32(0.1) * np.asarray(action, np.float32)
        return self.seen(), self.reward * float(self.point[0]), self.left <= 0, False, {}


class Outside(Good):
    observation_space = gym.Box(-1, 1, (2,), np.float32)

    def seen(self) -> Any:
        return np.array([0, 3], np.float32) if self.left < 4 else 0 * self.point


class Wide(Good):
    observation_space = gym.Box(-100, 100, (2,), np.float32)

    def seen(self) -> Any:
        return self.point.astype(np.float64)


class Lawless(Good):
    """Its numbers are drawn from a generator that no seed reaches."""

    def step(self, action: Any) -> Any:
        self.point[1] = random.random()
        return super().step(action)


class Open(Good):
    action_space = gym.Box(-np.inf, np.inf, (1,), np.float32)


class Boundless(Good):
    """One number of three has no bounds."""

    observation_space = gym.Dict(
        {"point": gym.Box(np.array([-100, -np.inf], np.float32), 100), "time": gym.Box(0, 20, (1,))}
    )

    def seen(self) -> Any:
        return {"point": self.point.copy(), "time": np.array([self.left], np.float32)}


class Large(Good):
    reward = 1e5


class Silent(Good):
    reward = 0.0


class Infinite(Good):
    def step(self, action: Any) -> Any:
        return (*super().step(action)[:1], float("nan"), self.left <= 0, False, {})


class Endless(Good):
    def step(self, action: Any) -> Any:
        observation, reward, *_ = super().step(action)
        return observation, reward, False, False, {}


class Clocked(Good):
    """Its time limit is reported as a termination."""

    def reset(self, **given: Any) -> Any:
        answer = super().reset(**given)
        self.left = 5
        return answer


class Mixed(Good):
    """It fails at a step of its own, or its time limit is reported as a termination."""

    def reset(self, **given: Any) -> Any:
        answer = super().reset(**given)
        self.left = int(min(self.np_random.integers(5, 40), 20))
        return answer


class Varied(Good):
    """Its episodes have any length below a bound."""

    def reset(self, **given: Any) -> Any:
        answer = super().reset(**given)
        self.left = int(self.np_random.integers(5, 20))
        return answer


class Raising(Good):
    def step(self, action: Any) -> Any:
        raise ZeroDivisionError("of mine")


class Text(Good):
    observation_space = gym.Text(5)

    def seen(self) -> Any:
        return "a"


def found(env: type, steps: int = 60) -> list[tuple[str, str]]:
    return [(kind, text) for kind, text, _ in check(name_of(env), {}, steps).findings]


def test_nothing_is_wrong_with_a_good_one() -> None:
    result = check(name_of(Good), "{}", 60)
    assert result.findings == []
    assert (
        "60 steps with random actions" in result.facts[2]
        and "no time limit is registered" in result.facts[3]
    )


@pytest.mark.parametrize(
    "env, kind, text",
    [
        (Outside, WRONG, "the observation is 3 at [1], not between -1 and 1"),
        (Wide, WRONG, "is of type float64, and its space of float32"),
        (Lawless, WRONG, "does not repeat itself: observations differ at step 1"),
        (Open, WARNING, "1 of 1 action components have no bounds"),
        (Large, WARNING, "rewards are large"),
        (Silent, WARNING, "no reward was seen"),
        (Infinite, WRONG, "are NaN or infinite"),
        (Endless, WARNING, "no episode ended in 60 steps, and there is no time limit"),
        (Clocked, WARNING, "all episodes end as terminated after 5 steps"),
        (Raising, WRONG, "it cannot be played: ZeroDivisionError: of mine"),
        (Text, WRONG, "Text is not supported"),
    ],
)
def test_what_is_wrong_is_named(env: type, kind: str, text: str) -> None:
    findings = found(env)
    assert [k for k, said in findings if text in said] == [kind], findings
    assert findings == sorted(findings, key=lambda finding: finding[0] != WRONG)


def test_observations_without_bounds_are_a_note_on_what_a_training_does() -> None:
    result = check(name_of(Boundless), {}, 60)
    note = "1 of 3 numbers observed have no bounds: a training normalises them by what it has seen"
    assert note in result.facts and result.findings == []
    (said,) = [fact for fact in check("CartPole-v1", {}, 60).facts if "no bounds" in fact]
    assert said.startswith("2 of 4 numbers") and "preset cartpole takes them as they are" in said
    assert not [fact for fact in check(name_of(Good), {}, 60).facts if "no bounds" in fact]


@pytest.mark.parametrize("steps", [100, 300, 2000])
def test_a_limit_behind_real_failures_is_told_from_lengths_that_vary(steps: int) -> None:
    assert [text for _, text in found(Mixed, steps) if "after exactly 20 steps" in text]
    assert not [text for _, text in found(Varied, steps) if "time limit" in text]


class Choosy(Good):
    """It takes valid actions alone."""

    action_space = gym.Discrete(3)

    def action_masks(self) -> Any:
        return np.arange(3) != self.left % 3

    def step(self, action: Any) -> Any:
        assert self.action_masks()[action]
        return super().step(action)


@pytest.mark.parametrize("env", [name_of(Choosy), "make_vec/CartPole-v1", name_of(Agents)])
def test_masks_rows_and_agents_are_played_as_they_take_it(env: str) -> None:
    assert [text for kind, text, _ in check(env, {}, 60).findings if kind == WRONG] == []


def test_gymnasiums_checker_is_asked() -> None:
    class Seedless(Good):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            answer = super().reset(seed=3)  # the same episode for every seed
            self._np_random = np.random.default_rng()
            return answer

    assert any("np_random" in text or "seed" in text for _, text in found(Seedless))


def test_the_part_that_is_outside_is_named() -> None:
    space = gym.Dict({"a": gym.Tuple([gym.Discrete(2), gym.Box(0, 1, (2,))])})
    one = {"a": (1, np.array([0.5, 0.5], np.float32))}
    assert "['a'][0] is 5" in why_outside(space, {"a": (5, one["a"][1])}, "it")
    assert "['a'][1] is of shape (3,)" in why_outside(space, {"a": (1, np.zeros(3))}, "it")
    assert why_outside(space, {}, "it") == "it has no 'a'"


def test_the_command_says_it_and_exits_with_one(capsys: pytest.CaptureFixture) -> None:
    cli.main(["check", "CartPole-v1", "--steps", "50"])
    assert capsys.readouterr().out.endswith("nothing is wrong\n")
    with pytest.raises(SystemExit) as exit:
        cli.main(["check", name_of(Outside), "--steps", "20"])
    said = capsys.readouterr()
    assert exit.value.code == 1 and "  fix: widen the space" in said.out and "wrong" in said.err
    with pytest.raises(SystemExit) as exit:
        cli.main(["check", "CartPol-v1"])
    assert exit.value.code == 2 and "CartPole-v1" in capsys.readouterr().err
    with pytest.raises(BadInput, match="env_kwargs"):
        check("CartPole-v1", "[1]", 5)
