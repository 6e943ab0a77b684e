"""Train with a network of your own.

    python examples/own_network.py [--steps 100000]

A network is any flax module from observations `[..., obs]` to features `[..., F]`. The heads for
policy, value and Vex are added on top, on two copies of it (`trunk="separate"`) or on one
(`trunk="shared"`).
"""

import argparse

import flax.linen as nn

import sauna


class Residual(nn.Module):
    """Two layers with a connection around the second."""

    width: int = 64

    @nn.compact
    def __call__(self, observation):
        x = nn.tanh(nn.Dense(self.width)(observation))
        return x + nn.tanh(nn.Dense(self.width)(x))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    steps = parser.parse_args().steps
    result = sauna.train(
        "InvertedPendulum-v5", network="own_network:Residual", arm="ppo", steps=steps
    )
    print(result.summary)
