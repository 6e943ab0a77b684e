"""Statistics over seeds: hand arithmetic, published values, identities, and their error rates."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from sauna.experiments import statistics as s

# The example of scipy's `mannwhitneyu` documentation: age at diagnosis, U = 17, exact p = 0.1111.
MALES, FEMALES = np.array([19, 22, 16, 29, 24]), np.array([20, 11, 17, 12])


def normal(random: np.random.Generator, number: int) -> np.ndarray:
    return random.normal(1300, 80, number)


def bimodal(random: np.random.Generator, number: int) -> np.ndarray:
    """Four runs in five stay in one gait, the fifth finds a better one."""
    common = random.random(number) < 0.8
    return np.where(common, random.normal(1300, 80, number), random.normal(2700, 300, number))


def capped(random: np.random.Generator, number: int) -> np.ndarray:
    """Half the runs reach the highest return there is: many ties."""
    return np.minimum(normal(random, number), 1300)


def scores_with_u(u: int, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Untied scores of which `u` of the `n m` pairs are won by the first group."""
    y = np.arange(m, dtype=float)
    won = [min(m, max(0, u - m * i)) for i in range(n)]
    x = np.array([w - 0.5 + i * 1e-3 for i, w in enumerate(won)])
    assert (x[:, None] > y).sum() == u
    return x, y


def against(x: np.ndarray, y: np.ndarray) -> s.Comparison:
    """Of a single question."""
    return s.compare({"": (x, y)})[""]


def test_iqm_by_hand() -> None:
    assert s.iqm(np.array([1.0, 2.0, 3.0])) == 2  # fewer than four: nothing is cut
    assert s.iqm(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    assert s.iqm(np.array([9.0, 0.0, 4.0, 5.0, 9.0, 0.0])) == 4.5  # floor(6 / 4) = 1 at each end
    np.testing.assert_array_equal(s.iqm(np.array([[0, 1, 2, 9], [4, 4, 4, 4]])), [1.5, 4])


def test_trimmed_mean_of_scipys_example() -> None:
    """`trim_mean(arange(20), 0.1)` is 9.5 there; any symmetric cut of it is."""
    assert s.iqm(np.arange(20)) == 9.5


def test_iqm_of_a_constant_has_an_interval_of_no_width() -> None:
    assert s.iqm_estimate([np.full(5, 3.5), np.full(4, 3.5)]) == (3.5, 3.5, 3.5)


def test_one_seed_has_no_interval() -> None:
    one, two = np.array([1.0]), np.array([0.0, 2.0])
    assert s.iqm_estimate([one]) == (1.0, None, None)
    assert s.iqm_estimate([one, two]).low is None
    assert s.improvement_estimate(one, two) == (0.5, None, None)
    assert s.improvement_over_tasks([(two, two), (one, two)]) == (0.5, None, None)
    assert np.isnan(s.mean_interval(np.ones((1, 4)))[1:]).all()
    assert np.isnan(s.performance_profile(one, one)[1:]).all()


def test_the_bootstrap_is_stratified() -> None:
    """Tasks that differ by a constant do not add to the interval's width: none is over-drawn."""
    a, b = np.array([0.0, 0.0, 0.0]), np.array([10.0, 10.0, 10.0])
    assert s.iqm_estimate([a, b]) == (5.0, 5.0, 5.0)
    pooled = s.iqm_estimate([np.concatenate([a, b])])
    assert pooled.low < 1 and pooled.high > 9


def test_bootstrap_of_two_values_by_hand() -> None:
    """Resamples of {0, 1} have means 0, 1/2, 1 with chances 1/4, 1/2, 1/4."""
    assert s.iqm_estimate([np.array([0.0, 1.0])]) == (0.5, 0.0, 1.0)


def test_same_scores_give_the_same_digits() -> None:
    random = np.random.default_rng(0)
    x, y = random.normal(size=(2, 6, 6))
    first = [s.iqm_estimate(list(x)), s.improvement_over_tasks(list(zip(x, y, strict=True)))]
    np.random.seed(1)
    again = [s.iqm_estimate(list(x)), s.improvement_over_tasks(list(zip(x, y, strict=True)))]
    assert repr(first) == repr(again)


def test_profile_by_hand_and_monotone() -> None:
    share, low, high = s.performance_profile(np.array([1.0, 2.0, 2.0, 5.0]), np.arange(7.0))
    np.testing.assert_array_equal(share, [1, 1, 0.75, 0.25, 0.25, 0.25, 0])
    assert (np.diff(share) <= 0).all() and (np.diff(low) <= 0).all() and (np.diff(high) <= 0).all()
    assert (low <= share).all() and (share <= high).all()


def test_profile_band_is_the_bootstraps() -> None:
    random = np.random.default_rng(0)
    scores, thresholds = random.normal(size=7), np.linspace(-2, 2, 9)
    drawn = scores[random.integers(7, size=(100_000, 7))]
    shares = (drawn[:, :, None] >= thresholds).mean(1)
    expected = np.quantile(shares, [0.025, 0.975], axis=0, method="inverted_cdf")
    np.testing.assert_allclose(s.performance_profile(scores, thresholds)[1:], expected)


def test_improvement_of_scipys_example() -> None:
    assert s.improvement(MALES, FEMALES) == 17 / 20
    np.testing.assert_allclose(s.exact_p(MALES, FEMALES), 0.1111111111111111)


def test_improvement_with_ties_by_hand() -> None:
    assert s.improvement(np.array([1, 2, 2]), np.array([2, 0])) == (0 + 1 + 0.5 + 1 + 0.5 + 1) / 6


def test_improvement_mirrors() -> None:
    random = np.random.default_rng(0)
    x, y = random.integers(0, 5, 6).astype(float), random.integers(0, 6, 9).astype(float)
    one, other = s.improvement_estimate(x, y), s.improvement_estimate(y, x)
    np.testing.assert_allclose(one, [1 - other.value, 1 - other.high, 1 - other.low])
    assert s.improvement(x, x) == 0.5
    np.testing.assert_allclose(s.exact_p(x, y), s.exact_p(y, x))


@pytest.mark.parametrize("n,m", [(2, 3), (4, 4), (5, 7), (8, 8), (20, 30)])
def test_exact_p_is_scipys_where_nothing_is_tied(n: int, m: int) -> None:
    random = np.random.default_rng(n)
    for shift in (0, 0.7, 2):
        x, y = random.normal(shift, 1, n), random.normal(size=m)
        expected = stats.mannwhitneyu(x, y, method="exact").pvalue
        np.testing.assert_allclose(s.exact_p(x, y), expected)


def test_exact_p_with_ties_by_enumeration() -> None:
    random = np.random.default_rng(1)
    for n, m in [(3, 4), (4, 4), (5, 3)]:
        x, y = random.integers(0, 4, n), random.integers(1, 5, m)
        ranks = stats.rankdata(np.concatenate([x, y]))
        sums = np.array([sum(deal) for deal in itertools.combinations(ranks, n)])
        distance = np.abs(sums - ranks.mean() * n)
        expected = (distance >= abs(ranks[:n].sum() - ranks.mean() * n) - 1e-9).mean()
        np.testing.assert_allclose(s.exact_p(x, y), expected)


def test_p_of_nothing_and_of_all_equal_is_one() -> None:
    assert s.exact_p(np.zeros(0), np.ones(3)) == 1
    assert s.exact_p(np.ones(4), np.ones(6)) == 1
    assert s.exact_p(np.ones(400), np.ones(60)) == 1


def test_many_runs_take_the_normal_approximation_without_a_jump() -> None:
    random = np.random.default_rng(0)
    x, y = random.normal(0.4, 1, 50), random.normal(size=50)
    approximate = stats.mannwhitneyu(x, y, method="asymptotic").pvalue
    np.testing.assert_allclose(s.exact_p(x, y), approximate, rtol=0.05)
    assert 0 < s.exact_p(np.append(x, 0.1), y) < 1


def test_holm_by_hand() -> None:
    np.testing.assert_allclose(s.holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    assert s.holm([0.3]) == [0.3]
    assert s.holm([0.9, 0.8]) == [1, 1]
    assert s.holm([]) == []


def test_least_seeds_is_where_perfectly_parted_scores_are_enough() -> None:
    assert [s.least_seeds(k) for k in (1, 2, 6, 7)] == [4, 5, 5, 6]
    for n, expected in [(3, 0.1), (4, 2 / 70), (5, 2 / 252)]:
        np.testing.assert_allclose(s.exact_p(np.arange(n) + 100, np.arange(n)), expected)


def test_noethers_sample_size() -> None:
    """statpsych documents `size.test.mann(.05, .90, .3)` as 44 per group, by Noether's formula."""
    assert s.seeds_needed(0.3, power=0.9) == 44
    assert s.seeds_needed(0.7, power=0.9) == 44
    assert s.seeds_needed(0.58) == math.ceil((1.959964 + 0.841621) ** 2 / (6 * 0.08**2)) == 205
    assert s.seeds_needed(0.5) is None
    assert s.seeds_needed(1.0) == 6
    assert s.seeds_needed(0.8, comparisons=3) > s.seeds_needed(0.8)


def test_noethers_number_gives_about_the_power_it_promises() -> None:
    random = np.random.default_rng(0)
    chance = 0.76
    n, shift = s.seeds_needed(chance), stats.norm.ppf(chance) * math.sqrt(2)
    found = [against(random.normal(shift, 1, n), random.normal(size=n)).kind for _ in range(300)]
    assert 0.75 < found.count("better") / 300 < 0.92


@pytest.mark.parametrize(
    "n,m", [(2, 2), (3, 3), (4, 4), (5, 5), (6, 6), (10, 10), (4, 9), (30, 30)]
)
def test_the_interval_leaves_out_one_half_where_the_test_rejects_it(n: int, m: int) -> None:
    for u in range(n * m + 1):
        x, y = scores_with_u(u, n, m)
        value, low, high = s.improvement_estimate(x, y)
        assert 0 <= low <= value <= high <= 1
        p = stats.mannwhitneyu(x, y, method="asymptotic", use_continuity=True).pvalue
        assert (p < 0.05) == (low > 0.5 or high < 0.5)


@pytest.mark.parametrize(
    "n,m", [(3, 3), (4, 4), (5, 5), (6, 6), (10, 10), (3, 8), (9, 30), (30, 30)]
)
def test_equal_distributions_are_called_different_in_at_most_5_percent(n: int, m: int) -> None:
    """Exactly: the verdict at every value of U, weighted by its chance under equal distributions.

    The chances come from scipy's p values, which are cumulative.
    """
    wrong = 0.0
    below = 0.0
    for u in range(n * m + 1):
        x, y = scores_with_u(u, n, m)
        cumulative = stats.mannwhitneyu(x, y, alternative="less", method="exact").pvalue
        kind = against(x, y).kind
        wrong += (cumulative - below) * (kind in ("better", "worse"))
        below = cumulative
    assert wrong <= 0.05
    assert (wrong > 0) == (2 / math.comb(n + m, n) < 0.05)


@pytest.mark.parametrize("scores", [normal, bimodal, capped])
@pytest.mark.parametrize("n", [3, 5, 6, 10, 30])
def test_false_findings_in_simulation(scores, n: int) -> None:
    """The same by drawing; 2.5 standard errors of 600 draws above 5%."""
    random, trials = np.random.default_rng(n), 600
    kinds = [against(scores(random, n), scores(random, n)).kind for _ in range(trials)]
    wrong = (kinds.count("better") + kinds.count("worse")) / trials
    assert wrong <= 0.05 + 2.5 * math.sqrt(0.05 * 0.95 / trials)
    assert (kinds.count("underpowered") == trials) == (n == 3)


def test_false_findings_among_several_arms_and_without_holm() -> None:
    random, trials = np.random.default_rng(0), 500
    with_holm = without = 0
    for _ in range(trials):
        arms = {name: normal(random, 6) for name in "abcd"}
        baseline = normal(random, 6)
        found = s.compare({name: (x, baseline) for name, x in arms.items()})
        with_holm += any(c.kind != "no evidence" for c in found.values())
        without += any(s.exact_p(x, baseline) < 0.05 for x in arms.values())
    assert with_holm / trials <= 0.05
    assert without / trials > 0.08


def test_the_interval_covers_where_a_bootstrap_does_not() -> None:
    random, trials, shift = np.random.default_rng(0), 200, 1.5
    true = stats.norm.cdf(shift / math.sqrt(2))
    covered = np.zeros(2)
    for _ in range(trials):
        x, y = random.normal(shift, 1, 3), random.normal(size=3)
        for i, (low, high) in enumerate(
            [s.improvement_estimate(x, y)[1:], s.bootstrap_improvement([(x, y)])]
        ):
            covered[i] += low <= true <= high
    assert covered[0] / trials > 0.93
    assert covered[1] / trials < 0.8


def test_verdicts() -> None:
    low, high = np.arange(6.0), np.arange(6.0) + 10
    assert against(high, low).kind == "better"
    assert against(low, high).kind == "worse"
    assert against(low + 0.1, low).kind == "no evidence"
    few = against(high[:3], low[:3])
    assert (few.kind, few.least, few.needed) == ("underpowered", 4, 6)
    assert against(high[:0], low) == ("underpowered", (None, None, None), 1.0, 4, None)
    assert against(high[:1], low).needed is None
    assert against(high[:2], np.arange(8.0)).kind == "underpowered"  # by the interval
    assert s.compare({}) == {}


def test_holm_can_undo_a_verdict_and_raise_the_least_number_of_seeds() -> None:
    x, y = scores_with_u(5, 6, 6)  # exact p = 0.0411
    assert against(x, y).kind == "worse"
    both = s.compare({"x": (x, y), "other": (y + 0.1, y)})
    assert both["x"].kind == "no evidence"
    np.testing.assert_allclose(both["x"].p, 2 * s.exact_p(x, y))
    parted = np.arange(4.0) + 10
    assert against(parted, np.arange(4.0)).kind == "better"
    assert s.compare({name: (parted, np.arange(4.0)) for name in "xz"})["x"].kind == "underpowered"


def test_over_tasks_by_hand_and_never_narrower_than_the_bootstrap() -> None:
    random = np.random.default_rng(0)
    pairs = [(random.normal(0.5, 1, 5), random.normal(size=5)) for _ in range(3)]
    value, low, high = s.improvement_over_tasks(pairs)
    np.testing.assert_allclose(value, np.mean([s.improvement(x, y) for x, y in pairs]))
    drawn_low, drawn_high = s.bootstrap_improvement(pairs)
    assert low <= drawn_low <= drawn_high <= high
    mirrored = s.improvement_over_tasks([(y, x) for x, y in pairs])
    np.testing.assert_allclose(mirrored.value, 1 - value)


def test_perfect_wins_on_all_tasks_are_not_certain() -> None:
    pairs = [(np.arange(4.0) + 10, np.arange(4.0))] * 4
    assert s.bootstrap_improvement(pairs) == (1.0, 1.0)
    value, low, high = s.improvement_over_tasks(pairs)
    assert (value, high) == (1.0, 1.0) and 0.7 < low < 0.8


def test_mean_interval_by_hand_and_where_one_member_is_missing() -> None:
    """t with 2 degrees of freedom is 4.303; the standard error of (1, 2, 3) is 1 / sqrt(3)."""
    values = np.array([[1.0, 1.0], [2.0, np.nan], [3.0, 1.0]])
    mean, low, high = s.mean_interval(values)
    np.testing.assert_allclose([mean[0], low[0], high[0]], [2, 2 - 2.4842, 2 + 2.4842], atol=1e-3)
    assert np.isnan([mean[1], low[1], high[1]]).all()


RLIABLE = """
import json, sys
import numpy as np
from rliable import library, metrics

data = json.load(open(sys.argv[1]))
x, y, thresholds = (np.array(data[name]) for name in ("x", "y", "thresholds"))
np.random.seed(0)
iqm = lambda scores: np.array([metrics.aggregate_iqm(scores)])
better = lambda a, b: np.array([metrics.probability_of_improvement(a, b)])
value, interval = library.get_interval_estimates({"x": x}, iqm, reps=20000)
chance, chance_interval = library.get_interval_estimates({"x": [x, y]}, better, reps=20000)
profile, band = library.create_performance_profile({"x": x[:, :1]}, thresholds, reps=20000)
print(json.dumps({
    "iqm": [value["x"][0], *interval["x"][:, 0]],
    "improvement": [chance["x"][0], *chance_interval["x"][:, 0]],
    "profile": [profile["x"].tolist(), *band["x"].tolist()],
}))
"""


@pytest.mark.slow
def test_against_rliable(tmp_path: Path) -> None:
    """The statistics as Agarwal et al. compute them, in an environment of its own.

    rliable 1.2.0 imports arch, which breaks with pandas 3.
    """
    random = np.random.default_rng(7)
    x, y = random.normal(0.3, 1, (6, 5)), random.normal(size=(6, 5))
    thresholds = np.linspace(-2, 2, 12)  # none equals a score: rliable counts >, we count >=
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "env"], check=True)
    python = tmp_path / "env" / "bin" / "python"
    install = [python, "-m", "pip", "install", "--quiet", "rliable==1.2.0", "pandas<3"]
    installed = subprocess.run(install, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"rliable cannot be installed here: {installed.stderr[-300:]}")
    data = {"x": x.tolist(), "y": y.tolist(), "thresholds": thresholds.tolist()}
    (tmp_path / "data.json").write_text(json.dumps(data))
    run = subprocess.run(
        [python, "-c", RLIABLE, tmp_path / "data.json"], capture_output=True, text=True, check=True
    )
    theirs = json.loads(run.stdout.splitlines()[-1])

    pairs = list(zip(x.T, y.T, strict=True))
    value, *interval = s.iqm_estimate(list(x.T))
    np.testing.assert_allclose(value, theirs["iqm"][0])
    np.testing.assert_allclose(interval, theirs["iqm"][1:], atol=0.03)
    np.testing.assert_allclose(s.improvement_over_tasks(pairs).value, theirs["improvement"][0])
    drawn = s.bootstrap_improvement(pairs)
    np.testing.assert_allclose(drawn, theirs["improvement"][1:], atol=0.015)
    share, low, high = s.performance_profile(x[:, 0], thresholds)
    np.testing.assert_allclose(share, theirs["profile"][0])
    np.testing.assert_allclose([low, high], theirs["profile"][1:], atol=1e-9)
