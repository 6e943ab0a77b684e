"""The arithmetic of the benchmarks; no test looks at a time."""

from __future__ import annotations

import hashlib
import json
import runpy
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from sauna import cli
from sauna.config.presets import resolve
from sauna.experiments.bench import command, device, peer_jax, scale
from sauna.experiments.bench.peer_settings import GYMNAX_PEERS, peer_settings
from sauna.experiments.bench.peers import peer_rate
from sauna.experiments.bench.rates import Clock, alternate, physics_rate, ratio, simulator
from sauna.experiments.bench.split import SECTIONS, Timers, split
from sauna.system.errors import BadInput, SaunaError

POLE = "gymnax/CartPole-v1"


def test_the_rate_leaves_out_the_warm_up() -> None:
    clock = Clock()
    clock.seen["a"] = [(0.0, 0, 10), (50.0, 1, 20), (52.0, 2, 30), (53.0, 3, 40), (57.0, 4, 80)]
    assert clock.rate() == (80 - 20) / (57 - 50)


def test_the_rate_of_two_processes_is_the_sum_of_both(monkeypatch) -> None:
    """Each makes 10 env steps a second; one is always half a second behind."""
    clock = Clock()
    clock.open(resolve({"env": "x"}), [SimpleNamespace(name=name) for name in "ab"], Path(), [])
    for iteration in range(5):
        for name, late in (("a", 0.0), ("b", 0.5)):
            monkeypatch.setattr(time, "perf_counter", lambda t=iteration + late: t)
            row = {"member": name, "iteration": iteration, "env_steps": 10 * (iteration + 1)}
            clock.rows([row])
    assert clock.rate() == pytest.approx(20.0)


def test_ratios_are_of_neighbouring_rounds() -> None:
    assert ratio([10.0, 30.0, 40.0], [5.0, 10.0, 80.0]) == {"median": 2.0, "low": 0.5, "high": 3.0}
    turns: list[str] = []
    measures = {name: lambda name=name: turns.append(name) or 1.0 for name in ("a", "b")}
    assert alternate(measures, 2, lambda text: None) == {"a": [1.0, 1.0], "b": [1.0, 1.0]}
    assert turns == ["a", "b", "a", "b"]


def test_inner_timers_are_taken_off_the_outer_ones(monkeypatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def spend(seconds: float) -> None:
        now[0] += seconds

    timers = Timers()
    inner = timers.wrap("physics", lambda: spend(3.0))

    def step() -> None:
        spend(1.0)
        inner()
        inner()

    timers.wrap("environment", step)()
    assert (timers.seconds["physics"], timers.seconds["environment"]) == (6.0, 1.0)
    assert timers.calls == 3


def test_sections_add_up_to_a_training_of_a_filtered_arm() -> None:
    settings = {
        "env": "InvertedPendulum-v5",
        "arm": "sauna",
        "rollout_steps": 64,
        "steps": 10**5,
        "minibatches": 4,
    }
    found = split(settings, 2)
    assert tuple(found) == SECTIONS
    assert all(value > 0 for value in found.values()), found


def test_the_step_of_an_environment_in_python_is_timed_by_itself() -> None:
    settings = {"env": "small_envs:Scripted", "arm": "ppo", "rollout_steps": 64, "minibatches": 4}
    found = split({**settings, "steps": 10**5}, 1)
    assert found["physics"] > 0 < found["environment"] and found["filter"] == 0


@pytest.mark.parametrize("env", ["Hopper-v5", pytest.param("ALE/Pong-v5", marks=pytest.mark.slow)])
def test_the_simulator_is_measured_through_episode_ends(env: str) -> None:
    assert physics_rate(env, {}, processes=1, seconds=0.05) > 0


def test_simulators_have_names() -> None:
    known = {"Hopper-v5": "raw mj_step", "ALE/Pong-v5": "ale-py alone", "CartPole-v1": None}
    assert {env: simulator(env) for env in known} == known


def test_points_of_a_scale_keep_the_batch() -> None:
    for axis, values in scale.AXES.items():
        for value in values:
            config = resolve({"env": "x", "arm": "ppo", **scale.settings_at(axis, value)})
            assert config.rollout_steps * config.envs == 2048


def test_the_report_shows_every_figure() -> None:
    result = {
        "env": "Hopper-v5",
        "arm": ["ppo"],
        "members": 6,
        "processes": 2,
        "rates": {"training": [10.0, 20.0, 30.0], "physics": [40.0, 40.0, 40.0]},
        "ratios": {"physics": {"median": 0.5, "low": 0.25, "high": 0.75}},
        "split": {name: 1.0 for name in SECTIONS},
        "seconds_to_first_env_step": 2.0,
        "peak_memory_mib": 300.0,
    }
    text = "\n".join(command.report(result))
    for piece in (
        "20 env steps/s",
        "0.50 times raw mj_step (0.25 to 0.75",
        "30.0%",
        "2.0 s",
        "300",
    ):
        assert piece in text


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--against", "sb4"], "unknown peer 'sb4'"),
        (["--against", "sb3", "--warmup", "0.1"], "warmup: not read by sb3, which has 0.0"),
        (["--against", "sb3", "--recurrent", "lstm"], "recurrent: not read by sb3"),
        (["--against", "sb3", "--distribution", "beta"], "distribution: sb3 has no beta"),
        (["--against", "sb3", "--preset", "a2c"], "trunk: not read by sb3, which has separate"),
        (["ALE/Pong-v5", "--against", "sb3"], "trunk: not read by sb3, which has shared"),
        (["ALE/Pong-v5", "--against", "sb3", "--preset", "a2c-atari"], "sb3 is run with PPO"),
        (["--against", "rltools", "--hidden", "64,32"], "hidden: rltools has no (64, 32)"),
        (["--against", "rltools", "--activation", "elu"], "activation: rltools has no elu"),
        (
            ["--against", "rltools", "--trunk", "shared"],
            "trunk: not read by rltools, which has sep",
        ),
        (["CartPole-v1", "--against", "rltools"], "env: rltools has no CartPole-v1"),
        (["CartPole-v1", "--against", "rl_games"], "env: rl_games has no CartPole-v1"),
        (["--against", "rl_games", "--warmup", "0.1"], "warmup: not read by rl_games"),
        (["--against", "rl_games", "--preset", "a2c"], "rl_games is run with PPO, not with a2c"),
        (
            ["--against", "rl_games", "--env-kwargs", '{"forward_reward_weight": 2}'],
            "env_kwargs: not read by rl_games",
        ),
        (["--rounds", "0"], "rounds: must be"),
        (["NoSuch-v0"], "unknown environment"),
        (["--json", "nowhere/x.json"], "is not a folder"),
        (["--scale", "--against", "sb3"], "against: not read with --scale"),
        (["--scale", "--seeds", "3"], "seeds: not read with --scale"),
        (["--scale", "--iterations", "9"], "iterations: not read with --scale"),
        (["--iterations", "1"], "iterations: must be"),
        (["--threshold", "1"], "not read by arm ppo"),
        (["jax_envs:walk", "--processes", "2"], "processes: not read"),
        (["jax_envs:walk", "--against", "brax"], "brax cannot train"),
        (["brax/ant", "--against", "brax"], "give --seeds 1"),
        ([POLE, "--against", "sb3"], "sb3 has no environments on the device"),
        (["jax_envs:walk", "--against", "rejax"], "rejax cannot train jax_envs:walk"),
        (["--against", "rejax"], "rejax cannot train HalfCheetah-v5"),
        ([POLE, "--against", "rejax"], "rejax trains one member; give --seeds 1"),
        ([POLE, "--against", "rejax", "--no-clip-value"], "which has True"),
        ([POLE, "--against", "rejax", "--seeds", "1", "--devices", "2"], "is run on one CPU"),
        ([POLE, "--against", "purejaxrl"], "your copy of its ppo.py"),
        ([POLE, "--against", "purejaxrl", "--script", "no.py"], "no.py is not a file"),
        ([POLE, "--against", "purejaxrl", "--script", __file__], "wrappers.py, which test_bench"),
        ([POLE, "--against", "rejax", "--script", __file__], "script: read with --against cleanrl"),
        (["brax/ant", "--against", "brax", "--seeds", "1", "--envs", "3"], "not divisible by 32"),
    ],
)
def test_bad_input(arguments: list[str], message: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit:
        cli.main(["bench", *arguments])
    assert exit.value.code == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_peer_gets_the_settings_of_the_run() -> None:
    config = resolve({"env": "CartPole-v1", "arm": "ppo", "preset": "cartpole", "hidden": "32"})
    found = peer_settings("sb3", config)
    assert (found["envs"], found["rollout_steps"], found["minibatches"]) == (8, 32, 1)
    assert (found["hidden"], found["clip_range_schedule"]) == ((32,), "linear")
    assert json.loads(json.dumps(found))["normalize_observations"] is False


def test_a_script_with_numbers_of_its_own_gets_the_environment_alone() -> None:
    assert peer_settings("cleanrl", resolve({"env": "Hopper-v5"})) == {"env": "Hopper-v5"}
    with pytest.raises(BadInput, match="envs: not read by cleanrl, which has 1"):
        peer_settings("cleanrl", resolve({"env": "Hopper-v5", "envs": 4}))


def test_what_a_peer_lacks_may_have_any_value() -> None:
    for given in ({}, {"normalize_rewards": False, "max_grad_norm": 9.0}):
        found = peer_settings("rltools", resolve({"env": "HalfCheetah-v5", **given}))
        assert not {"normalize_rewards", "max_grad_norm"} & found.keys()
    with pytest.raises(BadInput, match="max_grad_norm: not read by cleanrl"):
        peer_settings("cleanrl", resolve({"env": "HalfCheetah-v5", "max_grad_norm": 9.0}))


def run_script(peer: str, monkeypatch, folder: Path, capsys, **overrides) -> float:
    """Runs `peer_NAME.py` in this process, with whatever stands for the peer's modules."""
    settings = peer_settings(peer, resolve({"env": "InvertedPendulum-v5", **overrides}))
    text = json.dumps({**settings, "seed": 3, "seconds": 0.0, "folder": "."})
    monkeypatch.setattr(sys, "argv", ["script", text])
    monkeypatch.setattr(sys, "prefix", str(folder))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    runpy.run_path(str(Path(command.__file__).with_name(f"peer_{peer}.py")))
    return json.loads(capsys.readouterr().out.splitlines()[-1])["rate"]


def test_rltools_is_compiled_with_the_settings_of_the_run(tmp_path, monkeypatch, capsys) -> None:
    made: list[dict] = []
    seeds: list[int] = []

    def compiled(make_env, **constants):
        box = make_env().action_space  # of this task it is -3 to 3, which RLtools refuses
        made.append({**constants, "bounds": (box.low.item(), box.high.item())})
        return SimpleNamespace(State=lambda seed: seeds.append(seed) or SimpleNamespace(step=int))

    monkeypatch.setitem(sys.modules, "rltools", SimpleNamespace(PPO=compiled))
    given = {"envs": 4, "rollout_steps": 64, "minibatches": 8, "hidden": "32,32,32"}
    assert run_script("rltools", monkeypatch, tmp_path, capsys, **given) > 0
    run_script("rltools", monkeypatch, tmp_path, capsys, **given, activation="relu")
    first, second = made
    sizes = ("N_ENVIRONMENTS", "ON_POLICY_RUNNER_STEPS_PER_ENV", "BATCH_SIZE", "N_EPOCHS")
    assert [first[name] for name in sizes] == [4, 64, 32, 10]
    assert (first["ACTOR_NUM_LAYERS"], first["CRITIC_HIDDEN_DIM"]) == (4, 32)
    activations = (first["ACTOR_ACTIVATION_FUNCTION"], second["CRITIC_ACTIVATION_FUNCTION"])
    assert activations == ("FAST_TANH", "RELU")
    assert (first["INITIAL_ACTION_STD"], first["bounds"], seeds) == (1.0, (-1.0, 1.0), [3, 3])
    assert first["interface_name"] != second["interface_name"]


def test_rl_games_is_configured_with_the_settings_of_the_run(tmp_path, monkeypatch, capsys) -> None:
    loaded: list[dict] = []

    class Runner:
        def __init__(self, observer) -> None:
            self.observer = observer

        def load(self, config) -> None:
            loaded.append(config["params"])

        def run(self, arguments) -> None:
            for epoch in range(1, 100):
                self.observer.after_print_stats(256 * epoch, epoch, 0.0)
            raise AssertionError("it was not ended")

    names = SimpleNamespace(list_all_envs=lambda: ["InvertedPendulum-v5"], __version__="1")
    for name, module in {
        "envpool": names,
        "torch": SimpleNamespace(set_num_threads=int),
        "rl_games.common.algo_observer": SimpleNamespace(AlgoObserver=object),
        "rl_games.torch_runner": SimpleNamespace(Runner=Runner),
    }.items():
        monkeypatch.setitem(sys.modules, name, module)
    given = {"envs": 4, "rollout_steps": 64, "minibatches": 8, "activation": "silu"}
    assert run_script("rl_games", monkeypatch, tmp_path, capsys, **given) > 0
    (found,) = loaded
    learning = found["config"]
    sizes = ("num_actors", "horizon_length", "minibatch_size", "mini_epochs")
    assert [learning[name] for name in sizes] == [4, 64, 32, 10]
    assert (learning["lr_schedule"], learning["normalize_input"]) == ("linear", True)
    assert (found["network"]["separate"], found["torch_threads"]) == (True, 1)
    assert found["network"]["mlp"]["activation"] == "swish"
    assert learning["env_config"] == {
        "env_name": "InvertedPendulum-v5",
        "seed": 4,
        "num_threads": 1,
    }
    names.list_all_envs = list
    with pytest.raises(SystemExit, match="EnvPool 1 has no InvertedPendulum-v5"):
        run_script("rl_games", monkeypatch, tmp_path, capsys, **given)


MINATAR = {"env": "gymnax/Breakout-MinAtar", "arm": "ppo", "preset": "minatar"}


def test_peers_on_the_device_get_the_settings_of_the_run() -> None:
    config = resolve(MINATAR)
    for peer in GYMNAX_PEERS:
        found = peer_settings(peer, config)
        assert (found["envs"], found["rollout_steps"], found["minibatches"]) == (64, 128, 8)
        assert (found["activation"], found["entropy_coef"]) == ("relu", 0.01)
    with pytest.raises(BadInput, match="normalize_rewards: not read by purejaxrl, which has False"):
        peer_settings("purejaxrl", resolve({**MINATAR, "normalize_rewards": True}))
    with pytest.raises(BadInput, match="hidden: purejaxrl has no"):
        peer_settings("purejaxrl", resolve({**MINATAR, "hidden": "32"}))


SCRIPT = """
import json
import jax
import wrappers

def make_train(config):
    open(config["ENV_NAME"], "a").write(json.dumps(config) + chr(10))
    return lambda key: jax.random.normal(key, (2,))
"""


def test_purejaxrls_script_is_run_with_the_settings_of_the_run(tmp_path, monkeypatch) -> None:
    (tmp_path / "ppo.py").write_text(SCRIPT.replace('config["ENV_NAME"]', repr(f"{tmp_path}/log")))
    training = "from brax.envs.wrappers.training import EpisodeWrapper, AutoResetWrapper"
    (tmp_path / "wrappers.py").write_text(f"from brax import envs\n{training}\nimport navix as nx")
    settings = peer_settings("purejaxrl", resolve(MINATAR))
    found = peer_rate("purejaxrl", Path(sys.executable), tmp_path / "ppo.py", settings, 1, 1e-9)
    assert found > 0
    (config,) = map(json.loads, (tmp_path / "log").read_text().splitlines())
    assert config["ENV_NAME"] == "Breakout-MinAtar"
    assert config["TOTAL_TIMESTEPS"] == peer_jax.FEW * 64 * 128
    assert (config["NUM_MINIBATCHES"], config["UPDATE_EPOCHS"], config["LR"]) == (8, 4, 5e-3)
    assert config["ANNEAL_LR"] is True


def test_a_result_names_the_revision_of_a_peers_script(tmp_path, monkeypatch) -> None:
    script = tmp_path / "ppo.py"
    script.write_text(SCRIPT)
    monkeypatch.setattr(device, "prepare", lambda peer, say: Path(sys.executable))
    monkeypatch.setattr(device, "versions", lambda python: {})
    config = resolve({**MINATAR, "device": "cpu"})
    _, about = device._gymnax_peer("purejaxrl", config, script, print)
    assert about["script"] == hashlib.sha256(SCRIPT.encode()).hexdigest()[:12]
    assert "script" not in device._gymnax_peer("rejax", config, None, print)[1]


def test_rejax_is_created_with_the_settings_of_the_run(monkeypatch) -> None:
    agents: list[dict] = []

    class PPO:
        def __init__(self, **settings) -> None:
            agents.append(settings)

        create = replace = classmethod(lambda cls, **settings: cls(**settings))

        def train(self, key):
            return key, None

    rejax = SimpleNamespace(PPO=PPO)
    networks = SimpleNamespace(VNetwork=lambda hidden, activation: (hidden, activation.__name__))
    monkeypatch.setitem(sys.modules, "rejax", rejax)
    monkeypatch.setitem(sys.modules, "rejax.networks", networks)
    config = resolve({**MINATAR, "value_hidden": "32", "env_kwargs": '{"max_steps_in_episode": 9}'})
    settings = {**peer_settings("rejax", config), "env": "Breakout-MinAtar"}
    assert peer_jax.rejax_training(settings, 10)("key") == "key"
    created, replaced = agents
    assert (created["num_envs"], created["num_steps"], created["num_minibatches"]) == (64, 128, 8)
    assert created["agent_kwargs"] == {"hidden_layer_sizes": (64, 64), "activation": "relu"}
    assert created["env_params"].max_steps_in_episode == 9
    assert created["total_timesteps"] == created["eval_freq"] == 10 * 64 * 128
    assert [float(created["learning_rate"](n)) for n in (0, 320)] == [pytest.approx(5e-3), 0.0]
    assert replaced["critic"] == ((32,), "relu")


def test_a_training_is_prolonged_until_it_takes_the_seconds(monkeypatch) -> None:
    now, tried = [0.0], []

    def ran(result):
        now[0] += 0.1 * tried[-1]

    def training(iterations):
        tried.append(iterations)
        return lambda key: key

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr("jax.block_until_ready", ran)
    assert peer_jax.env_steps_per_second(training, 50, 15.0, 0) == pytest.approx(500)
    assert tried == [16, 180]


@pytest.mark.slow
def test_the_start_is_measured_with_the_preset_of_the_bench_and_without_evaluations() -> None:
    given = {"env": "LunarLander-v3", "eval_every": 500, "eval_episodes": 1, "stop_at": 3.0}
    expected = {"env": "LunarLander-v3", "preset": "mujoco", "steps": 2 * 2048}
    assert command.two_iterations(given) == expected  # `sauna train` alone picks another


def test_a_start_that_fails_is_one_line(monkeypatch) -> None:
    monkeypatch.setattr(command, "two_iterations", lambda given: {"env": "none"})
    with pytest.raises(SaunaError, match="bench: sauna train with these settings: exit 2"):
        command.start_and_memory({})


def test_a_whole_bench_writes_its_figures(tmp_path, capsys) -> None:
    file = tmp_path / "bench.json"
    small = ["--seeds=2", "--rounds=1", "--iterations=2", "--rollout-steps=64", "--minibatches=4"]
    cli.main(["bench", "InvertedPendulum-v5", *small, "--processes=1", f"--json={file}"])
    stored = json.loads(file.read_text())
    assert stored["rates"].keys() == {"training", "physics"}
    assert stored["machine"] and stored["versions"] and stored["peak_memory_mib"] > 50
    assert 0 < stored["seconds_to_first_env_step"] < stored["seconds_to_first_row"]
    assert "times raw mj_step" in capsys.readouterr().out
