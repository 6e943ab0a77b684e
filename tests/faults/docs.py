"""The figures of `docs/concepts/reliability.md`, from the files under `results/`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
# What the worst time of each row is the time of, as the docstring of the row's experiment says.
TIMED = {
    1: "a load",
    2: "from a resume's start to its first new row",
    3: "a load",
    4: "CPU, a refusal",
    5: "a refusal",
    6: "from the bad number to the error",
    7: "an update",
    8: "from the fault to the error; a hang: beyond its deadline",
    9: "from the first signal to the process's end",
    10: "from the failing operation to the command's end",
    11: "until the losers have ended",
    12: "CPU, an answer",
    13: "the study's last part, not interrupted",
    14: "a resume",
    15: "CPU, a refusal",
}


def write(page: Path, stored: dict[str, Any]) -> None:
    """Puts what was measured between the page's markers; what was not says so."""
    text = page.read_text()
    for name, lines in (
        ("campaign", _campaign(stored)),
        ("mutants", _mutants()),
        ("soak", _soak()),
        ("checks", _checks()),
    ):
        begin, end = f"<!-- {name} begin -->\n", f"<!-- {name} end -->"
        head, _, rest = text.partition(begin)
        text = head + begin + "\n".join(lines) + "\n" + end + rest.partition(end)[2]
    page.write_text(text)


def _campaign(stored: dict[str, Any]) -> list[str]:
    lines = ["| row | tried | lost | silent | worst time | of that |", "|---|---|---|---|---|---|"]
    for number, row in stored["rows"].items():
        notes = ", ".join(f"{name} {value:,}" for name, value in row["notes"].items())
        lines.append(
            f"| {int(number)} {row['row']} | {row['tried']:,} | {row['lost']} | "
            f"{row['silent']} | {row['worst']:.3g} s: {TIMED[int(number)]} | {notes} |"
        )
    machines = {
        f"{row['machine']['processor']}, {row['machine']['cores']} cores"
        for row in stored["rows"].values()
    }
    sources = {row["sources"] for row in stored["rows"].values()}
    lines += [
        "",
        f"Measured on: {'; '.join(sorted(machines))}. Each row was measured with the "
        f"package as it was then ({len(sources)} states of it; `results/reliability.json` "
        f"names each row's).",
    ]
    return lines


def _load(name: str) -> dict[str, Any] | None:
    path = ROOT / "results" / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def _mutants() -> list[str]:
    found = _load("mutants")
    if found is None:
        return ["Not measured yet."]
    rest = found["mutants"] - found["equivalent"]
    lines = [
        f"{found['caught']} of {rest} are caught ({found['share']:.1%}); "
        f"{found['equivalent']} more make the same program."
    ]
    for row in found["rows"]:
        if row["caught_by"] is None:
            why = row["equivalent"] or "not caught"
            lines.append(f"- `{row['name']}`: {why}")
    return lines


def _soak() -> list[str]:
    found = _load("soak")
    if found is None:
        return ["Not measured yet."]
    lines = [
        f"`{found['command']}`, {found['hours']:.2f} hours, {found['env_steps']:,} env steps.",
        "",
        "| of all its processes | mean | largest | change per hour (95%) |",
        "|---|---|---|---|",
    ]
    units = {"memory": "MiB of memory", "files": "open files", "threads": "threads"}
    for name, row in found["slopes"].items():
        change = f"{row['per_hour']:+.2f} ({row['low']:+.2f} to {row['high']:+.2f})"
        lines.append(f"| {units[name]} | {row['mean']:,.1f} | {row['largest']:,.1f} | {change} |")
    return lines


def _checks() -> list[str]:
    found = _load("checks")
    if found is None:
        return ["Not measured yet."]
    host, device = found["host"], found["device"]
    lines = [
        f"Shares of the time of a training ({host['env']}, one process):",
        "",
        "| seeds | finite checks | logging | checkpoints, with their hashing | all |",
        "|---|---|---|---|---|",
    ]
    for members, part in host["members"].items():
        shares = (f"{part[name]:.2%}" for name in ("checks", "logging", "checkpoints", "all"))
        lines.append(f"| {members} | {' | '.join(shares)} |")
    return [
        *lines,
        "",
        f"Compiled in: {max(found['update'], 0.0):.2%} of an update, and "
        f"{max(device['share'], 0.0):.2%} of an iteration on the device ({device['env']}, "
        f"{device['envs']} environments).",
    ]
