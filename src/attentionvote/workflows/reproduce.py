"""From a registered version back to its making: its training again, from what the store keeps of it, and compared."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]

from attentionvote.command.conf_folder import SCRIPTS
from attentionvote.command.errors import ConfigurationError, Refused
from attentionvote.command.tables import show_table
from attentionvote.execution.job_process import INTERRUPTED, JobProcess
from attentionvote.files import write_json, write_whole
from attentionvote.registry.versions import Versions
from attentionvote.workflows.settings import ReproduceSettings
from attentionvote.workflows.train.beginning import MODEL
from attentionvote.workflows.train.settings import TrainSettings

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger("attentionvote.reproduce")
CONFIG, RESULT = "config.yaml", "result.json"
_FIGURES = ("ap_10", "ap_5", "ap_2")


@dataclass(frozen=True)
class Recorded:
    """What a store keeps of the training of a version.

    Attributes:
        version: its number.
        run_id: of the training.
        settings: whole, as ``config.yaml`` has them.
        scenes: digest of every scene set, by split.
        origin: commit, processor and package versions.
        result: what the training ended with.
        model: file of its weights.
    """

    version: int
    run_id: str
    settings: dict[str, Any]
    scenes: dict[str, str]
    origin: dict[str, str]
    result: dict[str, Any]
    model: Path


def recorded(cfg: ReproduceSettings, folder: Path) -> Recorded:
    """What is kept of the training of a version; files are fetched into a folder.

    Raises:
        ValueError: there is no such version, or the store does not have what its training was.
    """
    from mlflow.exceptions import MlflowException

    versions = Versions(cfg.tracking.store, str(cfg.object.name))
    everything = {version.number: version for version in versions.all()}
    version = versions.champion() if cfg.version is None else everything.get(cfg.version)
    if version is None:
        which = "a champion" if cfg.version is None else f"version {cfg.version}"
        raise ValueError(f"{versions.name} must have {which}, it has {', '.join(map(str, everything)) or 'no version'}")
    folder.mkdir(parents=True, exist_ok=True)

    def fetched(name: str) -> Path:
        try:
            return Path(versions.client.download_artifacts(version.run_id, name, str(folder)))
        except (MlflowException, OSError) as error:
            raise ValueError(
                f"the run {version.run_id or 'unknown'} of version {version.number} must be in the store with {name}, "
                "but it is not: a training that was not tracked there cannot be reproduced"
            ) from error

    settings = yaml.safe_load(fetched(CONFIG).read_text(encoding="utf-8"))
    result = json.loads(fetched(RESULT).read_text(encoding="utf-8"))
    model = fetched(f"checkpoints/{MODEL}")
    run = versions.client.get_run(version.run_id)
    splits = ("train", "val", "test")
    scenes = {split: run.data.params[f"data.{split}"] for split in splits if f"data.{split}" in run.data.params}
    names = ("git.commit", "git.dirty", "hardware.cpu")
    origin = {k: v for k, v in sorted(run.data.tags.items()) if k in names or k.startswith("version.")}
    return Recorded(version.number, version.run_id, settings, scenes, origin, result, model)


def differences(then: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """What is not as it was when a training ran: commit, processor, packages; then and now."""
    from attentionvote.tracking import provenance

    git = provenance.git_state(Path.cwd())
    now = {"git.commit": git.commit, "git.dirty": str(git.is_dirty).lower()}
    now |= {"hardware.cpu": provenance.hardware()["cpu"]}
    now |= {f"version.{name}": version for name, version in provenance.package_versions().items()}
    return {name: (value, now[name]) for name, value in then.items() if now.get(name, value) != value}


def reproduce(cfg: ReproduceSettings) -> dict[str, Any]:
    """Train again and compare; the dictionary of the JSON line.

    Raises:
        ConfigurationError: what the version was made from is not in the store.
        ValueError: the training failed.
        Refused: scenes or figures are others.
    """
    try:
        was = recorded(cfg, Path(cfg.outputs) / cfg.object.name / f"version-{cfg.version or 'champion'}")
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    differs = differences(was.origin)
    if differs:
        rows = [(name, then[:40], now[:40]) for name, (then, now) in differs.items()]
        show_table(("what", "then", "now"), rows, f"version {was.version} was made with")
    else:
        log.info("commit, packages and processor are those that version %d was made with", was.version)
    again = _trained_again(cfg, was)
    new = Versions(cfg.tracking.store, str(cfg.object.name)).client.get_run(again["run_id"])
    scenes = {split: new.data.params.get(f"data.{split}") for split in was.scenes}
    answer: dict[str, Any] = {
        "stage": "reproduce",
        "object": cfg.object.name,
        "version": was.version,
        "run_id": was.run_id,
        "again": again["run_id"],
        "differs": {name: list(pair) for name, pair in differs.items()},
        "scenes_equal": scenes == was.scenes,
        "weights_equal": _same(_weights(was.model), _weights(Path(again["model"]))),
        "metrics": {name: [was.result["metrics"].get(name), again["metrics"].get(name)] for name in _FIGURES},
    }
    if scenes != was.scenes:
        split = next(split for split in scenes if scenes[split] != was.scenes[split])
        raise Refused(
            f"the {split} scenes must be those of version {was.version}, {was.scenes[split][:12]}, but the same "
            f"settings made {str(scenes[split])[:12]} here: other code or packages make other piles",
            answer | {"verdict": "other scenes"},
        )
    if answer["weights_equal"] and was.result["metrics"] == again["metrics"]:
        log.info("version %d is reproduced: scenes, weights and figures are equal to the bit", was.version)
        return _written(cfg, answer | {"verdict": "equal"})
    between = paired_difference(was, again, cfg)
    answer["difference"] = between
    apart = [name for name, (_, low, high) in between.items() if not low <= 0 <= high]
    for name, (middle, low, high) in between.items():
        log.info("%s: %+.4f (95 %%: %+.4f to %+.4f) against version %d", name, middle, low, high, was.version)
    if apart:
        raise Refused(
            f"version {was.version} is not reproduced: {', '.join(apart)} differ by more than their 95 % intervals",
            _written(cfg, answer | {"verdict": "apart"}),
        )
    log.info("version %d is reproduced: the same scenes, figures within the intervals of their difference", was.version)
    return _written(cfg, answer | {"verdict": "within"})


def paired_difference(was: Recorded, again: Mapping[str, Any], cfg: ReproduceSettings) -> dict[str, list[float]]:
    """Test figures of the new weights minus those of the old, on the same scenes: value, and 95 % interval.

    Raises:
        ValueError: when the test has one drop cycle, of which no interval is known.
    """
    from attentionvote.evaluation import left_out_figures
    from attentionvote.training.module import PoseTraining
    from attentionvote.workflows.train.pieces import part_data

    settings = TrainSettings.of({**was.settings, "root": _root(cfg)})
    part = settings.object()
    figures = []
    for file in (was.model, Path(again["model"])):
        module = PoseTraining.load_from_checkpoint(file)
        data = part_data(settings, module)
        results = [result for batch in data.test_dataloader() for result in module.detect(batch)]
        point = float(module.metadata["confidence_threshold"] or 0.0)
        figures.append(left_out_figures(results, data.test.cycles, part, point))
    if not figures[0]:
        raise ValueError(
            f"the test of version {was.version} must have at least two drop cycles for an interval, got one: other "
            "weights cannot be compared with its own"
        )
    between = {name: figures[1][name].minus(figures[0][name]) for name in _FIGURES}
    return {name: [round(v, 6) for v in (sure.value, sure.low, sure.high)] for name, sure in between.items()}


def _trained_again(cfg: ReproduceSettings, was: Recorded) -> dict[str, Any]:
    folder = Path(cfg.outputs).absolute() / str(cfg.object.name) / f"config-{was.version}"
    write_whole(folder / CONFIG, yaml.safe_dump(was.settings, sort_keys=False))
    words = {
        "root": _root(cfg),
        "outputs": str(Path(cfg.outputs).absolute() / "train"),
        "tracking.store": cfg.tracking.store,
        "tracking.parent": None,
        "executor": "local",
        "resume": "auto",
        "force": False,
        "workers": cfg.workers,
    }
    flags = [f"--config-dir={folder}", f"--config-name={Path(CONFIG).stem}"]
    outcome = JobProcess(SCRIPTS / "train.py", [*flags, *(f"{k}={json.dumps(v)}" for k, v in words.items())]).result()
    if outcome.code == INTERRUPTED:
        raise KeyboardInterrupt
    if outcome.result is None:
        raise ValueError(f"the training of version {was.version} cannot be repeated: {outcome.sentence}")
    return outcome.result


def _root(cfg: ReproduceSettings) -> str:
    return str(Path(cfg.outputs).absolute() / "data")


def _weights(file: Path) -> dict[str, Tensor]:
    import torch

    weights: dict[str, Tensor] = torch.load(file, map_location="cpu", weights_only=True)["state_dict"]
    return weights


def _same(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> bool:
    import torch

    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def _written(cfg: ReproduceSettings, answer: dict[str, Any]) -> dict[str, Any]:
    write_json(Path(cfg.outputs) / str(cfg.object.name) / f"version-{answer['version']}.json", answer)
    return answer
