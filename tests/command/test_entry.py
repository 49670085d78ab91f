"""The shared entry as a user meets it: a process, its exit code, one sentence on stderr, one line on stdout."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from attentionvote.command.entry import configuring
from attentionvote.command.errors import ConfigurationError

PIPELINES = Path(__file__).resolve().parents[2] / "pipelines"
REAL_VERBS = sorted(
    p.stem
    for p in PIPELINES.glob("*.py")
    if "from attentionvote.command.entry import command" in p.read_text(encoding="utf-8")
)
SCRIPT = '''
"""A verb that does what it is told."""
import logging, os, sys, time
from pathlib import Path
from attentionvote.command.entry import command, configuring
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar
from attentionvote.command.configuration import VerbSettings
from attentionvote.setting import Setting
@dataclass(frozen=True)
class Rate:
    lr: Annotated[float, Setting("Rate.", above=0, high=10)]
@dataclass(frozen=True, kw_only=True)
class FakeSettings(VerbSettings):
    verb: ClassVar[str] = "fake"
    object: Annotated[dict[str, str], Setting("Part.")]
    trainer: Rate
    do: Annotated[str, Setting("What.")]
log = logging.getLogger("attentionvote.fake")
def run(cfg):
    print("a library prints"); os.system("echo a child prints"); log.info("working")
    if cfg.do == "bad data": raise ValueError("the cloud must be finite, got 3 NaN")
    if cfg.do == "disk": raise OSError(28, "No space left on device")
    if cfg.do == "bug": {{}}["missing"]
    if cfg.do == "mesh":
        with configuring("object gear"): open("nowhere.stl")
    if cfg.do == "wait": print("ready", file=sys.stderr, flush=True); time.sleep(60)
    if cfg.do == "lightning":
        try: raise KeyboardInterrupt
        except KeyboardInterrupt: sys.exit(1)
    import numpy as np
    return {{"stage": "fake", "object": cfg.object["name"], "lr": np.float64(cfg.trainer.lr), "do": cfg.do}}
def defaults(words):
    return [] if any(w.startswith("do=") for w in words) else ["do=default of the machine"]
if __name__ == "__main__":
    command(FakeSettings, run, defaults=defaults, conf=Path({conf!r}))
'''


@pytest.fixture
def verb(tmp_path: Path) -> Path:
    """A script with its configuration folder."""
    (tmp_path / "conf" / "object").mkdir(parents=True)
    primary = 'defaults: [_self_, {object: "???"}]\ntrainer: {lr: 0.001}\ndo: it\n'
    (tmp_path / "conf" / "fake.yaml").write_text(primary, encoding="utf-8")
    (tmp_path / "conf" / "object" / "gear.yaml").write_text("name: gear\n", encoding="utf-8")
    script = tmp_path / "fake.py"
    script.write_text(SCRIPT.format(conf=str(tmp_path / "conf")), encoding="utf-8")
    return script


def call(script: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The script in a process of its own, in its own folder."""
    command = [sys.executable, str(script), *words]
    return subprocess.run(command, cwd=script.parent, capture_output=True, text=True, timeout=60, check=False)


def test_the_only_line_on_stdout_is_the_result(verb: Path) -> None:
    done = call(verb, "object=gear", "do=it")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"stage": "fake", "object": "gear", "lr": 0.001, "do": "it"}
    assert done.stdout.count("\n") == 1
    for text in ("a library prints", "a child prints", "working"):
        assert text in done.stderr


def test_the_machines_default_is_weaker_than_the_users_word(verb: Path) -> None:
    assert json.loads(call(verb, "object=gear").stdout)["do"] == "default of the machine"
    assert json.loads(call(verb, "object=gear", "do=mine").stdout)["do"] == "mine"


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["object=gaer"], 2, "fake: object must be one of gear; got 'gaer', did you mean 'gear'?"),
        (
            ["object=gear", "trainer.lr=abc"],
            2,
            "fake: trainer.lr must be a number greater than 0 and at most 10; got 'abc'",
        ),
        (["object=gear", "do=mesh"], 2, "fake: object gear: file not found: nowhere.stl"),
        (["object=gear", "do=lightning"], 130, "fake: interrupted; run the same command to resume"),
        (["object=gear", "do=bad data"], 1, "fake: the cloud must be finite, got 3 NaN (details in outputs/logs/"),
        (["object=gear", "do=disk"], 1, "fake: the disk of "),
        (["object=gear", "do=bug"], 1, "fake: KeyError: 'missing' (details in outputs/logs/"),
    ],
)
def test_errors_are_one_sentence_and_an_exit_code(verb: Path, words: list[str], code: int, expected: str) -> None:
    done = call(verb, *words)
    assert done.returncode == code
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith(expected)
    assert ("working" in done.stderr) is ("do=" in words[-1])  # what is misspelt is said before any work
    logs = list((verb.parent / "outputs" / "logs").glob("*.log"))
    assert len(logs) == (code == 1)
    if logs:
        assert f"outputs/logs/{logs[0].name}" in done.stderr
        assert "Traceback" in logs[0].read_text(encoding="utf-8")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_says_once_how_to_go_on(verb: Path, number: int, code: int) -> None:
    process = subprocess.Popen(
        [sys.executable, str(verb), "object=gear", "do=wait"],
        cwd=verb.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    while "ready" not in process.stderr.readline():
        assert process.poll() is None
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == code
    assert out == ""
    assert err.strip().endswith("fake: interrupted; run the same command to resume")
    assert err.count("interrupted") == 1


def test_hydras_own_flags_still_work(verb: Path) -> None:
    done = call(verb, "--cfg", "job", "object=gear")
    assert done.returncode == 0, done.stderr
    assert "lr: 0.001" in done.stdout


def test_help_names_groups_choices_and_settings(verb: Path) -> None:
    done = call(verb, "--help")
    assert done.returncode == 0, done.stderr
    for text in ("A verb that does what it is told.", "object=  gear", "trainer.lr=0.001", 'do="it"'):
        assert text in done.stdout


@pytest.mark.parametrize("name", REAL_VERBS)
def test_every_verb_answers_help_and_a_misspelt_word_at_once(name: str, tmp_path: Path) -> None:
    # Blocked rather than timed: what must not be imported is what makes it slow.
    program = (
        "import runpy, sys\n"
        "for name in 'torch lightning mlflow mujoco trimesh matplotlib scipy'.split(): sys.modules[name] = None\n"
        f"sys.path.insert(0, {str(PIPELINES)!r}); sys.argv = ['x', *sys.argv[1:]]\n"
        f"runpy.run_path({str(PIPELINES / f'{name}.py')!r}, run_name='__main__')\n"
    )
    for words, code in ((["--help"], 0), (["objct=gear"], 2)):
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", program, *words],
            cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert time.perf_counter() - start < 10  # about 0.7 s on a quiet machine
    assert not list(tmp_path.iterdir())


def test_configuring_turns_expected_errors_into_configuration_errors() -> None:
    with pytest.raises(ConfigurationError, match=r"^object gear: no mesh$"), configuring("object gear"):
        raise ValueError("no mesh")
    with pytest.raises(ConfigurationError, match="lrr"), configuring():
        raise TypeError("unexpected keyword argument 'lrr'")
    with pytest.raises(ZeroDivisionError), configuring():
        raise ZeroDivisionError
