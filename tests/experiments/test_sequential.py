"""The tournament's design: what it spends, whom it stops, and that no early look is free."""

from __future__ import annotations

import numpy as np

from sauna.experiments.sequential import DESIGN, Look, look_at, tournament

LEVEL = sum(look.level for look in DESIGN)


def test_the_looks_share_one_level() -> None:
    assert np.isclose(LEVEL, 0.05)
    assert [look.seeds for look in DESIGN] == sorted(look.seeds for look in DESIGN)


def test_an_arm_that_always_wins_is_better_and_one_that_always_loses_is_not_looked_at_again() -> (
    None
):
    seeds = np.arange(16.0)
    ended = tournament({"ppo": seeds, "winner": seeds + 100, "loser": seeds - 100}, "ppo")
    assert ended["winner"].verdict == "better" and ended["winner"].probability == 1.0
    assert ended["loser"].verdict == "not decided" and ended["loser"].seeds == 3
    assert "stopped with 3 seeds" in ended["loser"].reason


def test_equal_arms_are_not_decided() -> None:
    seeds = np.arange(16.0)
    ended = tournament({"ppo": seeds, "twin": seeds.copy()}, "ppo")
    assert ended["twin"].verdict == "not decided"


def test_arms_that_stopped_still_count_in_holms_correction() -> None:
    """With 6 against 6 an arm that always wins has p 2 / 924; twelve arms make it 12 times that."""
    random = np.random.default_rng(0)
    scores = {"ppo": np.arange(6.0), "winner": np.arange(6.0) + 10}
    scores |= {f"stopped {i}": random.normal(size=6) for i in range(11)}
    found = look_at(scores, "ppo", Look(6, 0.05, 0.0), ["winner"], is_last=True)["winner"]
    assert np.isclose(found.p, 12 * 2 / 924)
    alone = look_at(
        {arm: scores[arm] for arm in ("ppo", "winner")}, "ppo", Look(6, 0.05, 0.0), ["winner"], True
    )["winner"]
    assert np.isclose(alone.p, 2 / 924)


def test_a_failed_seed_is_the_worst_outcome() -> None:
    seeds = np.arange(16.0)
    failing = seeds + 100
    failing[:8] = -np.inf
    assert tournament({"ppo": seeds, "failing": failing}, "ppo")["failing"].verdict != "better"


def test_false_better_is_rare_and_noticed_without_the_shared_level() -> None:
    """The negative control tests each arm by itself at 0.05 at every look."""

    def rate(tested: bool) -> float:
        wrong = 0
        for seed in range(60):
            random = np.random.default_rng(seed)
            draw = {"ppo": np.exp(random.normal(size=16))}
            draw |= {f"arm {i}": np.exp(random.normal(size=16)) for i in range(8)}
            if tested:
                ended = tournament(draw, "ppo")
                wrong += any(s.verdict == "better" for s in ended.values())
                continue
            looks = [Look(look.seeds, 0.05, 0.0) for look in DESIGN]
            for arm in list(draw)[1:]:
                alone = {"ppo": draw["ppo"], arm: draw[arm]}
                if tournament(alone, "ppo", looks)[arm].verdict == "better":
                    wrong += 1
                    break
        return wrong / 60

    assert rate(True) <= LEVEL < 2 * LEVEL < rate(False)
