"""Trials of a sweep without training: claims of several processes, sampled values, and damaged storage."""

import json
import os
import threading

import pytest

from rlcli.cli.ui.several_trainings import print_sweep
from rlcli.config.dump import preset_of
from rlcli.config.load import resolve
from rlcli.errors import CheckpointError, MachineError, UsageError
from rlcli.registry import find_task
from rlcli.tuning.optuna_storage import JOURNAL, storage_errors, without_password
from rlcli.tuning.search_space import read_parameters
from rlcli.tuning.sweep import open_sweep, read_sweep

pytestmark = pytest.mark.usefixtures("empty_folder")

PARAMS = ["agent.learning_rate=log:1e-4:1e-2", "agent.n_steps=8,16,32"]
SETTINGS = {
    **{"task": "cartpole", "name": "s", "agent": "ppo", "objective": "return", "direction": "maximize"},
    **{"pruner": "none", "trials": 12, "episodes": 4, "seed": 3, "params": PARAMS, "overrides": [], "flags": {}},
    "storage": None,
}
SOURCE = {"name": "cartpole", "distribution": "rlcli", "folder": None}


def open_or_join(folder, storage=None, source=SOURCE, **changes):
    settings = {**SETTINGS, "storage": storage and without_password(storage), **changes}
    return open_sweep(folder, settings, source, read_parameters(PARAMS), storage)


def finish(search, count):
    """Claim trials and complete them at once; return the values of each."""
    drawn = []
    for _ in range(count):
        trial = search.claim()
        drawn.append(trial.values)
        search.tell(trial, -abs(trial.values["agent.learning_rate"] - 1e-3))
    return drawn


def test_seed_determines_trials(tmp_path):
    first, again, other = (
        finish(open_or_join(tmp_path / name, seed=seed), 12) for name, seed in (("a", 3), ("b", 3), ("c", 4))
    )
    assert first == again
    assert not [values for values in first if values in other]
    assert len({values["agent.learning_rate"] for values in first}) == 12


def test_equal_objectives_of_all_trials_are_a_warning(tmp_path, capsys):
    sweep = open_or_join(tmp_path)
    sweep.tell(sweep.claim(), 0.0)
    print_sweep(sweep)
    assert "same objective" not in capsys.readouterr().err  # a single trial
    sweep.tell(sweep.claim(), 0.0)
    print_sweep(sweep)
    assert "warning: all trials have the same objective, return = 0: the budget" in capsys.readouterr().err
    sweep.tell(sweep.claim(), 0.5)
    print_sweep(sweep)
    assert "same objective" not in capsys.readouterr().err


def test_equal_successes_of_one_are_a_warning_of_a_long_budget(tmp_path, capsys):
    sweep = open_or_join(tmp_path, objective="success@5s")
    for _ in range(2):
        sweep.tell(sweep.claim(), 1.0)
    print_sweep(sweep)
    assert "success@5s = 1: the budget may be too long" in capsys.readouterr().err


def test_trial_values_depend_on_number_not_process(tmp_path):
    alone = finish(open_or_join(tmp_path / "alone"), 6)
    one, other = open_or_join(tmp_path / "both"), open_or_join(tmp_path / "both")
    trials = [search.claim() for search in (one, other, other, one, other, one)]
    assert [trial.number for trial in trials] == [0, 1, 2, 3, 4, 5]
    assert [trial.values for trial in trials] == alone


def test_abandoned_trial_keeps_its_values(tmp_path):
    gone, other = open_or_join(tmp_path), open_or_join(tmp_path)
    left = gone.claim()
    assert other.claim().number == 1, "a claimed trial belongs to one process"
    gone.release()
    taken = other.claim()
    assert (taken.number, taken.values, taken.folder) == (0, left.values, left.folder)


def test_trial_ending_during_claim_is_not_restarted(tmp_path):
    one, other = open_or_join(tmp_path), open_or_join(tmp_path)
    trial = one.claim()
    seen = other.trials()
    one.tell(trial, 1.0)
    fresh = type(other).trials

    def stale_once(search, answers=[seen]):  # noqa: B006
        return answers.pop() if answers else fresh(search)

    type(other).trials = stale_once
    try:
        assert other.claim().number == 1
    finally:
        type(other).trials = fresh


def test_concurrent_claims_start_each_trial_once(tmp_path):
    started, errors = [], []

    def work():
        try:
            search = open_or_join(tmp_path)
            while (trial := search.claim()) is not None:
                started.append(trial.number)
                search.tell(trial, 1.0)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert sorted(started) == list(range(12))


def test_number_of_trials_can_grow(tmp_path):
    finish(open_or_join(tmp_path, trials=2), 2)
    more = open_or_join(tmp_path, trials=3)
    assert len(finish(more, 1)) == 1
    assert more.claim() is None
    assert open_or_join(tmp_path, trials=2).claim() is None


def test_surplus_trial_of_other_machine_does_not_count(tmp_path):
    storage = f"sqlite:///{tmp_path / 'trials.db'}"
    here, there = (open_or_join(tmp_path / name, storage, trials=1) for name in ("here", "there"))
    held = here.claim()
    fresh = type(there).trials
    answers = [[], []]  # the other machine sees no trial yet
    type(there).trials = lambda search: answers.pop() if answers else fresh(search)
    try:
        assert there.claim() is None
    finally:
        type(there).trials = fresh
    here.tell(held, 1.0)
    assert [trial.number for trial in here.trials()] == [0]
    assert len(finish(open_or_join(tmp_path / "here", storage, trials=2), 1)) == 1, "the surplus trial does not count"


def test_partial_journal_line_is_dropped(tmp_path):
    drawn = finish(open_or_join(tmp_path), 3)
    journal = tmp_path / JOURNAL
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code":4,"wor' + b"x" * 10_000)
    search = open_or_join(tmp_path)
    assert [search.values(trial) for trial in search.trials()] == drawn
    finish(search, 2)
    assert [json.loads(line)["op_code"] for line in journal.read_bytes().splitlines()]
    assert len(read_sweep(tmp_path).ended()) == 5


TWO_ATTRIBUTES = b'{"op_code":2,"worker_id":"w","study_id":0,"user_attr":{"a":1,"b":2}}\n'


@pytest.mark.parametrize("damage", [b"nonsense\n", b"{}\n", b"5\n", b"\xff\xfe\n", b"\n", TWO_ATTRIBUTES])
def test_corrupt_journal_is_checkpoint_error(tmp_path, damage):
    finish(open_or_join(tmp_path), 2)
    with (tmp_path / JOURNAL).open("ab") as journal:
        journal.write(damage)
    for look in (lambda: open_or_join(tmp_path).trials(), lambda: read_sweep(tmp_path).trials()):
        with pytest.raises(CheckpointError, match=f"{JOURNAL} is corrupt"):
            look()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *((b'"values":[', b'"values":[' + value + b",") for value in (b"1.0",)),
        *((b'"values":[-', b'"values":[' + value) for value in (b'"latest",-', b"null,-", b"[1],-", b"true,-")),
        (b'"values":[-0.', b'"values":[1e999'),
        (b'"param_name":"agent.n_steps"', b'"param_name":"agent.steps"'),
    ],
)
def test_damaged_result_is_checkpoint_error(tmp_path, old, new):
    finish(open_or_join(tmp_path), 1)
    content = (tmp_path / JOURNAL).read_bytes()
    assert old in content
    (tmp_path / JOURNAL).write_bytes(content.replace(old, new))
    with pytest.raises(CheckpointError, match="corrupt: trial 0"):
        read_sweep(tmp_path).trials()


def tree(folder):
    """Path of each entry below a folder -> content of the file; None for folders."""
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.mark.parametrize(
    "name",
    [
        *("trial-0001", "compare-default-seed-0", "trial-0000/checkpoints", "trial-0000/checkpoints/logs"),
        *("trial-0000/train.log", "trial-0000/.worker", "study.json", "journal.log", "best.yaml", ".sweep"),
    ],
)
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_sweep_with_a_link_or_pipe_is_refused_and_nothing_is_written(tmp_path, name, kind, cli):
    sweep, victim = tmp_path / "sweep", tmp_path / "victim"
    finish(open_or_join(sweep), 1)
    (victim / "checkpoints").mkdir(parents=True)
    (victim / "config.yaml").write_text("kept")
    entry = sweep / name
    entry.parent.mkdir(exist_ok=True)
    entry.unlink(missing_ok=True)
    if kind == "link":
        entry.symlink_to(victim if "." not in entry.name else victim / "config.yaml")
    else:
        os.mkfifo(entry)
    before = tree(tmp_path)
    for look in (open_or_join, read_sweep):
        with pytest.raises(CheckpointError, match=f"{entry.name} is (a link|not a regular file)"):
            look(sweep)
    for words in (("show", sweep), ("compare", sweep)):
        assert cli("sweep", *words).code == 5
    assert tree(tmp_path) == before


def test_missing_journal_is_checkpoint_error(tmp_path):
    finish(open_or_join(tmp_path), 2)
    (tmp_path / JOURNAL).unlink()
    for look in (open_or_join, read_sweep):
        with pytest.raises(CheckpointError, match=r"the sweep .* is damaged: the file .* with its trials is missing"):
            look(tmp_path)


@pytest.mark.parametrize(
    "change", [{"params": ["agent.gamma=0.9:0.99"]}, {"pruner": "median"}, {"seed": 4}, {"overrides": ["a=1"]}]
)
def test_different_settings_in_same_folder_are_refused(tmp_path, change):
    open_or_join(tmp_path)
    with pytest.raises(UsageError, match="is a sweep with other settings"):
        open_or_join(tmp_path, **change)


def test_task_from_other_folder_is_other_sweep(tmp_path):
    open_or_join(tmp_path, source={"name": "cartpole", "distribution": None, "folder": "/one"})
    with pytest.raises(UsageError, match="is a sweep with other settings"):
        open_or_join(tmp_path, source={"name": "cartpole", "distribution": None, "folder": "/two"})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("params", value) for value in ([{}], [[]], {}, "a", None, ["a"], ["agent.gamma=0.9:0.8"])),
        *(("overrides", [1]), ("flags", []), ("source", {}), ("source", {"name": 1}), ("trials", "3"), ("seed", -1)),
        *(("direction", "up"), ("pruner", 1), ("objective", "a\nb"), ("storage", {}), ("config", 1)),
    ],
)
def test_wrong_type_in_study_file_is_checkpoint_error(tmp_path, key, value, cli):
    open_or_join(tmp_path)
    record = json.loads((tmp_path / "study.json").read_text())
    (tmp_path / "study.json").write_text(json.dumps({**record, key: value}))
    for form in ((), ("--json",)):
        done = cli("sweep", "show", tmp_path, *form)
        assert done.code == 5
        assert f"study.json is corrupt: {key}" in (done.out if form else done.err)


@pytest.mark.parametrize("value", [[[]], [], 1, "text", {"params": [[]]}])
def test_wrong_type_of_the_settings_in_the_journal_is_checkpoint_error(tmp_path, value):
    open_or_join(tmp_path)
    journal = tmp_path / JOURNAL
    entries = [json.loads(line) for line in journal.read_text().splitlines()]
    entries[-1]["user_attr"] = {"rlcli": value}
    journal.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    with pytest.raises(CheckpointError, match=r"journal\.log is corrupt: rlcli"):
        open_or_join(tmp_path)


@pytest.mark.parametrize(
    "entry",
    [
        {"op_code": 7, "step": 1, "intermediate_value": "high"},
        {"op_code": 5, "param_name": "agent.n_steps", "param_value_internal": 0, "distribution": "CHOICE"},
        {"op_code": 5, "param_name": "agent.learning_rate", "param_value_internal": 0, "distribution": "CHOICE"},
        {"op_code": 8, "user_attr": {"seconds": [1]}},
    ],
)
def test_wrong_value_of_a_running_trial_is_checkpoint_error(tmp_path, entry):
    open_or_join(tmp_path).study.ask()
    choice = json.dumps({"name": "CategoricalDistribution", "attributes": {"choices": ["x", "y"]}})
    entry = {"worker_id": "w", "trial_id": 0, **{k: choice if v == "CHOICE" else v for k, v in entry.items()}}
    with (tmp_path / JOURNAL).open("a") as journal:
        journal.write(json.dumps(entry) + "\n")
    with pytest.raises(CheckpointError, match="is corrupt: trial 0"):
        read_sweep(tmp_path).trials()


@pytest.mark.parametrize("text", ["{", "[]", '{"kind": "sweep", "task": "cartpole"}', '{"kind": "seeds", "task": "a"}'])
def test_malformed_study_file_is_checkpoint_error(tmp_path, text):
    open_or_join(tmp_path)
    (tmp_path / "study.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"study\.json|is of kind seeds"):
        read_sweep(tmp_path)


def test_lost_database_is_machine_error_without_password(tmp_path):
    file = tmp_path / "trials.db"
    search = open_or_join(tmp_path / "sweep", f"sqlite:///{file}")
    trial = search.claim()
    file.write_bytes(b"")
    for use in (search.trials, search.claim, lambda: search.tell(trial, 1.0)):
        with pytest.raises(MachineError, match="cannot be reached") as caught, storage_errors("x://me:secret@host/y"):
            use()
        assert "secret" not in caught.value.message
        assert "to continue" in caught.value.hint


def test_preset_writes_whole_list_for_changed_element():
    resolved = resolve(find_task("cartpole"), agent="ppo", overrides=["agent.actor.hidden.0=8", "sim.dt=0.01"])
    hidden = list(resolved.agent.actor.hidden)
    assert hidden[0] == 8
    assert preset_of(resolved, names_agent=False) == {"agent": {"actor": {"hidden": hidden}}, "sim": {"dt": 0.01}}
