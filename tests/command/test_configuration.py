"""Composition and its sentences, on a small configuration folder of the test's own."""
# ruff: noqa: E501 (a table of words and sentences)

from __future__ import annotations

import shutil
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import pytest

from attentionvote.command.configuration import VerbSettings, compose, leaves
from attentionvote.command.errors import ConfigurationError, nearest, sentence
from attentionvote.section import Target
from attentionvote.setting import Setting
from attentionvote.workflows.train.settings import TrainSettings


@dataclass(frozen=True)
class Trainer:
    """The group ``trainer``."""

    lr: Annotated[float, Setting("Rate.", above=0, high=10)]
    max_epochs: Annotated[int, Setting("Epochs.", low=1, high=100)]
    dir: Annotated[str, Setting("Folder.")]


def load(name: str, diameter: Annotated[float, Setting("D in metres.", above=0, high=10)]) -> tuple[str, float]:
    """What an object describes."""
    return name, diameter


@dataclass(frozen=True, kw_only=True)
class Fake(VerbSettings):
    """Settings of a verb."""

    verb: ClassVar[str] = "fake"
    object: Target
    trainer: Trainer
    seed: Annotated[int, Setting("Seed.", low=0, high=2**32 - 1)]
    batch_size: Annotated[int, Setting("Scenes.", low=1, high=1000)]
    workers: Annotated[int | None, Setting("Processes.", low=1, high=1024)]
    flag: Annotated[bool, Setting("Whether.")]
    lengths: Annotated[tuple[float, ...], Setting("Lengths.", low=0, high=10)]
    title: Annotated[str, Setting("Title.")]
    out: Annotated[str, Setting("Folder.")]
    must: Annotated[str, Setting("Given.")]
    later: Annotated[int | None, Setting("With a default, not in conf/.", low=0, high=9)] = None
    open: Annotated[dict[str, Target], Setting("Open.")] = field(default_factory=dict)


FILES = {
    "fake.yaml": """
defaults: [_self_, {object: "???"}, {trainer: default}, {experiment: null}]
seed: 0
batch_size: 4
workers: null
flag: true
lengths: [1.0, 2.0]
title: a text
out: ${trainer.dir}/x
must: given
""",
    "object/connecting_rod.yaml": f"{{_target_: {__name__}.load, name: connecting_rod, diameter: 0.143}}",
    "object/gear.yaml": f"{{_target_: {__name__}.load, name: gear, diameter: 0.121}}",
    "trainer/default.yaml": "{lr: 0.001, max_epochs: 3, dir: outputs}",
    "trainer/broken.yaml": "{lr: [0.001",
    "experiment/short.yaml": "# @package _global_\ntrainer: {max_epochs: 1}\n",
    "experiment/negative.yaml": "# @package _global_\nbatch_size: -4\n",
    "experiment/misspelt.yaml": "# @package _global_\ndefaults: [{override /trainer: defualt}]\n",
}


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like conf/."""
    root = tmp_path_factory.mktemp("conf")
    for name, text in FILES.items():
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    return root


def test_compose_takes_overrides_and_resolves_everything(conf: Path) -> None:
    cfg = compose(Fake, ["object=gear", "trainer.lr=0.1", "trainer.dir=a b", "workers=3"], conf)
    assert (cfg.object.name, cfg.trainer.lr, cfg.out, cfg.workers) == ("gear", 0.1, "a b/x", 3)


def test_an_experiment_is_stronger_than_the_primary_file_and_weaker_than_the_words(conf: Path) -> None:
    assert compose(Fake, ["object=gear", "experiment=short"], conf).trainer.max_epochs == 1
    assert compose(Fake, ["object=gear", "experiment=short", "trainer.max_epochs=9"], conf).trainer.max_epochs == 9


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", "object must be given, one of connecting_rod, gear"),
        ("object=conecting_rod", "object must be one of connecting_rod, gear; got 'conecting_rod', did you mean 'connecting_rod'?"),
        ("object=null", "object must be one of connecting_rod, gear; got 'null'"),
        ("object=gear,connecting_rod", "object=gear,connecting_rod lists several choices, which needs -m (a grid of runs)"),
        ("object=gear objct=gear", "there is no setting 'objct', did you mean 'object'?"),
        ("object=gear trainer.max_epoch=3", "there is no setting 'trainer.max_epoch', did you mean 'trainer.max_epochs'?"),
        ("object=gear lr=abc", "there is no setting 'lr', did you mean 'trainer.lr'?"),
        ("object=gear max_epoch=1", "there is no setting 'max_epoch', did you mean 'trainer.max_epochs'?"),
        ("object=gear nothing_like_it=1", "there is no setting 'nothing_like_it'"),
        (
            "object=gear trainer.lr=0.1 ~trainer.lr",
            "trainer.lr must be given",
        ),
        ("object=gear trainer.lr=abc", "trainer.lr must be a number greater than 0 and at most 10; got 'abc'"),
        ("object=gear trainer.lr=null", "trainer.lr must be a number greater than 0 and at most 10; got null"),
        ("object=gear trainer.lr=true", "trainer.lr must be a number greater than 0 and at most 10; got True"),
        ("object=gear trainer.lr=[1]", "trainer.lr must be a number greater than 0 and at most 10; got [1]"),
        ("object=gear trainer.lr=-1", "trainer.lr must be greater than 0 and at most 10; got -1"),
        ("object=gear batch_size=2.5", "batch_size must be a whole number at least 1 and at most 1000; got 2.5"),
        ("object=gear batch_size=-2", "batch_size must be at least 1 and at most 1000; got -2"),
        ("object=gear workers=0", "workers must be a whole number at least 1 and at most 1024; got 0"),
        ("object=gear flag=3", "flag must be true or false; got 3"),
        ("object=gear lengths=[1,a]", "lengths must be a number at least 0 and at most 10; got 'a'"),
        ("object=gear lengths=[]", "lengths must not be an empty list"),
        ("object=gear lengths=3", "lengths must be a list; got 3"),
        ("object=gear title=[x]", "title must be a text; got ['x']"),
        ("object=gear must=???", "must must be given, e.g. must=VALUE"),
        ("object=gear trainer.dir=${nowhere}", "out cannot be resolved: Interpolation key 'nowhere' not found"),
        ("object=gear foo", "every argument must be key=value, got 'foo'"),
        ("object=gear seed={", "every argument must be key=value, got 'seed={'"),
        ("object=gear hydra.run.dir=x", "settings of Hydra itself have no effect, got 'hydra.run.dir=x': leave it out (a verb runs its own work, and says where it puts things)"),
        ("object=gear open.x.y=1", "open.x must have _target_, the dotted name of what it configures; got none"),
        ("object=gear opn.x.y=1", "there is no setting 'opn.x.y'"),
        ("object=gear ~batch_size", "batch_size must be given"),
        ("object=gear ~later", "later can be changed, not taken away, got '~later': give it a value"),
        ("object=gear experiment=negative", "batch_size must be at least 1 and at most 1000; got -4"),
        ("object=gear experiment=misspelt", "trainer must be one of broken, default; got 'defualt', did you mean 'default'?"),
    ],
)  # fmt: skip
def test_what_is_impossible_gets_one_sentence(conf: Path, words: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        compose(Fake, words.split(), conf)
    assert sentence(raised.value) == expected


def test_a_file_that_changes_between_two_calls_counts(conf: Path, tmp_path: Path) -> None:
    own = tmp_path / "conf"
    shutil.copytree(conf, own)
    words = ["object=gear", "trainer.lr=0.1"]
    assert compose(Fake, words, own).trainer.lr == 0.1
    trainer = own / "trainer" / "default.yaml"
    trainer.write_text(trainer.read_text(encoding="utf-8").replace("lr:", "rate:"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"there is no setting 'trainer\.lr'"):
        compose(Fake, words, own)


def test_a_broken_file_is_named(conf: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"broken\.yaml"):
        compose(Fake, ["object=gear", "trainer=broken"], conf)


def test_plus_plus_sets_what_is_there_and_plus_adds_no_unknown_setting(conf: Path) -> None:
    assert compose(Fake, ["object=gear", "++seed=3"], conf).seed == 3
    with pytest.raises(ConfigurationError, match=r"^there is no setting 'sed', did you mean 'seed'\?$"):
        compose(Fake, ["object=gear", "+sed=1"], conf)


@pytest.mark.parametrize("plus", ["", "+", "++"])
def test_what_conf_leaves_out_is_set_with_and_without_plus(conf: Path, plus: str) -> None:
    words = ["object=gear", f"{plus}later=3", f"{plus}open.x._target_={__name__}.load", f"{plus}open.x.name=a"]
    cfg = compose(Fake, [*words, f"{plus}open.x.diameter=1"], conf)
    assert (cfg.later, cfg.open["x"]()) == (3, ("a", 1))
    with pytest.raises(ConfigurationError, match=r"open\.x\.diameter must be greater than 0 and at most 10; got -1"):
        compose(Fake, [*words, f"{plus}open.x.diameter=-1"], conf)
    with pytest.raises(ConfigurationError, match=r"no setting 'open\.x\.diametr', did you mean"):
        compose(Fake, [*words, f"{plus}open.x.diametr=1"], conf)


def test_the_words_are_kept_with_the_settings(conf: Path) -> None:
    assert compose(Fake, ["object=gear", "seed=3"], conf).words == ("object=gear", "seed=3")


def test_nearest_prefers_the_same_last_name() -> None:
    assert nearest("lr", ["lb", "trainer.lr"]) == ", did you mean 'trainer.lr'?"
    assert nearest("zebra", ["trainer.lr"]) == ""


def test_leaves_are_dotted_keys() -> None:
    assert dict(leaves({"a": {"b": 1, "c": {}}, "d": [1]})) == {"a.b": 1, "a.c": {}, "d": [1]}


def test_a_sentence_is_one_line_and_never_empty() -> None:
    assert sentence(ValueError("a\n   b")) == "a b"
    assert sentence(KeyError()) == "KeyError"
    assert sentence(FileNotFoundError(2, "No such file", "x.stl")) == "file not found: x.stl"


ROOT = Path(__file__).resolve().parents[2]
ABLATIONS = [
    line.partition("#")[0].partition("$T")[2].split()
    for line in (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8").splitlines()
    if line.startswith(".venv/bin/python pipelines/train.py -m $T")
]


@pytest.mark.parametrize("words", ABLATIONS, ids=" ".join)
def test_the_ablations_of_the_benchmarks_are_trainings(words: list[str]) -> None:
    from attentionvote.workflows.train.job import find_training

    plain = ["object=connecting_rod", "experiment=compact"]
    job, base = (find_training(compose(TrainSettings, [*plain, *more])) for more in (words, []))
    assert (job.directory == base.directory) == (not words)


def test_there_are_ablations_in_the_benchmarks() -> None:
    assert len(ABLATIONS) >= 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trainer.peak_threshold=1.5"], "must be at most 1 with model.proposal_source=fps, .* got 1.5"),
        (["trainer.train_heat=2"], "must be at most 1 with model.proposal_source=fps, .* got 2"),
        (["trainer.train_heat=2", "model.proposal_source=heatmap"], ""),
    ],
)
def test_thresholds_that_no_farthest_vote_passes_are_refused(words: list[str], message: str) -> None:
    from attentionvote.workflows.train.job import find_training

    cfg = compose(TrainSettings, ["object=connecting_rod", "experiment=votenet", *words])
    with pytest.raises(ValueError, match=message) if message else nullcontext():
        find_training(cfg)


@pytest.mark.parametrize("word", ["trainer.learning_rate=null", "model.voxel_fraction=null", "data.points=null"])
def test_null_is_for_settings_that_mean_something_without_a_value(word: str) -> None:
    with pytest.raises(ConfigurationError, match=r"must be a .* got null"):
        compose(TrainSettings, ["object=gear", word])


def test_an_object_whose_file_has_another_name_is_refused(conf: Path) -> None:
    file = conf / "object" / "rod.yaml"
    file.write_text(f"{{_target_: {__name__}.load, name: gear, diameter: 0.143}}")
    expected = rf"name in {file} must be that of the file, 'rod', got 'gear': data, trainings and champion would be those of gear; correct the name, or rename the file"
    with pytest.raises(ConfigurationError, match=expected):
        compose(Fake, ["object=rod", "must=x"], conf)
    assert compose(Fake, ["object=rod", "must=x", "object.name=gear"], conf).object.name == "gear"


def test_a_file_in_another_encoding_is_named_with_its_line(conf: Path) -> None:
    file = conf / "object" / "gear.yaml"
    file.write_bytes(file.read_bytes() + "\n# für die Zelle\n".encode("latin-1"))
    with pytest.raises(ConfigurationError, match=rf"must be UTF-8 text, but line 2 of {file} has the byte 0xfc: save"):
        compose(Fake, ["object=gear", "must=x"], conf)
