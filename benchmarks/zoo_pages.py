"""Write the generated parts of docs/reference/zoo/*.md: task card, results and learning curves."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from rlcli.config.load import resolve
from rlcli.registry import OWN, catalog, find_task
from rlcli.reporting.task_card import markdown, task_card

BLOCKS = ("card", "results", "curves")


def built_in() -> list[str]:
    """Return the names of the built-in tasks whose package is installed."""
    from rlcli.errors import TaskError

    found = []
    for entry in catalog()[0]:
        if entry.distribution == OWN:
            try:
                find_task(entry.qualified)
            except TaskError:
                continue
            found.append(entry.name)
    return found


def write_all(zoo: Path, entries: Mapping[str, Any]) -> None:
    """Update the generated blocks of every page and write the index."""
    tasks = [name for name in built_in() if name in entries]
    for name in tasks:
        file = zoo / f"{name}.md"
        if not file.is_file():
            print(f"{file} is not written yet")
            continue
        before = file.read_text(encoding="utf-8")
        after = filled(before, zoo, entries[name])
        if after != before:
            file.write_text(after, encoding="utf-8")
            print(file)
    (zoo / "index.md").write_text(index(zoo, [entries[name] for name in tasks]), encoding="utf-8")
    print(zoo / "index.md")


def filled(text: str, zoo: Path, entry: Any) -> str:
    """Return the page with up-to-date generated blocks."""
    made = {"card": card(entry.name), "results": results(zoo, entry), "curves": curves(zoo, entry)}
    for block in BLOCKS:
        text = re.sub(
            rf"<!-- {block} -->\n.*?<!-- end {block} -->",
            lambda _, block=block: f"<!-- {block} -->\n{made[block]}<!-- end {block} -->",
            text,
            flags=re.DOTALL,
        )
    return text


def block(text: str, name: str) -> str | None:
    """Return the content of a block, or None if the page has no such block."""
    found = re.search(rf"<!-- {name} -->\n(.*?)<!-- end {name} -->", text, re.DOTALL)
    return None if found is None else found[1]


def card(task: str) -> str:
    """Return the folded table of the task's terms."""
    source = find_task(task)
    resolved = resolve(source)
    file = source.config.with_name(f"{source.config.stem}.layout.json")
    layout = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
    _, _, text = markdown(task_card(resolved, layout), level=2).partition("\n\n")
    summary = "Observations, actions, rewards and terminations"
    terms, schema = "[Terms](../terms/index.md)", "[Task schema](../task-schema.md)"
    links = f"{terms} explains the parameters of each term, {schema} other keys."
    return f"<details>\n<summary>{summary}</summary>\n\n{text.rstrip()}\n\n{links}\n\n</details>\n"


def rows_of(zoo: Path, task: str) -> list[dict[str, Any]]:
    """Return the results of a task; an empty list if it has none."""
    file = zoo / "results" / f"{task}.json"
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else []


def results(zoo: Path, entry: Any) -> str:
    """Return the required result and a table with one row per seed."""
    where = "one H200" if entry.device == "cuda" else "two CPU cores"
    held = (
        f"Required result: {bars(entry)}, over {entry.episodes:,} episodes, after at most {entry.minutes:g} min of"
        f" training on {where} ([tier {entry.tier}](index.md)). `make learn-{entry.name}`, in a checkout of rlcli,"
        " trains the task and compares the result with the required one.\n"
    )
    rows = rows_of(zoo, entry.name)
    if not rows:
        return f"{held}\nNot trained yet.\n"
    names = list(dict.fromkeys(["success", *entry.bar])) if "success" in rows[0]["evaluation"] else list(entry.bar)
    bar = ["bar reached after"] if any("until" in row for row in rows) else []
    lines = [
        f"| seed | agent | machine | steps | minutes | {' | '.join([*bar, *names])} | return |",
        "| ---: | --- | --- | ---: | ---: |" + " ---: |" * (len(bar) + len(names) + 1),
    ]
    for row in rows:
        numbers = [
            *(to_bar(row.get("until")) for _ in bar),
            *(with_interval(row["evaluation"], name) for name in names),
        ]
        trained = f"{row['steps'] / 1e6:.3g} M | {row['minutes']:.3g}"
        lines.append(
            f"| {row['seed']} | `{row['agent']}` | {row['machine']} | {trained} | {' | '.join(numbers)} |"
            f" {row['evaluation']['return']['mean']:.4g} |"
        )
    versions = ", ".join(f"{name} {version}" for name, version in rows[0]["versions"].items())
    commands: dict[str, list[str]] = {}
    for row in rows:
        commands.setdefault(re.sub(r"--seed[ =]\d+", "--seed N", row["command"]), []).append(str(row["seed"]))
    other_form = " (the other form)"
    said = "; ".join(
        f"`{command.removesuffix(other_form)}`"
        + (
            ", the other form of this task; the policy was evaluated in this form"
            if command.endswith(other_form)
            else ""
        )
        + (f" (N = {', '.join(seeds)})" if len(commands) > 1 else "")
        for command, seeds in commands.items()
    )
    return (
        f"{held}\n"
        + "\n".join(lines)
        + f"\n\nTrained with {said}; {versions}. Numbers in brackets are 95 % intervals.\n"
    )


def bars(entry: Any) -> str:
    """Format the required result as text."""
    return ", ".join(
        f"{name} <= {bound['max']:g}" if isinstance(bound, dict) else f"{name} >= {bound:g}"
        for name, bound in entry.bar.items()
    )


def to_bar(until: dict[str, Any] | None) -> str:
    """Format the steps and the time that a training with `--until` took to its bar."""
    if until is None:
        return "-"
    if not until["reached"]:
        return f"{until['bar']}: not reached"
    return f"{until['bar']}: {until['step'] / 1e6:.3g} M, {until['seconds'] / 60:.2g} min"


def with_interval(evaluation: dict[str, Any], name: str) -> str:
    """Format a value with its interval."""
    found = evaluation.get(name)
    if found is None:
        values = evaluation.get("values", {})
        found = values.get(name) or next((v for key, v in values.items() if key.rpartition("/")[2] == name), None)
    if found is None:
        return "-"
    middle = found.get("rate", found.get("mean"))
    if middle is None or found["low"] is None:
        return "-"
    return f"{middle:.4g} ({found['low']:.3g} .. {found['high']:.3g})"


def curves(zoo: Path, entry: Any) -> str:
    """Return the picture of the shipped policy and the learning curves."""
    parts = []
    if (zoo / "pictures" / f"{entry.name}.jpg").is_file():
        parts.append(
            f"![{entry.name}: the shipped policy](pictures/{entry.name}.jpg)\n\nThe picture shows"
            f" {entry.picture:g} s of the policy that comes with rlcli. `rlcli play {entry.name} --video` records"
            " a video.\n"
        )
    if (zoo / "curves" / f"{entry.name}.svg").is_file():
        parts.append(
            f"![learning curves of {entry.name}](curves/{entry.name}.svg)\n\nEach panel shows a metric of the training"
            " episodes, with exploration noise, over the steps of all environments together. With several seeds, thin"
            " lines are the seeds and the thick line is their median. Data:"
            f" [curves/{entry.name}.csv](curves/{entry.name}.csv).\n"
        )
    return "\n".join(parts)


def fresh_seeds(zoo: Path) -> list[str]:
    """Return the table of trainings with seeds on which nothing was tuned, as lines."""
    document = yaml.safe_load((zoo / "fresh_seeds.yaml").read_text(encoding="utf-8"))
    lines = [
        "## Seeds on which nothing was tuned",
        "",
        "The settings of the tasks were chosen with other seeds than these. The table has the success rate after",
        "`rlcli train TASK --seed N`, over 1,000 episodes without exploration noise, and the time of the slowest",
        "seed. Empty cells, and tasks that the table lacks, are not measured yet.",
        "",
        f"| task | {' | '.join(f'seed {seed}' for seed in document['seeds'])} | longest training | machine |",
        f"| --- | {'---: | ' * len(document['seeds'])}---: | --- |",
    ]
    for task, row in document["tasks"].items():
        longest = f"{row['minutes']:.1f} min" if "minutes" in row else "below 1 min"
        measured = [f"{value:.3f}" for value in row["success"]]
        values = " | ".join([*measured, *["" for _ in document["seeds"][len(measured) :]]])
        lines.append(f"| [{task}]({task}.md) | {values} | {longest} | {row.get('machine', '2 CPU cores')} |")
    lines += ["", "What limits the seeds below 0.95:", ""]
    lines += [f"- {task}: {row['limit']}" for task, row in document["tasks"].items() if "limit" in row]
    return [*lines, ""]


def index(zoo: Path, found: list[Any]) -> str:
    """Return the page with the table of all tasks."""
    lines = [
        "# Built-in tasks",
        "",
        "After reading this page you can choose a task to start from. `rlcli play TASK` shows the policy that comes",
        "with a task, and `rlcli train TASK` trains a new one. A task's page has its model, parameters, learning",
        "curves and results.",
        "",
        "Go1 and G1 are in a plugin: see [Train robots of MuJoCo Menagerie](../../guides/menagerie.md).",
        "",
        "```{toctree}",
        ":hidden:",
        "",
        *(entry.name for entry in found),
        "peers",
        "```",
        "",
        "Each task has a required result, in brackets, and a time limit for the training:",
        "",
        "- Tier A: three seeds reach the full goal within the time limit.",
        "- Tier B: one seed reaches a lower goal within the time limit.",
        "",
        "The column *observations, actions* has the sizes of the two vectors. Several values in a cell are",
        "those of several seeds. The time is that of the slowest seed; the page of a task names the machine of each",
        "training. The values are:",
        "",
        "| value | meaning |",
        "| --- | --- |",
        "| success | share of successful episodes; the page of a task defines its success |",
        "| error_vel_xy, error_vel_yaw | mean errors of the velocity command [m/s], [rad/s] |",
        "| speed | mean speed towards the target [m/s] |",
        "| successes | mean number of goals reached in an episode |",
        "",
        "*Manager-based* tasks are [lists of terms](../../tutorials/first-task.md), *direct* tasks are",
        '[one Python class](../../tutorials/direct-task.md). "Isaac Lab\'s parameters" means that the rewards, limits',
        "and gains are those of Isaac Lab's task; the page of a task lists the differences. OmniIsaacGymEnvs is an",
        "older collection of tasks for Isaac Sim.",
        "",
        "| task | what the policy does | observations, actions | machine of the limit, time (of the limit) "
        "| result (required) |",
        "| --- | --- | --- | --- | --- |",
    ]
    shipped = _index_json()
    for entry in found:
        known = shipped.get(entry.name, {})
        rows = rows_of(zoo, entry.name)
        image = (
            f"![{entry.name}](pictures/{entry.name}.jpg)" if (zoo / "pictures" / f"{entry.name}.jpg").is_file() else ""
        )
        page = f"[{entry.name}]({entry.name}.md)" if (zoo / f"{entry.name}.md").is_file() else entry.name
        machine = "one H200" if entry.device == "cuda" else "two CPU cores"
        lines.append(
            f"| {page} {image} | {known.get('summary', '')} |"
            f" {known.get('observation_size', '?')}, {known.get('action_size', '?')} |"
            f" {machine}, {_minutes(rows, entry)} min | {_outcome(rows, entry)} ({bars(entry)}), tier {entry.tier} |"
        )
    lines += [
        "",
        *fresh_seeds(zoo),
        "- `make learn-TASK` trains a task and compares the result with the required one in [zoo.yaml](zoo.yaml).",
        "- [Scores of other libraries](peers.md) compares results on Gymnasium's tasks.",
    ]
    return "\n".join(lines) + "\n"


def _minutes(rows: list[dict[str, Any]], entry: Any) -> str:
    if not rows:
        return f"of {entry.minutes:g}"
    taken = f"{max(row['minutes'] for row in rows):.2g}"
    elsewhere = sorted({row["device"] for row in rows} - {entry.device})
    return f"{taken} on {elsewhere[0]}; of {entry.minutes:g}" if elsewhere else f"{taken} of {entry.minutes:g}"


def _outcome(rows: list[dict[str, Any]], entry: Any) -> str:
    if not rows:
        return "not trained yet"
    found = []
    for name in entry.bar:
        texts = [with_interval(row["evaluation"], name).partition(" ")[0] for row in rows]
        found.append(f"{name} {', '.join(texts)}")
    return "; ".join(found)


def _index_json() -> dict[str, Any]:
    from rlcli.registry.probe import cached_details

    own = [entry for entry in catalog()[0] if entry.distribution == OWN]
    return {name.partition(":")[2]: row.record() for name, row in cached_details(own).items()}
