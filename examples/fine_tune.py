"""Fine-tune the shipped network in a training loop of your own, and track with it.

    python examples/fine_tune.py --steps 20 --out tuned.safetensors

The clips are rendered while it trains; replace them by batches of your own with the same entries. The full recipe
(moving average, recovery, schedules, resuming, recordings) is `python -m train fit --from small --steps 20 ...`.
"""

import argparse

import torch
from torch.utils.data import DataLoader

import dvo
from dvo.losses import pose_errors
from dvo.models.schedule import training_schedule
from dvo.models.weights import save_weights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--out", default="tuned.safetensors")
    options = parser.parse_args()
    torch.manual_seed(0)
    model = dvo.load_model("small").train()
    clips = DataLoader(dvo.ClipDataset(seed=7, length=options.steps, frames=6, height=96, width=128, flow_range=(1, 8)))
    stages = training_schedule(frames=6, patches=model.config.training_patches, updates=6, self_edges=False)
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-5)
    for step, clip in enumerate(clips):
        start = dvo.se3.identity(1, 6)
        loss = torch.zeros(())
        for state in model.unroll(clip["images"], clip["intrinsics"], stages, poses_cw=start):
            errors = pose_errors(state.poses_cw, clip["poses_cw"])
            loss = loss + (errors.translation + errors.rotation).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()
        print(f"step {step}: loss {loss.item():.3f}, rotation error {errors.rotation.mean().rad2deg().item():.2f} deg")
    # The card tells what the weights have seen and under which licence they are: adapt it to clips of your own.
    card = {"origin": "examples/fine_tune.py", "steps": options.steps, "licence": "MIT"}
    card |= {"data": "renderings of dvo.synth only", "started_from": {"name": "small"}}
    save_weights(options.out, model, card)
    print(f"dvo.load('{options.out}') gives", dvo.load(options.out, device="cpu").name)


if __name__ == "__main__":
    main()
