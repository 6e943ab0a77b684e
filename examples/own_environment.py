"""Train on an environment of your own.

    python examples/own_environment.py [--steps 100000]

Training happens in other processes, which import the environment by its name. So the class must be
importable: here it is in this file, and the file is named as a module.
"""

import argparse

import gymnasium
import numpy as np

import sauna


class Thermostat(gymnasium.Env):
    """Keep a room at 20 degrees. The action is the heating power."""

    observation_space = gymnasium.spaces.Box(-50.0, 50.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)  # makes self.np_random, which repeats itself for a seed
        self.degrees, self.steps = float(self.np_random.uniform(5, 35)), 0
        return self.seen(), {}

    def step(self, action):
        self.degrees += 3.0 * float(action[0]) - 0.1 * (self.degrees - 5.0)
        self.steps += 1
        reward = -abs(self.degrees - 20.0)
        late = self.steps == 100  # a time limit: truncated, not terminated
        return self.seen(), reward, False, late, {}

    def seen(self):
        return np.array([self.degrees - 20.0], np.float32)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    steps = parser.parse_args().steps

    # By name, as `sauna train own_environment:Thermostat` would in this folder.
    result = sauna.train("own_environment:Thermostat", arm="ppo", seeds=2, steps=steps)
    for name, row in result.summary.items():
        print(f"{name}: training return {row['return_mean']:.1f}, {row['env_steps']:,} env steps")
