"""Kondo: the policy learns from the rows of largest delight."""

from __future__ import annotations

from sauna.algorithm.selection.delight import surprisal
from sauna.algorithm.selection.scores import check_choice, check_share, count_of, largest
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def kondo(
    setup: SamplerSetup, share: float = 0.3, centred: bool = True, on: str = "mean"
) -> Sampler:
    """Keeps the `ceil(share M)` rows of largest `chi = A^ surprisal` for the policy.

    The surprisal is that of the policy that acted. The critic learns from all rows
    (`selection_losses=policy`), so that no work is saved. The policy loss is a mean over the kept.

    The centred surprisal of a Gaussian is `sum_j (z_j^2 - 1) / 2`, `z = (a - mu) / sigma`: chi is
    then half the row's gradient on the log-std, `A^ sum_j (z_j^2 - 1)`, and the kept rows are those
    that widen the policy, whatever their advantages say. So with `on="mean"` the mean alone learns
    from the kept rows, and the log-std from all. `on="all"` lets both learn from the kept. Policies
    without a log-std (discrete, Beta) learn whole from the kept.
    Source: Osband 2026, arXiv 2603.20526, on discrete actions. Its gate is soft, and this is its
    limit of a hard one. `centred` and `on` are this project's.
    """
    check_share(share)
    check_choice("on", on, ("mean", "all"))
    count = count_of(share, setup.rows)

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        centre = samples.entropy if centred and setup.action_kind == "continuous" else None
        chi = samples.standardized * surprisal(samples.log_prob, centre)
        return state, Choice(keep=largest(chi, count, samples.present), score=chi)

    return Sampler(lambda: (), choose, share=share, reads_policy=True, on_mean=on == "mean")
