"""The former name of `jax_envs`, which the stored runs of `faults/golden` hold."""

from jax_envs import *  # noqa: F403
