"""Train PPO on InvertedPendulum, evaluate the policy, and act with it.

python examples/train_and_evaluate.py [--steps 100000]
"""

import argparse

import gymnasium

import sauna

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=100_000)
steps = parser.parse_args().steps

# Three members: one for each seed. `out` may be left out; the run then gets a name with its time.
result = sauna.train("InvertedPendulum-v5", arm="ppo", seeds=3, steps=steps)

# Training returns are of sampled actions. This plays the most likely ones, in fresh episodes.
report = sauna.evaluate(result.path, episodes=5, deterministic=True)
for name, row in report["members"].items():
    print(f"{name}: deterministic evaluation {row['mean']:.1f} over {row['episodes']} episodes")

# A policy is a function of the raw observation. The normaliser is inside.
policy = result.policy(member=0)
env = gymnasium.make("InvertedPendulum-v5")
observation, _ = env.reset(seed=0)
print("first action:", policy(observation))
