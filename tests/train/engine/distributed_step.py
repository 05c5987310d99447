"""One process of a distributed run of two steps; started by test_distributed.py with the variables that torchrun would
set. Writes the gradients that the optimiser sees in the second."""

import datetime
import sys

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy

import dvo.synth.dataset
from train.data.clips import Renderings
from train.engine.build import make_program
from train.tasks.patch_vo.objective import LossConfig


class KeepGradients(L.Callback):
    """Writes gradients, balance and the clips seen."""

    def __init__(self, path):
        self.path = path

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        if trainer.global_step == 1 and trainer.is_global_zero:
            grads = {n: p.grad.clone() for n, p in pl_module.net.named_parameters()}
            balance = (pl_module.task.beta.value, pl_module.task.rotation.value)
            seen, within = trainer.datamodule.clips_seen, pl_module.within_quarter
            torch.save({"grads": grads, "balance": balance, "seen": seen, "within": within}, self.path)


def main(path, batch, processes, clips):
    torch.set_num_threads(1)
    rendered = torch.load(clips, weights_only=False)
    dvo.synth.dataset.make_clip = lambda seed, index, **options: rendered[index % 4]
    torch.manual_seed(0)
    loss = LossConfig(weighted=True, balance="v2v", balance_every=1, pose_from=1)
    # A rate of zero: the second step, where gradients are compared for the balance, sees the same weights.
    program = make_program(model="tiny", updates=3, initial=3, settle=1, warmup_until=0.0, loss=loss, clip=1e9,
                              learning_rate=0.0, weight_decay=0.0)  # fmt: skip
    strategy = DDPStrategy(process_group_backend="gloo", timeout=datetime.timedelta(seconds=300))
    trainer = L.Trainer(
        accelerator="cpu", devices=processes, strategy=strategy if processes > 1 else "auto", max_steps=2,
        max_epochs=-1, logger=False, enable_progress_bar=False, enable_model_summary=False,
        enable_checkpointing=False, use_distributed_sampler=False, callbacks=[KeepGradients(path)],
    )  # fmt: skip
    trainer.fit(program, Renderings(frames=4, sizes=[(48, 64), (64, 48)], workers=0, seed=5, batch_size=batch))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
