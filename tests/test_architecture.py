"""Every import names a lower floor, and what a load can never reach."""

from __future__ import annotations

import ast
import functools

from structure import ROOT, between_entries, circles, module_edges

SOURCE = ROOT / "src" / "sauna"
edges = functools.cache(lambda: module_edges(SOURCE))  # not where tests are only collected

# From the ground up. A module belongs to the longest name here that begins its own; it may import
# modules of its own line and of lines above.
FLOORS = (
    "system",
    "config",
    "envs.registration",
    "envs.info",
    "envs.masked",
    "envs.pictures",
    "envs.shapes",
    "envs.flatten",
    "envs.spaces",
    "envs.actions",
    "envs.stacked",
    "envs.wrapping",
    "envs.device",
    "envs.flagrun",
    "envs.host",
    "envs.make",
    "envs",
    "algorithm",
    "algorithm.types",
    "algorithm.policy",
    "algorithm.selection",
    "algorithm.rollout",
    "algorithm.learner",
    "training.data",
    "training.artifact",
    "training.located",
    "training.summary",
    "training.loop.job",
    "training.loop",
    "training.check_selection",
    "training.check_plugins",
    "training.prepare",
    "training.worker",
    "training.display",
    "training.tracking.tracker",
    "training.tracking",
    "training.empty_updates",
    "training.extension",
    "training.cloning",
    "training.initial",
    "training.run",
    "training.info_names",
    "training.coordinator",
    "training.train",
    "training",
    "experiments.curves",
    "experiments.statistics",
    "experiments.compute",
    "experiments.sequential",
    "experiments.report",
    "experiments.run_list",
    "experiments.evaluate",
    "experiments.record",
    "experiments.measure",
    "experiments.inspect",
    "experiments.bench",
    "experiments.study",
    "experiments.tune",
    "experiments.share",
    "experiments.check",
    "experiments",
    "api",
    "cli",
    "__main__",
)


def floor(module: str) -> int:
    names = [name for name in FLOORS if f"{module}.".startswith(f"{name}.")]
    assert names, f"{module} has no floor"
    return FLOORS.index(max(names, key=len))


def test_every_import_names_a_lower_floor() -> None:
    upward = [
        f"{module} imports {other}"
        for module, imported in edges().items()
        if module
        for other in imported
        if floor(other) > floor(module)
    ]
    assert not upward


def test_no_circle_of_imports_and_few_entries() -> None:
    assert circles({name: others for name, others in edges().items() if name}) == []
    assert len(set(between_entries(edges())) - {"", "__main__"}) <= 8


def test_an_import_upwards_is_noticed() -> None:
    assert floor("algorithm.learner.ppo") > floor("algorithm.rollout.host")
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_the_science_knows_no_clock_no_files_and_no_environments() -> None:
    for part in ("policy", "selection", "learner"):
        for path in (SOURCE / "algorithm" / part).glob("*.py"):
            banned = {"time", "os", "pathlib", "gymnasium", "mujoco", "random", "io"}
            assert not libraries(ast.parse(path.read_text())) & banned, path


def test_no_pickle_and_no_evaluated_code_anywhere() -> None:
    for path in SOURCE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        unsafe = {"pickle", "cloudpickle", "dill", "shelve", "marshal", "yaml"}
        assert not libraries(tree) & unsafe, path
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec", "compile"), path
            if isinstance(node, ast.keyword):
                assert node.arg != "allow_pickle", path


def test_files_stay_readable() -> None:
    for path in SOURCE.rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 450, path


def libraries(tree: ast.Module) -> set[str]:
    """The top-level names of everything that a module imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
    return found
