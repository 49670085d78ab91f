"""The run above a group: one per digest, also when several processes ask at once; its children are adopted once."""

import sys

import pytest
import warm_starter

from attentionvote.tracking.group_run import GROUP_TAG, adopt, open_group
from attentionvote.tracking.run_opening import start_run
from attentionvote.tracking.store import connect


@pytest.mark.parametrize("store", ["sqlite", "postgresql"], indirect=True)
def test_the_same_group_is_the_same_run_and_another_is_another(store, tmp_path):
    client = connect(store)
    run = open_group(store, "grids", "lr=1,2", "abc", tags={"grid": "lr=1,2"}, config_yaml="lr: 1\n")
    assert run.download("config.yaml", tmp_path).read_text() == "lr: 1\n"  # the first session, not a resumed one
    run.close("FAILED")
    again = open_group(store, "grids", "another name", "abc")
    assert again.id == run.id
    stored = client.get_run(run.id)
    assert (stored.info.run_name, stored.info.status) == ("lr=1,2", "RUNNING")
    assert (stored.data.tags[GROUP_TAG], stored.data.tags["grid"], stored.data.tags["sessions"]) == (
        "abc", "lr=1,2", "1",
    )  # fmt: skip
    again.close()
    other = open_group(store, "grids", "lr=3", "abd")
    other.close()
    assert other.id != run.id


@pytest.mark.slow
def test_two_processes_at_once_get_one_run(store):
    start_run(store, "grids", system_interval_s=0).close()  # the tables are there
    code = (
        "import sys; from attentionvote.tracking.group_run import open_group\n"
        "sys.stdin.readline(); run = open_group(sys.argv[1], 'grids', 'g', 'race'); print(run.id); run.close()"
    )
    processes = [
        warm_starter.Popen([sys.executable, "-c", code, store], stdin=-1, stdout=-1, stderr=-1, text=True)
        for _ in range(2)
    ]
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    outputs = [process.communicate(timeout=100) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    assert outputs[0][0] == outputs[1][0]


@pytest.mark.parametrize("store", ["sqlite", "postgresql"], indirect=True)
def test_a_child_is_adopted_once_and_a_lost_one_is_a_warning(store, caplog):
    client = connect(store)
    child = start_run(store, "rod", system_interval_s=0)
    child.close()
    adopt(store, "first", child.id, {"sweep.state": "pruned"})
    adopt(store, "second", child.id, {"sweep.state": "complete"})
    tags = client.get_run(child.id).data.tags
    assert (tags["mlflow.parentRunId"], tags["sweep.state"]) == ("first", "complete")
    adopt(store, "first", "nobody", {})
    assert "run nobody could not be put below first" in caplog.text
