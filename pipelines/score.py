"""Score any method's result files: Sileane's JSON with the pose distance of Bregier et al., or a BOP results CSV.

make score ARGS="gt=DIR results=DIR poseutils=FILE [occlusion=0.5] [threshold_scale=1.0] [frame=object]"
make score ARGS="gt=SPLIT_DIR results=METHOD_DATASET-SPLIT.csv models=MODELS_DIR [targets=FILE]"
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attentionvote.command.entry import command, configuring
from attentionvote.command.errors import ConfigurationError
from attentionvote.workflows.settings import ScoreSettings

EXAMPLES = {"gt": "gt=test/gt", "results": "results=out/results"}


def run(cfg: ScoreSettings) -> dict[str, Any]:
    """Recognise the format, score, show the table; the figures."""
    from attentionvote.workflows.score.report import show

    for name, example in EXAMPLES.items():
        if not getattr(cfg, name):
            raise ConfigurationError(f"{name} must be given, e.g. {example}")
        if not Path(getattr(cfg, name)).exists():
            raise ConfigurationError(f"{name} must be a file or folder that is there, got {getattr(cfg, name)}")
    with configuring():
        if _is_bop(cfg):
            from attentionvote.workflows.score.bop import scored
        else:
            from attentionvote.workflows.score.sileane import scored
        result = scored(cfg)
    show(result)
    return {"stage": "score", "gt": cfg.gt, "results": cfg.results, **result}


def _is_bop(cfg: ScoreSettings) -> bool:
    """A CSV file is BOP's, a folder is Sileane's; what the format needs must be given."""
    results = Path(cfg.results)
    bop = results.is_file()
    if bop and results.suffix.lower() != ".csv":
        raise ConfigurationError(
            f"results must be a folder of NAME.json (Sileane) or a METHOD_DATASET-SPLIT.csv (BOP), got {results}"
        )
    kind, needed, other = ("a BOP CSV", "models", "poseutils") if bop else ("Sileane's files", "poseutils", "models")
    if getattr(cfg, needed) is None:
        example = "models=ipd/models" if bop else "poseutils=bunny/poseutils.json"
        raise ConfigurationError(f"{needed} must be given to score {kind}, e.g. {example}")
    if getattr(cfg, other) is not None:
        raise ConfigurationError(f"{other} must not be given to score {kind}, got {getattr(cfg, other)}")
    return bop


if __name__ == "__main__":
    command(ScoreSettings, run)
