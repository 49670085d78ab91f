"""A tiny training in a process of its own, to be killed: ``python fit_script.py STORE RUN_ID|- FOLDER EPOCHS``.

Prints the run's id, then a line for each epoch.
"""

import sys
import time
from pathlib import Path

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint

from attentionvote.tracking.lightning_logger import RunLogger
from attentionvote.tracking.run_opening import start_run


class Tiny(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(4, 1)

    def training_step(self, batch, _):
        loss = self.layer(batch).square().mean()
        self.log("train/loss", loss)
        return loss

    def validation_step(self, batch, _):
        self.log("val/loss", self.layer(batch).square().mean())
        self.log("val/ap_10", float(self.current_epoch % 4))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.05)


class Announce(Callback):
    def on_train_epoch_end(self, trainer, _):
        print(trainer.current_epoch, flush=True)
        time.sleep(0.1)


def main(store: str, run_id: str, folder: Path, epochs: int) -> None:
    torch.manual_seed(0)
    run = start_run(store, "fit", name="tiny", run_id=None if run_id == "-" else run_id, params={"epochs": epochs})
    print(run.id, flush=True)
    training, validation = (torch.utils.data.DataLoader(torch.randn(count, 4), batch_size=3) for count in (60, 6))
    callbacks = [
        ModelCheckpoint(folder, "best-{epoch}", monitor="val/ap_10", mode="max", auto_insert_metric_name=False),
        ModelCheckpoint(folder, "loss-{epoch}", monitor="val/loss", auto_insert_metric_name=False, save_last=True),
        Announce(),
    ]
    trainer = Trainer(
        accelerator="cpu", max_epochs=epochs, logger=RunLogger(run), callbacks=callbacks, log_every_n_steps=1,
        enable_progress_bar=False, enable_model_summary=False, default_root_dir=folder, num_sanity_val_steps=0,
    )  # fmt: skip
    last = folder / "last.ckpt"
    trainer.fit(Tiny(), training, validation, ckpt_path=last if last.exists() else None)
    run.close()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
