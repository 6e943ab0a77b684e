"""Members that start as clones of recorded episodes: `--init-from data:FILE | data:minari:NAME`.

They are made before the run is, and are its `init/`: a resume needs the data no more.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sauna.config.presets import Member
from sauna.config.readers import DATA
from sauna.config.settings import Config
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.envs.wrapping import wrapping_of
from sauna.system.errors import BadInput
from sauna.system.jax_setup import configure_jax
from sauna.training.data.episodes import MINARI, Demonstrations, demonstrations
from sauna.training.data.minari_sets import read_minari
from sauna.training.data.parquet import read_parquet
from sauna.training.prepare import Prepared

if TYPE_CHECKING:
    from sauna.algorithm.learner.cloning import Cloner, Rows
    from sauna.algorithm.policy.normalize import Moments
    from sauna.algorithm.policy.policy import Policy

HELD_OUT = 10  # one episode of so many is not trained on
# What a clone depends on beside the data and the network: members with equal values share one.
READ = ("gamma", "sign_rewards", "truncation", "value_coef", "clip_rewards", "normalize_rewards")


class _Split(NamedTuple):
    """What a member is fitted to, and what it is measured on."""

    trained: Rows
    held: Rows
    rewards: Moments  # of the discounted return, as the run would have them by now


def is_data(init_from: str) -> bool:
    """Returns whether `init_from` names recorded episodes."""
    return init_from.startswith(DATA)


def clone_members(
    prepared: Prepared, say: Callable[[str], None]
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Fits each member of a new run to recorded episodes, and says how well.

    Returns:
      arrays, named as in a checkpoint of the new run, and where they come from.

    Raises:
      BadInput: the data cannot be read, do not fit, or would be of no use.
    """
    config = prepared.config
    name = config.init_from
    if config.init_normalizer == "fresh" and config.normalize_observations:
        raise BadInput("init_normalizer: fresh would show a clone what it was not fitted to")
    data = _read(prepared)
    configure_jax()
    from sauna.algorithm.learner.cloning import make_cloner
    from sauna.algorithm.policy.bounded import from_env
    from sauna.algorithm.policy.policy import make_policy

    policy = make_policy(config, prepared.spaces)
    moments = _moments(data, config, prepared.spaces.normalized)
    data = data._replace(action=from_env(policy.distribution, data.action))
    arrays: dict[str, np.ndarray] = {}
    figures: dict[str, Any] = {}
    made: dict[Any, Any] = {}
    cloner_of = cache(lambda value_coef: make_cloner(config, policy, value_coef))  # compiled once
    for member in prepared.members:
        key = (member.seed, *(getattr(member.config, field) for field in READ))
        if key not in made:
            split = _split(data, member.config, moments)
            made[key] = *_clone(member, policy, cloner_of(member.config.value_coef), split), split
        params, found, split = made[key]
        own = {**params, **_statistics(config, moments, split.rewards)}
        arrays |= {f"{member.name}/{part}": array for part, array in own.items()}
        figures[member.name] = found
        say(_line(member.name, name, data, found))
    origin = {
        "data": name,
        "sha256": data.digest,
        "episodes": len(data.length),
        "env_steps": len(data.reward),
        "members": figures,
    }
    return arrays, origin


def _read(prepared: Prepared) -> Demonstrations:
    config, spaces = prepared.config, prepared.spaces
    name, text = config.init_from, config.init_from.removeprefix(DATA)
    if text.startswith(MINARI):
        episodes = read_minari(text, name, spaces, config.env)
    else:
        episodes = read_parquet(Path(text), name, spaces, config.env)
    made = make_env(config.env, json.loads(config.env_kwargs), wrapping_of(config))
    try:
        rescale = config.rescale_actions
        return demonstrations(episodes, spaces, made.action_space, rescale, name)
    finally:
        close(made)


def _moments(data: Demonstrations, config: Config, size: int) -> Moments | None:
    """Mean and variance of the observations' first `size` numbers; None if nothing is normalised.

    Pictures beside them have none.
    """
    from sauna.algorithm.policy.normalize import Moments

    if not config.normalize_observations:
        return None
    every = np.concatenate([data.observation, data.final])
    seen = every[:, :size].astype(np.float64)
    return Moments(seen.mean(0), seen.var(0), np.array([float(len(seen))]))


def _split(data: Demonstrations, config: Config, moments: Moments | None) -> _Split:
    from sauna.algorithm.learner.cloning import returns_to_go
    from sauna.algorithm.policy.normalize import normalize

    def seen(raw: np.ndarray) -> np.ndarray:
        if moments is None:
            return raw if raw.dtype == np.uint8 else raw.astype(np.float32)
        return normalize(moments, raw, config.clip_observations).astype(np.float32)

    reward, rewards = _rewards(data, config)
    bootstrap = ~data.terminated & (config.truncation == "bootstrap")
    returns, discount = returns_to_go(reward, data.length, bootstrap, config.gamma)
    observation, final = seen(data.observation), seen(data.final)
    is_held = np.arange(len(data.length)) % HELD_OUT == HELD_OUT - 1
    is_held[-1] |= not is_held.any()
    trained, held = (
        _rows(data, observation, final, returns, discount, chosen) for chosen in (~is_held, is_held)
    )
    return _Split(trained, held, rewards)


def _rows(
    data: Demonstrations,
    observation: np.ndarray,
    final: np.ndarray,
    returns: np.ndarray,
    discount: np.ndarray,
    chosen: np.ndarray,
) -> Rows:
    """The env steps of the `chosen` episodes `[E]`."""
    from sauna.algorithm.learner.cloning import Rows

    own = np.repeat(chosen, data.length)
    return Rows(
        observation[own],
        data.action[own],
        returns[own].astype(np.float32),
        discount[own].astype(np.float32),
        np.repeat(np.arange(chosen.sum()), data.length[chosen]).astype(np.int32),
        final[chosen],
    )


def _rewards(data: Demonstrations, config: Config) -> tuple[np.ndarray, Moments]:
    """The rewards as a learner gets them `[M]`, and the running moments that scale them."""
    from sauna.algorithm.policy.normalize import initial_moments, scale_rewards, update_moments
    from sauna.algorithm.rollout.moments import discounted_returns

    reward = np.sign(data.reward) if config.sign_rewards else data.reward
    ended = np.zeros(len(reward), bool)
    ended[np.cumsum(data.length) - 1] = True
    column, every = reward[:, None], np.ones((len(reward), 1), bool)
    sums, _ = discounted_returns(column, ended[:, None], every, np.zeros(1), config.gamma)
    moments = update_moments(initial_moments((), 1), sums, every[:, 0])
    if config.normalize_rewards:
        reward = scale_rewards(moments, reward[None], config.clip_rewards)[0]
    return reward, moments


def _statistics(config: Config, moments: Moments | None, rewards: Moments) -> dict[str, np.ndarray]:
    """The running statistics that a member goes on with, as `init_normalizer` says."""
    kept = {} if moments is None else {"observation_moments": moments}
    if config.init_normalizer == "kept" and config.normalize_rewards:
        kept["reward_moments"] = rewards
    return {
        f"{kind}/{part}": value
        for kind, one in kept.items()
        for part, value in one._asdict().items()
    }


def _clone(
    member: Member, policy: Policy, cloner: Cloner, split: _Split
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Fits one member; it takes the epoch after which what is held out was likeliest."""
    import jax

    from sauna.algorithm.learner.cloning import clone_order
    from sauna.algorithm.types import member_keys
    from sauna.training.loop.member_state import named_params

    trained, held = jax.device_put((split.trained, split.held))
    state = cloner.start(policy.init(member_keys(member.seed).init))
    before = best = _figures(cloner.fit(state.params, held))
    params, epoch, loss = state.params, 0, np.nan
    for i in range(1, member.config.clone_epochs + 1):
        order = clone_order(len(split.trained.action), member.seed, i)
        state, mean_loss = cloner.epoch(state, trained, order)
        fit = _figures(cloner.fit(state.params, held))
        if fit["log_likelihood"] > best["log_likelihood"]:
            params, best, epoch, loss = state.params, fit, i, float(mean_loss)
    if epoch == 0:
        raise BadInput(f"init_from: {member.name}: no epoch of cloning made held-out data likelier")
    named = {f"params/{part}": array for part, array in named_params(policy, params).items()}
    found = {
        "loss": loss,
        "epoch": epoch,
        "epochs": member.config.clone_epochs,
        "held_out_episodes": len(split.held.final),
        "held_out_steps": len(split.held.action),
        "held_out": best,
        "before": before,
    }
    return named, found


def _figures(fit: Any) -> dict[str, float]:
    return {name: float(value) for name, value in fit._asdict().items()}


def _line(member: str, name: str, data: Demonstrations, found: dict[str, Any]) -> str:
    """Says how well a member fits."""
    held, before = found["held_out"], found["before"]
    what = "accuracy" if data.action.dtype == np.int32 else "explained variance of actions"
    return (
        f"{member}: cloned {name} ({len(data.length):,} episodes, {len(data.reward):,} env steps): "
        f"epoch {found['epoch']} of {found['epochs']}, loss {found['loss']:.4f}; on "
        f"{found['held_out_episodes']} held-out episodes ({found['held_out_steps']:,} env steps): "
        f"log-likelihood {held['log_likelihood']:.3f} (before: {before['log_likelihood']:.3f}), "
        f"{what} {held['agreement']:.1%}, values off by {held['value_error']:.1%}"
    )
