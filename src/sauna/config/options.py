"""Every choice of a run, as one flat frozen dataclass.

The dataclass is the single source of the command line's flags and help lines, of `config.json`,
and of the keyword arguments of `sauna.train`. Nothing here imports JAX, so that bad input is
refused in well under a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from sauna.config import choices, readers
from sauna.config.fields import option
from sauna.config.run_options import RunOptions

_learning = partial(option, group="learning")
_network = partial(option, group="network")
_normalisation = partial(option, group="normalisation")
_selection = partial(option, group="selection")
_rule = partial(option, group="selection", rule_of_experiment=True)
_update = partial(option, group="update rules")


@dataclass(frozen=True)
class Config(RunOptions):
    """All settings of one run; see each field's help line. Built by `resolve`, never by hand."""

    envs: int = _learning(1, "environments per member (N)", at_least=1, common=True)
    rollout_steps: int = _learning(
        2048, "kept steps per environment and iteration (T)", at_least=1, common=True
    )
    minibatches: int = _learning(32, "minibatches per epoch", at_least=1, read_when=readers.PPO)
    epochs: int = _learning(10, "passes over each rollout", at_least=1, read_when=readers.PPO)
    learning_rate: float = _learning(
        3e-4, "the optimizer's step size", above=0, common=True, shapes_program=False
    )
    learning_rate_schedule: str = _learning(
        "linear",
        "of the learning rate over the budget: to 0 (linear, cosine), constant, by the KL "
        "divergence (kl), or by a function",
        choices=("linear", "constant", "cosine", "kl"),
        plugin=True,
    )
    warmup: float = _learning(
        0.0,
        "share of the budget over which the learning rate rises first",
        at_least=0,
        at_most=0.99,
        read_when=readers.NO_KL_RATE,
    )
    desired_kl: float = _learning(
        0.01,
        "KL divergence that schedule kl aims at: above twice of it the rate is divided by 1.5, "
        "below half of it the rate is multiplied by 1.5",
        above=0,
        read_when=readers.KL_RATE,
    )
    learning_rate_min: float = _learning(
        1e-5, "the least rate of schedule kl", above=0, read_when=readers.KL_RATE
    )
    learning_rate_max: float = _learning(
        1e-2, "the largest rate of schedule kl", above=0, read_when=readers.KL_RATE
    )
    optimizer: str = _learning(
        "adam",
        "what makes a step of the gradient: an optimizer here or of optax (optax:adan)",
        choices=choices.OPTIMIZERS,
        plugin=True,
    )
    optimizer_kwargs: str = _learning("{}", "arguments of the optimizer, as a JSON object")
    weight_decay: float = _learning(
        0.0,
        "share of each parameter that a gradient step subtracts, times the learning rate (0: what "
        "the optimizer does by itself)",
        at_least=0,
    )
    schedule_start: int = _learning(
        0,
        "steps of the budget before which schedules keep their first value",
        at_least=0,
        read_when=readers.SCHEDULED,
    )
    adam_epsilon: float = _learning(1e-5, "Adam's epsilon", above=0, read_when=readers.ADAM)
    rmsprop_epsilon: float = _learning(
        1e-5, "RMSProp's epsilon, under the root", above=0, read_when=readers.RMSPROP
    )
    rmsprop_decay: float = _learning(
        0.99,
        "of RMSProp's running mean square",
        at_least=0,
        at_most=0.999999,
        read_when=readers.RMSPROP,
    )
    max_grad_norm: float = _learning(
        0.5, "the gradient is scaled down to this global norm", above=0, shapes_program=False
    )
    clip_range: float = _learning(
        0.2,
        "clip range of the probability ratio (and the value)",
        above=0,
        shapes_program=False,
        read_when=readers.PPO,
    )
    clip_range_schedule: str = _learning(
        "constant",
        "of the clip range over the budget: constant, to 0 (linear, cosine), or by a function",
        choices=choices.SCHEDULES,
        plugin=True,
        read_when=readers.PPO,
    )
    clip_value: bool = _learning(
        True, "clip the value function's change as the ratio's", read_when=readers.SQUARED
    )
    normalize_advantages: bool = _learning(
        True, "standardise the advantages of each minibatch", read_when=readers.CENTRED
    )
    entropy_coef: float = _learning(
        0.0, "weight of the entropy bonus", at_least=0, shapes_program=False
    )
    entropy_coef_schedule: str = _learning(
        "constant",
        "of the entropy bonus over the budget: constant, to 0 (linear, cosine), or by a function",
        choices=choices.SCHEDULES,
        plugin=True,
        read_when=readers.ENTROPY,
    )
    value_coef: float = _learning(0.5, "weight of the value loss", at_least=0, shapes_program=False)
    gamma: float = _learning(0.99, "discount", at_least=0, at_most=1, shapes_program=False)
    gae_lambda: float = _learning(
        0.95, "lambda of the advantage estimate", at_least=0, at_most=1, shapes_program=False
    )

    network: str = _network(
        "auto",
        "trunk (auto: for pictures nature-cnn from 36 x 36 pixels on, below small-cnn; else mlp)",
        choices=choices.NETWORKS,
        plugin=True,
    )
    hidden: tuple[int, ...] = _network(
        (64, 64), "widths of the MLP's hidden layers", at_least=1, read_when=readers.MLP
    )
    activation: str = _network(
        "tanh", "the MLP's activation", choices=choices.ACTIVATIONS, read_when=readers.MLP
    )
    layer_norm: bool = _network(
        False,
        "normalise each layer of the MLP before its activation (Ba et al. 2016)",
        read_when=readers.MLP,
    )
    value_hidden: tuple[int, ...] = _network(
        (),
        "widths of the value's hidden layers, if they are not the policy's",
        at_least=1,
        read_when=readers.VALUE_MLP,
    )
    trunk: str = _network(
        "separate", "whether policy and value share a trunk", choices=("separate", "shared")
    )
    recurrent: str = _network(
        "none",
        "a cell behind each trunk that remembers what an episode has shown",
        choices=("none", "lstm", "gru"),
    )
    recurrent_width: int = _network(
        64, "width of that cell", at_least=1, read_when=readers.RECURRENT
    )
    sequence_length: int = _network(
        16,
        "env steps over which gradients flow back through it: minibatches are made of sequences",
        at_least=1,
        read_when=readers.RECURRENT,
    )
    distribution: str = _network(
        "gaussian",
        "of continuous actions: a Gaussian, clipped; one under a tanh (squashed) or a Beta on the "
        "bounds of the action box; or a Gaussian whose noise depends on the state (gsde)",
        choices=choices.DISTRIBUTIONS,
        needs_spaces=readers.CONTINUOUS,
    )
    log_std_init: float = _network(
        0.0,
        "first log standard deviation of continuous actions (gsde: of features of size 1)",
        needs_spaces=readers.CONTINUOUS,
        read_when=readers.LOG_STD,
    )
    sde_sample_freq: int = _network(
        0,
        "gsde: env steps for which a draw of the noise is kept (0: the whole rollout)",
        at_least=0,
        read_when=readers.GSDE,
    )
    sde_expln: bool = _network(
        False, "gsde: a log standard deviation above 0 grows slowly", read_when=readers.GSDE
    )
    sde_learn_features: bool = _network(
        False, "gsde: the noise's gradient goes into the features, too", read_when=readers.GSDE
    )
    rescale_actions: bool = _normalisation(
        True,
        "stretch actions in [-1, 1] to the bounds of the action box (MuJoCo's tasks: no, as "
        "published)",
        needs_spaces=readers.CONTINUOUS,
        read_when=readers.UNBOUNDED,
    )
    normalize_observations: bool = _normalisation(
        True,
        "running mean and variance of vector observations (images are divided by 255)",
        needs_spaces=readers.VECTORS,
    )
    sign_rewards: bool = _normalisation(
        False, "learn from each reward's sign, -1, 0 or 1 (returns are reported in full)"
    )
    normalize_rewards: bool = _normalisation(
        True, "divide rewards by the std of the discounted return"
    )
    clip_observations: float = _normalisation(
        10.0, "bound of normalised observations", above=0, read_when=readers.NORMALIZED
    )
    clip_rewards: float = _normalisation(
        10.0, "bound of normalised rewards", above=0, read_when=readers.SCALED
    )

    vex_target: str = _rule(
        "sample",
        "what the Vex head regresses",
        choices=choices.VEX_TARGETS,
        plugin=True,
        read_when=readers.VEX,
    )
    vex_coef: float = _selection(
        0.5, "weight of the Vex loss (c2 of eq. 6)", at_least=0, shapes_program=False
    )
    filter: str = _rule("sauna", "which transitions are kept", choices=choices.FILTERS, plugin=True)
    filter_kwargs: str = _rule(
        "{}", "arguments of your own filter, as a JSON object", read_when=readers.OWN_FILTER
    )
    sampler: str = _selection(
        "none",
        "which of the rollout's samples the update learns from, once advantages are known",
        choices=choices.SAMPLERS,
        plugin=True,
    )
    sampler_kwargs: str = _selection(
        "{}", "arguments of the sampler, as a JSON object", read_when=readers.SAMPLER
    )
    control: str = _selection(
        "none",
        "replaces the rule's samples by as many others in each iteration: at random, every k-th, "
        "those of smallest |advantage|, or those that the rule wants least",
        choices=("none", "random", "stride", "low-advantage", "reversed"),
    )
    selection_mode: str = _selection(
        "fewer",
        "fewer gradient steps on minibatches of PPO's size (or as near below it as fills them), as "
        "many steps on smaller ones, or as many of PPO's size, which repeat the chosen rows",
        choices=("fewer", "smaller", "refill"),
        read_when=readers.MASKED,
    )
    selection_losses: str = _selection(
        "all",
        "the sampler chooses for all losses, or for the policy loss alone",
        choices=("all", "policy"),
        read_when=readers.SAMPLER,
    )
    normalize_over: str = _update(
        "minibatch",
        "what advantages are standardised over",
        choices=("minibatch", "rollout", "kept"),
        read_when=readers.STANDARDISED,
    )
    advantage_sign: str = _update(
        "both",
        "learn from all advantages, or from max(0, A) / std(A)",
        choices=("both", "positive"),
    )
    objective: str = _update(
        "clip",
        "the policy term: PPO's clip, SPO's penalty, or neither",
        choices=("clip", "spo", "unclipped"),
        plugin=True,
        read_when=readers.PPO,
    )
    loss_weight: str = _update(
        "none",
        "what weighs each policy term of a minibatch",
        choices=("none", "delight", "sample-dropout"),
        plugin=True,
    )
    loss_weight_kwargs: str = _update(
        "{}", "arguments of the loss weight, as a JSON object", read_when=readers.WEIGHTED
    )
    stop: str = _update(
        "none",
        "what ends an iteration's updates early",
        choices=("none", "target-kl", "espo"),
        plugin=True,
        read_when=readers.PPO,
    )
    stop_kwargs: str = _update(
        "{}", "arguments of the stop rule, as a JSON object", read_when=readers.STOPPED
    )
    critic: str = _update(
        "squared",
        "the value loss: squared errors, or their variance (AVEC)",
        choices=("squared", "avec"),
        plugin=True,
    )
    recompute_advantages: bool = _update(
        False, "compute values and advantages anew before each epoch", read_when=readers.PPO
    )
    replay_rollouts: int = _update(
        0,
        "earlier rollouts that the update learns from again, with truncated importance weights",
        at_least=0,
        read_when=readers.PPO,
    )
    auxiliary: str = _update(
        "none",
        "a second head learns to predict the next observation, or, as in MERL's released code, "
        "that of another row",
        choices=("none", "next-observation", "shuffled-observation"),
    )
    auxiliary_coef: float = _update(
        0.01, "weight of the auxiliary loss", at_least=0, read_when=readers.AUXILIARY
    )
    threshold: float = _selection(
        0.3,
        "keep if |Vex| / |median| reaches this (eq. 7)",
        at_least=0,
        shapes_program=False,
        read_when=readers.THRESHOLD,
    )
    threshold_schedule: str = _rule(
        "constant",
        "over the budget of steps: constant, rising from 0, or falling to 0",
        choices=("constant", "rising", "falling"),
        read_when=readers.THRESHOLD,
    )
    keep_rate_target: float = _rule(
        0.0,
        "share of steps to keep; the threshold is moved at every step to hold it (0: off)",
        at_least=0,
        at_most=1,
        read_when=readers.SAUNA,
    )
    history: str = _rule(
        "all",
        "steps of the rollout whose predictions the median covers",
        choices=("all", "kept"),
        read_when=readers.SAUNA,
    )
    decision: str = _rule(
        "env",
        "decide for each env, or jointly for a vector step",
        choices=("env", "joint"),
        read_when=readers.SEVERAL,
    )
    dropped: str = _rule(
        "replace",
        "dropped steps: replaced by further env steps, or masked",
        choices=("replace", "mask"),
        read_when=readers.FILTERED,
    )
    max_env_steps_factor: int = _rule(
        4,
        "with replace: at most this many times T env steps are tried",
        at_least=1,
        read_when=readers.REPLACED,
    )
    gae_over: str = _rule(
        "all", "advantages over all env steps, or over the kept ones", choices=("all", "kept")
    )
    truncation: str = _learning(
        "bootstrap",
        "at a time limit: bootstrap the final value, or treat it as termination",
        choices=("bootstrap", "terminate"),
        rule_of_experiment=True,
    )
    budget: str = _rule(
        "env", "what `steps` counts: all env steps or kept ones", choices=("env", "kept")
    )
    drop_rate: float = _selection(
        0.0,
        "share of steps that random-drop drops",
        at_least=0,
        at_most=0.99,
        shapes_program=False,
        read_when=readers.RANDOM,
    )
