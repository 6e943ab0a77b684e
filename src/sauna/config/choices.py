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
