"""docs/library.md: its code runs as it stands, on the smallest network."""

from __future__ import annotations

import logging
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_training import TINY_TRAINING

PAGE = Path(__file__).resolve().parents[1] / "docs" / "library.md"
BLOCK = re.compile(r"^```python ?(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SMALL = ["workers=1", "simulation.drop_counts=[1,2]", *TINY_TRAINING[1:]]


@pytest.mark.filterwarnings("ignore::UserWarning:lightning", "ignore::FutureWarning")
def test_the_page_is_code_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts_of_one_piece: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("ATTENTIONVOTE_CACHE", str(parts_of_one_piece))
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    names: dict[str, Any] = {"__name__": "page"}
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    assert len(blocks) >= 5
    for file, code in blocks:
        if file:
            Path(file).write_text(code, encoding="utf-8")
            continue
        small = code.replace('"experiment=smoke"', f'"experiment=smoke", *{SMALL!r}')
        exec(compile(small.replace("connecting_rod", "brick"), str(PAGE), "exec"), names)
    answer = names["answer"]
    assert answer.poses.shape == (len(answer.scores), 4, 4)
    assert len(answer.scores) > 0
    np.testing.assert_allclose(np.linalg.det(answer.poses[:, :3, :3]), 1, atol=1e-6)
    assert len(names["results"]) == 1
    assert names["module"].model.fusion.__class__.__name__ == "MeanFusion"
    again = names["PoseTraining"].load_from_checkpoint("rod.ckpt")
    assert np.array_equal(again.poses(names["scene"].points).poses, answer.poses)
    with pytest.raises(ValueError, match=r"^points must have shape \(P, 3\), got \(5, 4\)$"):
        again.poses(np.zeros((5, 4)))
    with pytest.raises(ValueError, match=r"^points must hold at least 3 measured points, got 0$"):
        again.poses(np.full((5, 3), np.nan))
    with pytest.raises(ValueError, match=r"^a loaded module only answers: a training begins"):
        again.configure_optimizers()
    sys.modules.pop("my_fusion", None)
    assert torch.is_grad_enabled()
