"""Kondo: the policy learns from the rows of largest delight."""

from __future__ import annotations

from sauna.algorithm.selection.delight import surprisal
from sauna.algorithm.selection.scores import check_share, count_of, largest
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def kondo(setup: SamplerSetup, share: float = 0.3, centred: bool = True) -> Sampler:
    """Keeps the `ceil(share M)` rows of largest `chi = A^ surprisal` for the policy.

    The surprisal is that of the policy that acted. The critic learns from all rows
    (`selection_losses=policy`), so that no work is saved. The policy loss is a mean over the kept.
    Source: arXiv 2603.20526, whose gate is soft; this is its limit of a hard one.
    """
    check_share(share)
    count = count_of(share, setup.rows)

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        centre = samples.entropy if centred and setup.action_kind == "continuous" else None
        chi = samples.standardized * surprisal(samples.log_prob, centre)
        return state, Choice(keep=largest(chi, count, samples.present), score=chi)

    return Sampler(lambda: (), choose, share=share, reads_policy=True)
