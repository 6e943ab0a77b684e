"""What the settings that name a part may be called."""

from __future__ import annotations

FILTERS = ("none", "sauna", "random-drop")
SAMPLERS = (
    "none",
    "gigaflow",
    "top-advantage",
    "prioritized",
    "gradient-norm",
    "kondo",
    "positive",
    "pods",
    "vex-oracle",
)
VEX_TARGETS = ("rollout", "minibatch", "episode", "sample")
DISTRIBUTIONS = ("gaussian", "squashed", "beta", "gsde")
BOUNDED = ("squashed", "beta")  # actions inside the bounds of their box by themselves
ACTIVATIONS = (
    "tanh",
    "relu",
    "elu",
    "gelu",
    "leaky_relu",
    "selu",
    "sigmoid",
    "silu",
    "swish",
)
NETWORKS = ("auto", "mlp", "nature-cnn", "small-cnn", "impala-cnn")
OPTIMIZERS = ("adam", "rmsprop", "adamw", "sgd", "lion", "nadam", "radam", "adabelief", "lamb")
SCHEDULES = ("constant", "linear", "cosine")
# Other trainers that `sauna bench --against` knows, and which of them are a script.
PEERS = ("sb3", "cleanrl", "rltools", "rl_games", "brax", "rejax", "purejaxrl")
PEER_SCRIPTS = {"cleanrl": "ppo_continuous_action.py", "purejaxrl": "ppo.py"}
# What `sauna list` can name.
LISTS = {
    "envs": "environments, with the preset, the env steps and RL Zoo's return of those it knows",
    "presets": "named settings of training, and what `sauna train ENV` takes",
    "arms": "what --arm takes: which rules a run trains with",
    "rules": "rules of sample selection: when each acts and how much it keeps",
    "filters": "what --filter takes",
    "targets": "what --vex-target takes",
    "studies": "comparisons that `sauna study` runs",
    "zoo": "trained policies that come with this package",
    "atari": "Atari games (extra [atari])",
    "gymnax": "environments of gymnax, on the device (extra [gymnax])",
    "playground": "environments of MuJoCo Playground, on the device (extra [playground])",
    "brax": "environments of Brax, on the device (extra [brax])",
    "mjx": "environments of MJX, on the device (extra [mjx])",
}
