"""The former name of `small_envs`, which the stored runs of `faults/golden` hold."""

from small_envs import *  # noqa: F403
