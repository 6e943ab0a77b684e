"""What is wrong with an environment: Gymnasium's own checker, and what a training would meet."""

from __future__ import annotations

import json
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from sauna.config.presets import resolve
from sauna.config.settings import Config, parse
from sauna.config.zoo import AUTO, entry_of
from sauna.envs.host.answers import close
from sauna.envs.host.together import group_size
from sauna.envs.make import is_native, make_env
from sauna.envs.masked import MaskedEnv, mask_method
from sauna.envs.probe import probe
from sauna.envs.shapes import leaves
from sauna.envs.spaces import MAX_BOUND, describe
from sauna.envs.wrapping import PLAIN, Wrapping
from sauna.experiments.check.played import Played, play
from sauna.system.errors import BadInput, one_line

WRONG, WARNING = "wrong", "warning"
LARGE_REWARD = 100.0  # standard deviation of the rewards
SLOW = 200.0  # env steps per second
FIRST = "mend that first"
HELP = "see Gymnasium's page on environments of one's own"
FEW = 3  # episodes that say something about how they end
SHORT = 10  # steps; episodes below that may well end together by themselves
# What Gymnasium's checker says of matters that are looked at here, or are none for a training.
ELSEWHERE = ("is wrapped", "render", "infinity", "from the unwrapped", "symmetric and normalized")


class Finding(NamedTuple):
    """Something to mend, and how; `kind` is `wrong` or `warning`."""

    kind: str
    text: str
    fix: str


class Checked(NamedTuple):
    """What was found of an environment.

    Attributes:
      facts: lines on what it is.
      findings: the wrong things first.
    """

    facts: list[str]
    findings: list[Finding]


def check(env: str, env_kwargs: Mapping[str, Any] | str, steps: int) -> Checked:
    """Looks for what is wrong with an environment.

    Args:
      steps: that are played with random actions.

    Raises:
      BadInput: there is no such environment, or it cannot be made.
    """
    kwargs = json.loads(parse("env_kwargs", env_kwargs))
    made = make_env(env, kwargs)
    facts = [f"observations: {made.observation_space}", f"actions: {made.action_space}"]
    try:
        facts += _without_bounds(env, made.observation_space)
        findings = list(_of_spaces(made))
        played, wrapping = _with_masks(made)
        if not is_native(env, kwargs) and group_size(made) is None and played is made:
            findings += _of_gymnasium(made)  # which knows no masks and no rows
        findings += _of_playing(played, steps, facts)
        if group_size(made) is None and not any(finding.fix == FIRST for finding in findings):
            findings += _of_repeating(env, kwargs, wrapping)
    finally:
        close(made)
    return Checked(facts, sorted(findings, key=lambda finding: finding.kind != WRONG))


def _without_bounds(env: str, space: Any) -> list[str]:
    """Says what a training does about observations without bounds."""
    from gymnasium import spaces as gym

    boxes = [part for _, part in leaves(space) if isinstance(part, gym.Box)]
    open_ = sum(int(_open(box).sum()) for box in boxes)
    if not open_:
        return []
    config = resolve({"env": env, "preset": AUTO if entry_of(env) else Config.preset})
    said = f"{open_} of {sum(box.low.size for box in boxes)} numbers observed have no bounds"
    if config.normalize_observations:
        return [f"{said}: a training normalises them by what it has seen"]
    return [
        f"{said}, and preset {config.preset} takes them as they are; if they grow large, give "
        "--normalize-observations"
    ]


def _open(box: Any) -> np.ndarray:
    """Which components of a Box lack a bound."""
    return ~((box.low > -MAX_BOUND) & (box.high < MAX_BOUND))


def _with_masks(env: Any) -> tuple[Any, Wrapping]:
    """The environment as a training with masks plays it, if it has the method for them."""
    if group_size(env) is not None or mask_method(env) is None:
        return env, PLAIN
    return MaskedEnv(env), Wrapping(action_mask=True)


def _of_spaces(env: Any) -> Iterator[Finding]:
    from gymnasium import spaces as gym

    try:
        describe(env.observation_space, env.action_space)
    except BadInput as error:
        yield Finding(WRONG, str(error), FIRST)
    action = env.action_space
    if isinstance(action, gym.Box):
        open_ = _open(action)
        if open_.any():
            yield Finding(
                WARNING,
                f"{int(open_.sum())} of {open_.size} action components have no bounds: nothing is "
                f"clipped, and actions begin with a standard deviation of 1",
                "give the action Box its bounds, best -1 and 1, and scale in step()",
            )


def _of_gymnasium(env: Any) -> Iterator[Finding]:
    """What Gymnasium's checker says."""
    from gymnasium.utils.env_checker import check_env

    inner = getattr(env, "unwrapped", env)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            check_env(inner, skip_render_check=True, skip_close_check=True)
        except Exception as error:  # of assertions, and of the environment itself
            text = _plain(one_line(error).removeprefix("AssertionError: "))
            if "Deterministic" not in text:  # which is tried here as well
                yield Finding(WRONG, text, HELP)
    for text in dict.fromkeys(_plain(str(warning.message)) for warning in said):
        if not any(part in text for part in ELSEWHERE):
            yield Finding(WARNING, text, HELP)


def _plain(text: str) -> str:
    """A text without colours and without Gymnasium's prefix."""
    text = re.sub(r"\x1b\[\d+m", "", text).removeprefix("WARN: ")
    return " ".join(text.split())


def _of_playing(env: Any, steps: int, facts: list[str]) -> Iterator[Finding]:
    """What some steps show; adds what they say of the environment to `facts`."""
    try:
        seen = play(env, steps)
    except Exception as error:  # whatever a user's environment raises
        yield Finding(WRONG, f"it cannot be played: {one_line(error)}", FIRST)
        return
    facts += _facts(env, seen)
    for look in (_observations, _rewards, _ends, _speed):
        yield from look(env, seen)


def _facts(env: Any, seen: Played) -> list[str]:
    ended = f"{len(seen.lengths)} episodes ended"
    if seen.lengths:
        ended += f" after {min(seen.lengths)} to {max(seen.lengths)} steps"
    reward = f"{np.mean(seen.rewards):g} +- {np.std(seen.rewards):g}"
    rate = seen.steps / max(seen.seconds, 1e-9)
    steps = _limit(env)
    limit = f"time limit of {steps} steps" if steps else "no time limit is registered"
    return [
        f"{seen.steps:,} steps with random actions: {ended}; reward {reward} a step",
        f"{rate:,.0f} steps per second in one process; {limit}",
    ]


def _limit(env: Any) -> int | None:
    return getattr(getattr(env, "spec", None), "max_episode_steps", None)


def _observations(env: Any, seen: Played) -> Iterator[Finding]:
    if seen.outside:
        yield Finding(
            WRONG,
            f"{seen.outside} observations are outside their space: {seen.outside_text}",
            "widen the space, or clip, cast or reshape the observation",
        )
    if seen.not_finite:
        yield Finding(
            WRONG,
            f"{seen.not_finite} observations or rewards are NaN or infinite",
            "end the episode (terminated=True) before a number leaves what can be computed with",
        )


def _rewards(env: Any, seen: Played) -> Iterator[Finding]:
    rewards = np.asarray(seen.rewards)
    rewards = rewards[np.isfinite(rewards)]
    if len(rewards) and not rewards.any():
        yield Finding(
            WARNING,
            "no reward was seen: random actions find none",
            "reward what leads to the goal, or expect a long training; --entropy-coef explores",
        )
    if len(rewards) and rewards.std() > LARGE_REWARD:
        yield Finding(
            WARNING,
            f"rewards are large, with a standard deviation of {rewards.std():g}",
            "leave --normalize-rewards on, or divide them",
        )


def _ends(env: Any, seen: Played) -> Iterator[Finding]:
    if not seen.lengths and not _limit(env):
        yield Finding(
            WARNING,
            f"no episode ended in {seen.steps:,} steps, and there is no time limit",
            "register it with max_episode_steps, or wrap it in gymnasium.wrappers.TimeLimit",
        )
    if text := _as_by_a_limit(seen):
        yield Finding(
            WARNING,
            f"{text}, as if by a time limit",
            "return truncated=True at a time limit: terminated says that nothing comes after it",
        )


def _as_by_a_limit(seen: Played) -> str:
    """Says which episodes end as terminated at one and the same length, the longest."""
    longest = max(seen.lengths, default=0)
    ends = [
        end for length, end in zip(seen.lengths, seen.terminated, strict=True) if length == longest
    ]
    if longest < 2 or len(ends) < FEW or not all(ends):
        return ""
    if len(ends) == len(seen.lengths):
        return f"all episodes end as terminated after {longest} steps"
    # Lengths that vary by themselves do not heap at the longest one.
    others = Counter(length for length in seen.lengths if longest / 2 < length < longest)
    if longest < SHORT or len(ends) < FEW * max(others.values(), default=1):
        return ""
    return (
        f"{len(ends)} of {len(seen.lengths)} episodes end as terminated after exactly {longest} "
        f"steps, and none is longer"
    )


def _speed(env: Any, seen: Played) -> Iterator[Finding]:
    rate = seen.steps / max(seen.seconds, 1e-9)
    if rate < SLOW:
        yield Finding(
            WARNING,
            f"{rate:.0f} steps per second: 10^6 steps take {1e6 / rate / 3600:.1f} hours",
            "find what is slow with python -m cProfile, or step it in parallel (--env-processes)",
        )


def _of_repeating(env: str, kwargs: dict[str, Any], wrapping: Wrapping) -> Iterator[Finding]:
    try:
        found = probe(env, kwargs, wrapping)
    except BadInput as error:
        yield Finding(WRONG, str(error), FIRST)
        return
    if found.differs:
        yield Finding(
            WRONG,
            f"it does not repeat itself: {found.differs}",
            "draw every random number from self.np_random, call super().reset(seed=seed) first, "
            "and set all of the state in reset()",
        )
